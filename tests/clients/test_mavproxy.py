"""MAVProxy on a terminal flies the simulator, as it flies a real PX4 1.16.1 and an ArduCopter."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

import pytest
from programs import Terminal, vehicle

from simulator.firmware.ardupilot import ARDUPILOT
from simulator.firmware.px4 import PX4


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


@pytest.mark.slow
def test_a_session_with_two_flights(tmp_path: Path) -> None:
    with vehicle() as port, Terminal(tmp_path, port) as proxy:
        proxy.expect("Detected vehicle 1:1")
        # over FTP first, in vain: without a refusal that takes 12 s
        proxy.expect(rf"Received {len(PX4.parameters)} parameters", 8.0)
        proxy.talk(("param show COM_OF_LOSS_T", r"COM_OF_LOSS_T\s+1\.0"))
        proxy.type("param set COM_OBL_RC_ACT 5")
        _until(proxy, "param fetch COM_OBL_RC_ACT", r"COM_OBL_RC_ACT = \d", "5")
        proxy.talk(
            ("long DO_SET_MODE 209 6 0", "Mode OFFBOARD"),
            ("arm throttle", "COMPONENT_ARM_DISARM: TEMPORARILY_REJECTED"),
            ("", "Arming denied"),
            ("long DO_SET_MODE 209 4 3", "Mode LOITER"),
        )
        for _ in range(2):
            _fly(proxy)
        assert "breach" not in proxy.shown
        assert "ERROR" not in proxy.shown


def _until(proxy: Terminal, line: str, shown: str, end: str) -> None:
    """Types the line until what it prints ends so: it sets and checks in the background."""
    for _ in range(10):
        proxy.type(line)
        if proxy.expect(shown).group().endswith(end):
            return
    raise AssertionError(proxy.shown)


def _fly(proxy: Terminal) -> None:
    arm = ("arm throttle", r"COMPONENT_ARM_DISARM: \w+", "ACCEPTED")
    _until(proxy, *arm)
    proxy.talk(("", "Armed by external command"), ("disarm", "Disarmed by external command"))
    _until(proxy, *arm)
    proxy.talk(
        ("", "Armed by external command"),
        ("long NAV_TAKEOFF 0 0 0 nan nan nan nan", "NAV_TAKEOFF: ACCEPTED"),
        ("", "Takeoff detected"),
        ("", "Mode LOITER"),
        ("disarm", "Disarming denied: not landed"),
        ("long NAV_LAND 0 0 0 nan 0 0 0", "Landing at current position"),
        ("", "Landing detected"),
        ("", "Disarmed by landing"),
        ("long DO_SET_MODE 209 4 3", "DO_SET_MODE: ACCEPTED"),
    )
