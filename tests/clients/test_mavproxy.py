"""MAVProxy on a terminal flies the simulated ArduCopter, as it flies the real one."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

from programs import Terminal, vehicle

from simulator.firmware.ardupilot import ARDUPILOT


def test_an_arducopter_takes_off_lands_and_boots_again(tmp_path: Path) -> None:
    """Six times as fast as real time, and started in 4 s instead of 42 s."""
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
