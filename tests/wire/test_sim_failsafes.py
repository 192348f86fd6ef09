"""Failsafes by ground station, battery and position, and their parameters."""

from __future__ import annotations

from sim_bench import LAND, LOITER, OFFBOARD, Bench


def flying(parameter: str = "COM_LOW_BAT_ACT", value: float = 0) -> Bench:
    """In AUTO.LOITER, 2.5 m up."""
    bench = Bench()
    bench.boot()
    assert bench.instance.autopilot.parameters.set(parameter, value)
    bench.take_off()
    return bench


def drain(bench: Bench, remaining: float) -> None:
    bench.instance.autopilot.plant.set_battery(remaining)


def test_the_pilot_takes_over_before_the_failsafe_acts() -> None:
    bench = flying("COM_LOW_BAT_ACT", 2)
    drain(bench, 0.06)
    bench.run(2.0)
    bench.run(0.6, bench.attitude)
    assert bench.ask_mode(OFFBOARD) == [0, 0]
    bench.run(5.0, bench.attitude)
    assert (bench.mode, bench.system_status) == (OFFBOARD, 4)


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
