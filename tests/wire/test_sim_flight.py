"""Flights of the simulated PX4: stream and position lost, hold and landing, setpoint rules."""

from __future__ import annotations

import math
from typing import Any

import pytest
from sim_bench import HOVER, LAND, LOITER, NAN, OFFBOARD, Bench, aloft, engaged, hold

from simulator import config


def climb_mps(bench: Bench) -> float:
    return -bench.velocity[2]


def test_without_position_automatic_flight_lands_and_attitude_setpoints_continue() -> None:
    bench = aloft()
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


@pytest.mark.parametrize("hover_thrust", [0.15, 0.8])
def test_vehicles_far_from_the_believed_hover_thrust_hold_and_land(hover_thrust: float) -> None:
    """MPC_THR_HOVER is 0.5; the integral, of up to g, makes up for the rest."""
    believed = config.vehicle("px4_sih")
    bench = Bench(vehicle=believed.model_copy(update={"hover_thrust": hover_thrust}))
    bench.fly_offboard(2.0)
    hold(bench, 8.0, 2.0)
    assert bench.height_m == pytest.approx(2.0, abs=0.02)
    bench.command(21)
    bench.run_until(lambda: not bench.armed, 16.0)


def test_a_least_thrust_that_lifts_never_lands() -> None:
    """PX4 1.16.1's SIH that hovers at 0.1 climbed in AUTO.LAND at 1.7 .. 2.3 m/s."""
    believed = config.vehicle("px4_sih")
    bench = Bench(vehicle=believed.model_copy(update={"hover_thrust": 0.1}))
    bench.fly_offboard(2.0)
    bench.command(21)
    bench.run(4.0)
    assert climb_mps(bench) == pytest.approx(2.0, abs=0.3)
    bench.set("MPC_THR_MIN", 0.05)
    bench.run_until(lambda: not bench.armed, 60.0)


def test_thrust_outside_its_range_is_clipped_or_zero_and_quaternions_are_not_checked() -> None:
    setpoints: tuple[tuple[dict[str, Any], float, float], ...] = (
        ({"thrust": HOVER}, -0.1, 0.1),
        ({"quaternion": (2.0, 0, 0, 0)}, -0.1, 0.1),
        ({"quaternion": (0.0, 0, 0, 0)}, -0.1, 0.1),
        ({"quaternion": (NAN, 0, 0, 0)}, -0.1, 0.1),
        ({"thrust": math.nan}, -5.0, -2.5),
        ({"thrust": HOVER, "mask": 71}, -5.0, -2.5),
        ({"thrust": -1.0}, -5.0, -2.5),
        ({"thrust": 1.5}, 2.5, 6.0),
    )
    bench = engaged()
    for setpoint, low, high in setpoints:
        hold(bench, 3.0)
        before_mps = climb_mps(bench)
        bench.run(0.6, lambda given=setpoint: bench.attitude(**given))
        assert low < climb_mps(bench) - before_mps < high


def test_the_least_rate_until_which_the_last_attitude_continues() -> None:
    bench, half = engaged(), math.radians(1.0)
    quaternion = math.cos(half), math.sin(half), 0.0, 0.0
    for period_s in (0.8, 1 / 1.5):
        bench.run(4.0, lambda: bench.attitude(quaternion), period_s)
        assert bench.of("ATTITUDE")[-1][1].roll == pytest.approx(math.radians(2.0), abs=0.01)
        assert bench.mode == OFFBOARD
    assert "Failsafe activated" not in bench.texts()
    bench.run(4.0, bench.attitude, 1 / 0.9)
    assert "Failsafe activated" in bench.texts()


def test_arming_needs_a_battery_and_with_nav_dll_act_a_ground_station() -> None:
    bench = Bench(heartbeat_type=None)
    bench.set("NAV_DLL_ACT", 1)
    bench.run(5.0)
    assert bench.command(400, 1) == [1]  # none was ever heard
    bench.heartbeat_type = 6
    for remaining, result in ((0.06, 1), (0.1, 0)):
        bench.instance.autopilot.plant.set_battery(remaining)
        bench.run(1.1)
        assert bench.command(400, 1) == [result]


def test_a_landing_goes_on_without_a_ground_station() -> None:
    bench = aloft(height_m=30.0)
    bench.set("NAV_DLL_ACT", 2)
    bench.command(21)
    bench.heartbeat_type = None
    bench.run(14.0)
    assert (bench.mode, bench.system_status) == (LAND, 4)
    assert "Failsafe activated" not in "".join(bench.texts())


def test_the_pilot_takes_over_before_the_failsafe_acts() -> None:
    bench = aloft()
    bench.set("COM_LOW_BAT_ACT", 2)
    bench.instance.autopilot.plant.set_battery(0.06)
    bench.run(2.6, bench.attitude)
    assert bench.ask_mode(OFFBOARD) == [0, 0]
    bench.run(5.0, bench.attitude)
    assert (bench.mode, bench.system_status) == (OFFBOARD, 4)
