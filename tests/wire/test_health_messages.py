"""Messages about the vehicle's health: read as the autopilots send them."""

from __future__ import annotations

import math
from typing import Any

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from vehicle_frames import PEER, Sender, pinned

from offboard.mavlink import events

NAN = math.nan


def received(message: Any) -> events.Event:
    vehicle = Sender()
    session = pinned(vehicle)
    (event,) = session.receive(vehicle.frame(message), PEER, 0.0).events
    return event


def px4(flags: int, *ratios: float) -> events.EstimatorReport:
    message = mavlink.MAVLink_estimator_status_message(10**6, flags, *ratios, 0.3, 0.3)
    report = received(message)
    assert isinstance(report, events.EstimatorReport)
    return report


def test_estimator_of_px4() -> None:
    """Flags and ratios of a recording of 1.16.1: before GPS, on the ground, in flight."""
    waiting = px4(229, NAN, NAN, 0.02, NAN, 0.003, NAN)
    assert (waiting.attitude_ok, waiting.height_ok) == (True, True)
    assert waiting.problem == "its estimator has no valid horizontal velocity, horizontal position"
    for flags in (1023, 895, 831):
        good = px4(flags, 0.04, 0.031, 0.018, 0.072, 0.001, NAN)
        assert good.problem == ""
        assert good.worst == ("heading", pytest.approx(0.072))
    bad = px4(831, 1.3, 0.1, 0.1, 0.1, NAN, NAN)
    assert bad.problem == "its estimator rejects GPS velocity (innovation ratio 1.30, limit 1)"


def test_estimator_of_arducopter() -> None:
    """Flags of a recording of 4.6.3."""

    def report(flags: int, velocity: float) -> events.Event:
        return received(
            mavlink.MAVLink_ekf_status_report_message(flags, velocity, 0.01, 0.0, 0.03, 0.0, NAN)
        )

    for flags, valid in ((1024, False), (0, False), (167, False), (831, True)):
        found = report(flags, 0.0)
        assert isinstance(found, events.EstimatorReport)
        assert found.position_ok is valid
    rejected = report(831, 1.2)
    assert isinstance(rejected, events.EstimatorReport)
    assert rejected.worst == ("GPS velocity", pytest.approx(1.2))


@pytest.mark.parametrize(
    ("number", "version"), [(0x011001FF, (1, 16, 1, 255)), (0x040603FF, (4, 6, 3, 255))]
)
def test_version(number: int, version: tuple[int, ...]) -> None:
    none = bytes(8)
    message = mavlink.MAVLink_autopilot_version_message(
        0, number, 0, 0, 0, none, none, none, 0, 0, 77
    )
    assert received(message) == events.VehicleIdentity(77, events.FirmwareVersion(*version))


def test_system_time() -> None:
    message = mavlink.MAVLink_system_time_message(1_767_225_600_000_000, 5000)
    assert received(message) == events.SystemTime(pytest.approx(1_767_225_600.0))


@pytest.mark.parametrize(
    ("present", "health", "radio"), [(1, 1, True), (1, 0, False), (0, 1, False)]
)
def test_radio_is_present_and_healthy(present: int, health: int, radio: bool) -> None:
    bit = 0x10000
    message = mavlink.MAVLink_sys_status_message(
        present * bit, 0, health * bit, 0, 12000, 0, 50, 0, 0, 0, 0, 0, 0
    )
    event = received(message)
    assert isinstance(event, events.SystemHealth)
    assert event.radio_ok is radio
