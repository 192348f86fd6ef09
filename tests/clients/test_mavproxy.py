"""MAVProxy on a terminal flies the simulator, as it flies a real PX4 1.16.1."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from terminal import Terminal
from vehicle_process import vehicle

from simulator.firmware.px4 import PX4

MAVPROXY = Path(sys.executable).with_name("mavproxy.py")


@pytest.fixture
def proxy(tmp_path: Path) -> Iterator[Terminal]:
    with vehicle() as port:
        command = (sys.executable, str(MAVPROXY), f"--master=udpin:127.0.0.1:{port}", "--no-state")
        with Terminal(command, str(tmp_path)) as terminal:
            yield terminal


def test_a_session_with_two_flights(proxy: Terminal) -> None:
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
    proxy.type("long NAV_TAKEOFF 0 0 0 nan nan nan nan")
    proxy.expect("NAV_TAKEOFF: ACCEPTED")
    proxy.expect("Takeoff detected")
    proxy.expect("Mode LOITER", 20.0)
    proxy.type("disarm")
    proxy.expect("Disarming denied: not landed")
    proxy.type("long NAV_LAND 0 0 0 nan 0 0 0")
    proxy.expect("Landing at current position")
    proxy.expect("Landing detected", 20.0)
    proxy.expect("Disarmed by landing")
    proxy.type("long DO_SET_MODE 209 4 3")
    proxy.expect("DO_SET_MODE: ACCEPTED")


def _arm(proxy: Terminal) -> None:
    for _ in range(10):  # its checks are still running in the first seconds
        proxy.type("arm throttle")
        if "ACCEPTED" in proxy.expect(r"COMPONENT_ARM_DISARM: \w+").group():
            break
    proxy.expect("Armed by external command")
