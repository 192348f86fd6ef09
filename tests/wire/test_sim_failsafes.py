"""Failsafes by ground station, battery and position, and their parameters."""

from __future__ import annotations

import pytest
from sim_bench import LAND, LOITER, OFFBOARD, RTL, Bench


def flying(parameter: str = "COM_LOW_BAT_ACT", value: float = 0) -> Bench:
    """In AUTO.LOITER, 2.5 m up."""
    bench = Bench()
    bench.boot()
    assert bench.instance.autopilot.parameters.set(parameter, value)
    bench.take_off()
    return bench


def drain(bench: Bench, remaining: float) -> None:
    bench.instance.autopilot.plant.set_battery(remaining)


@pytest.mark.parametrize(
    ("remaining", "action", "mode"),
    [
        (0.06, 3, RTL),
        (0.04, 2, LAND),
    ],
)
def test_a_low_battery_holds_then_acts(remaining: float, action: int, mode: int) -> None:
    bench = flying("COM_LOW_BAT_ACT", action)
    begun_s = bench.time_s
    drain(bench, remaining)
    bench.run(4.8)
    assert (bench.mode, bench.system_status) == (LOITER, 5)
    bench.run(0.5)
    assert (bench.mode, bench.system_status) == (mode, 5)
    level = "Critical battery" if remaining > 0.05 else "Emergency battery level"
    assert bench.texts(begun_s)[:3] == [
        level,
        "Failsafe activated: entering Hold for 5 seconds",
        "Failsafe activated",
    ]
    bench.run_until(lambda: not bench.armed, 40.0)


def test_by_default_a_battery_only_warns_of_each_level_once() -> None:
    bench = flying()
    begun_s = bench.time_s
    for remaining in (0.14, 0.06, 0.04):
        drain(bench, remaining)
        bench.run(1.0)
    assert bench.texts(begun_s) == [
        "Low battery",
        "Failsafe activated",
        "Critical battery",
        "Emergency battery level",
    ]
    assert (bench.mode, bench.system_status) == (LOITER, 4)


def test_the_pilot_takes_over_before_the_failsafe_acts() -> None:
    bench = flying("COM_LOW_BAT_ACT", 2)
    drain(bench, 0.06)
    bench.run(2.0)
    bench.run(0.6, bench.attitude)
    assert bench.ask_mode(OFFBOARD) == [0, 0]
    bench.run(5.0, bench.attitude)
    assert (bench.mode, bench.system_status) == (OFFBOARD, 4)


def test_setpoints_do_not_end_a_battery_failsafe() -> None:
    bench = flying("COM_LOW_BAT_ACT", 2)
    drain(bench, 0.06)
    bench.run(6.0, bench.attitude)
    assert bench.mode == LAND


def test_texts_are_held_for_a_ground_station_for_five_seconds() -> None:
    bench = flying("COM_LOW_BAT_ACT", 0)
    begun_s, bench.heartbeat_type = bench.time_s, None
    bench.run(4.0)
    drain(bench, 0.14)
    bench.run(2.0)
    drain(bench, 0.06)
    bench.run(3.8)
    assert bench.texts(begun_s) == []
    bench.heartbeat_type = 6
    bench.run(1.0)
    assert bench.texts(begun_s) == ["Critical battery"]  # the other was too old


def test_a_worse_battery_changes_the_delayed_failsafe() -> None:
    bench = flying("COM_LOW_BAT_ACT", 3)
    begun_s = bench.time_s
    drain(bench, 0.06)
    bench.run(2.0)
    drain(bench, 0.04)
    bench.run(2.8)
    assert bench.mode == LOITER
    bench.run(0.5)
    assert bench.mode == LAND  # and not RTL, and no later
    assert bench.texts(begun_s) == [
        "Critical battery",
        "Failsafe activated: entering Hold for 5 seconds",
        "Emergency battery level",
        "Failsafe activated",
    ]


def test_without_position_automatic_flight_lands_and_attitude_setpoints_continue() -> None:
    bench = flying()
    autopilot = bench.instance.autopilot
    autopilot.state.gps_healthy = False
    bench.run(4.5)
    assert bench.mode == LOITER
    bench.run(1.0)
    assert (bench.mode, bench.system_status) == (LAND, 5)
    autopilot.state.gps_healthy = True
    bench.run(0.5)
    assert (bench.mode, bench.system_status) == (LOITER, 4)
    bench.run(0.6, bench.attitude)
    bench.ask_mode(OFFBOARD)
    autopilot.state.gps_healthy = False
    bench.run(6.0, bench.attitude)
    assert (bench.mode, bench.system_status) == (OFFBOARD, 4)
