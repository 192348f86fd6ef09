"""MAVProxy on a terminal flies the simulated ArduCopter, as it flies the real one; it is a router
between the vehicle, a ground station and us, and a signing client."""

from __future__ import annotations

import hashlib
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest
from processes import free_port
from programs import Terminal, vehicle
from pymavlink import mavutil

from offboard.analysis import tlog
from offboard.documents.signing_key import create_key
from simulator.firmware.ardupilot import ARDUPILOT

SHORT = ("--controller", "lqr", "--reference", "hover", "--set", "reference.height_m=1",
         "--set", "reference.duration_s=1")  # fmt: skip
# three programs and a router share the processors with other tests
PATIENT = ("--set", "limits.link_growth_s=2", "--set", "limits.setpoint_age_s=2")
LATE = ("--set", "limits.silence_s=5", "--set", "limits.missed_decisions=50")


def test_mavproxy_flies_and_reboots_arducopter(tmp_path: Path) -> None:
    """Time runs six times as fast, and the vehicle boots in 4 s instead of 42 s."""
    starts = tmp_path / "starts.yaml"
    starts.write_text("name: starts\ndescription: Soon.\nconditions: {boot_scale: 0.1}\n")
    simulated = ("--firmware", "ardupilot", "--speed", "6", "--scenario", str(starts))
    with vehicle(*simulated) as port, Terminal(tmp_path, port) as proxy:
        proxy.expect(f"Received {len(ARDUPILOT.parameters)} parameters", 30.0)
        proxy.talk(
            ("mode guided", "Mode GUIDED"),
            ("arm throttle", "Arming motors"),
            ("takeoff 5", "NAV_TAKEOFF: ACCEPTED"),
        )
        _reach_five_metres(proxy)
        proxy.talk(
            ("setspeed 3", "DO_CHANGE_SPEED: ACCEPTED"),
            ("mode land", "Mode LAND"),
            ("", "Disarming motors"),
            ("reboot", "PREFLIGHT_REBOOT_SHUTDOWN: ACCEPTED"),
            ("", "ArduPilot Ready"),
        )


def _reach_five_metres(proxy: Terminal) -> None:
    for _ in range(40):
        proxy.type("status GLOBAL_POSITION_INT")
        with suppress(AssertionError):
            proxy.expect(r"relative_alt : (4[7-9]|5[0-3])\d\d,", 0.5)
            return
    raise AssertionError(proxy.shown)


@contextmanager
def routed(directory: Path, system: int) -> Iterator[tuple[Terminal, int, int]]:
    """A vehicle behind MAVProxy; its terminal, and the ports to which it sends for us and for a
    ground station."""
    ours, station = free_port(), free_port()
    outs = (f"--out=udpout:127.0.0.1:{ours}", f"--out=udpout:127.0.0.1:{station}")
    simulated = ("--instance", str(system - 1), "--param", "COM_OF_LOSS_T=5")
    with vehicle(*simulated) as port, Terminal(directory, port, *outs) as terminal:
        yield terminal, ours, station


def fly(port: int, directory: Path, key: Path, meanwhile: Callable[[], object]) -> str:
    """Fly, call `meanwhile` until the end, and return what was printed."""
    command = [sys.executable, "-m", "offboard", "fly", "--connect", f"udpin:127.0.0.1:{port}"]
    options = (*SHORT, *PATIENT, *LATE, "--out", str(directory), "--signing-key", str(key))
    with (directory.parent / "printed").open("w+") as printed:
        process = subprocess.Popen(
            [*command, *options],
            stdout=printed,
            stderr=subprocess.STDOUT,
            env={**os.environ, "COLUMNS": "200", "XDG_STATE_HOME": str(directory.parent)},
        )
        while process.poll() is None:
            meanwhile()
        printed.seek(0)
        text = printed.read()
    # on a machine that is too busy to track, it is landed earlier
    assert process.returncode == 0 or "climb: lifted off" in text, text
    assert "disarmed on the ground" in text, text
    return text


@pytest.mark.slow
def test_signed_flight_works_with_mavproxy_as_router(tmp_path: Path) -> None:
    """MAVProxy gives the vehicle its key, as `offboard key` says, and forwards messages. The
    station hears the vehicle, and acknowledgements reach the sender of the command."""
    passphrase = create_key(tmp_path / "key")
    with routed(tmp_path, system=3) as (terminal, ours, station):
        terminal.expect(r"Received \d+ parameters", 30.0)
        terminal.type("module load signing")
        terminal.type(f"signing setup {passphrase}")
        terminal.expect("Setup signing key")
        ground = mavutil.mavlink_connection(f"udpin:127.0.0.1:{station}", source_system=255)
        assert ground.recv_match(blocking=True, timeout=20.0)  # a key set before that would be lost
        ground.setup_signing(hashlib.sha256(passphrase.encode()).digest())
        heard = set()

        def listen() -> None:
            """The terminal must be read, or MAVProxy would stop."""
            terminal.read(0.05)
            while (message := ground.recv_match()) is not None:
                if message.get_type() != "BAD_DATA" and message.get_signed():
                    heard.add((message.get_srcSystem(), message.get_srcComponent()))

        printed = fly(ours, tmp_path / "flight", tmp_path / "key", listen)
        ground.close()
        terminal.expect("Mode OFFBOARD")
        terminal.type("param fetch COM_OF_LOSS_T")  # MAVProxy is answered, too
        terminal.expect(r"COM_OF_LOSS_T = 5")
    assert (3, 1) in heard
    log = list(tlog.read(tmp_path / "flight" / "flight.tlog"))
    assert {each.system_id for each in log if each.component_id == 1} == {3}
    assert all(each.frame.signed for each in log if each.component_id in (1, 191))
    assert not any(each.name == "SETUP_SIGNING" for each in log)
    commands = [each.message for each in log if each.name == "COMMAND_LONG"]
    assert {(each.target_system, each.target_component) for each in commands} == {(3, 1)}
    acks = [each.message for each in log if each.name == "COMMAND_ACK"]
    assert {400, 176} <= {each.command for each in acks if each.target_component == 191}
    assert passphrase not in printed
