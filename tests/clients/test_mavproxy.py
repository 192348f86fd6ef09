"""MAVProxy on a terminal flies the simulator, as it flies a real PX4 1.16.1 and an ArduCopter."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest
from terminal import Terminal
from vehicle_process import vehicle

from simulator.firmware.ardupilot import ARDUPILOT
from simulator.firmware.px4 import PX4

MAVPROXY = Path(sys.executable).with_name("mavproxy.py")


@contextmanager
def proxied(directory: Path, *options: str) -> Iterator[Terminal]:
    with vehicle(*options) as port:
        command = (sys.executable, str(MAVPROXY), f"--master=udpin:127.0.0.1:{port}", "--no-state")
        with Terminal(command, str(directory)) as terminal:
            yield terminal


def talk(proxy: Terminal, *lines: tuple[str, str, float]) -> None:
    """Types each line, unless it is empty, and waits for what it must print, at most so long."""
    for typed, shown, within_s in lines:
        if typed:
            proxy.type(typed)
        proxy.expect(shown, within_s)


def test_an_arducopter_takes_off_lands_and_boots_again(tmp_path: Path) -> None:
    """Three times as fast as real time, and started in 10 s instead of 42 s."""
    starts = tmp_path / "starts.yaml"
    starts.write_text("name: starts\ndescription: Soon.\nconditions: {boot_scale: 0.25}\n")
    simulated = ("--firmware", "ardupilot", "--speed", "3", "--scenario", str(starts))
    with proxied(tmp_path, *simulated) as proxy:
        proxy.expect("EKF3 IMU1 is using GPS", 30.0)
        parameters = f"Received {len(ARDUPILOT.parameters)} parameters"
        if parameters not in proxy.shown:
            proxy.expect(parameters, 30.0)
        talk(
            proxy,
            ("mode guided", "Mode GUIDED", 15.0),
            ("arm throttle", "Arming motors", 15.0),
            ("takeoff 5", "NAV_TAKEOFF: ACCEPTED", 15.0),
        )
        _reach_five_metres(proxy)
        talk(
            proxy,
            ("setspeed 3", "DO_CHANGE_SPEED: ACCEPTED", 15.0),
            ("mode land", "Mode LAND", 15.0),
            ("", "Disarming motors", 20.0),
            ("reboot", "PREFLIGHT_REBOOT_SHUTDOWN: ACCEPTED", 15.0),
            ("", "ArduPilot Ready", 20.0),
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
    with proxied(tmp_path) as proxy:
        proxy.expect("Detected vehicle 1:1")
        # over FTP first, in vain: without a refusal that takes 12 s
        proxy.expect(rf"Received {len(PX4.parameters)} parameters", 8.0)
        _parameters(proxy)
        _offboard_is_not_armed_without_a_stream(proxy)
        for _ in range(2):
            _fly(proxy)
        assert "breach" not in proxy.shown
        assert "ERROR" not in proxy.shown


def _parameters(proxy: Terminal) -> None:
    proxy.type("param show COM_OF_LOSS_T")
    proxy.expect(r"COM_OF_LOSS_T\s+1\.0")
    proxy.type("param set COM_OBL_RC_ACT 5")
    for _ in range(10):  # it sets in the background and says nothing
        proxy.type("param fetch COM_OBL_RC_ACT")
        if proxy.expect(r"COM_OBL_RC_ACT = (\d)").group(1) == "5":
            return
    raise AssertionError("the parameter was not set")


def _offboard_is_not_armed_without_a_stream(proxy: Terminal) -> None:
    proxy.type("long DO_SET_MODE 209 6 0")
    proxy.expect("Mode OFFBOARD")
    proxy.type("arm throttle")
    proxy.expect("COMPONENT_ARM_DISARM: TEMPORARILY_REJECTED")
    proxy.expect("Arming denied")
    proxy.type("long DO_SET_MODE 209 4 3")
    proxy.expect("Mode LOITER")


def _fly(proxy: Terminal) -> None:
    _arm(proxy)
    proxy.type("disarm")
    proxy.expect("Disarmed by external command")
    _arm(proxy)
    talk(
        proxy,
        ("long NAV_TAKEOFF 0 0 0 nan nan nan nan", "NAV_TAKEOFF: ACCEPTED", 15.0),
        ("", "Takeoff detected", 15.0),
        ("", "Mode LOITER", 20.0),
        ("disarm", "Disarming denied: not landed", 15.0),
        ("long NAV_LAND 0 0 0 nan 0 0 0", "Landing at current position", 15.0),
        ("", "Landing detected", 20.0),
        ("", "Disarmed by landing", 15.0),
        ("long DO_SET_MODE 209 4 3", "DO_SET_MODE: ACCEPTED", 15.0),
    )


def _arm(proxy: Terminal) -> None:
    for _ in range(10):  # its checks are still running in the first seconds
        proxy.type("arm throttle")
        if "ACCEPTED" in proxy.expect(r"COMPONENT_ARM_DISARM: \w+").group():
            break
    proxy.expect("Armed by external command")
