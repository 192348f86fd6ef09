"""Flights of the simulated PX4: stream loss, takeoff, landing, automatic disarm, setpoint rules."""

from __future__ import annotations

import math

import pytest
from sim_bench import HOVER, NAN, OFFBOARD, Bench, px4_vehicle

from simulator.vehicle.sensors import EstimatorName


def set_parameter(bench: Bench, name: str, value: float) -> None:
    assert bench.instance.autopilot.parameters.set(name, value)


def offboard_attitude() -> Bench:
    """In the air, level, engaged by attitude setpoints that have just ended."""
    bench = Bench()
    bench.fly_offboard()
    bench.run(0.5, bench.attitude)
    return bench


# -- the stream ------------------------------------------------------------------------------


def test_until_the_loss_the_last_attitude_and_thrust_continue() -> None:
    bench = offboard_attitude()
    roll = math.radians(8.0)
    bench.run(0.8, lambda: bench.attitude((math.cos(roll / 2), math.sin(roll / 2), 0, 0)))
    bench.run(0.9)
    _, attitude = bench.of("ATTITUDE")[-1]
    assert attitude.roll == pytest.approx(roll, abs=0.01)
    assert bench.mode == OFFBOARD


@pytest.mark.parametrize(("period_s", "trips"), [(0.8, False), (1 / 1.5, False), (1 / 0.9, True)])
def test_the_least_rate(period_s: float, trips: bool) -> None:
    bench = offboard_attitude()
    bench.run(6.0, bench.attitude, period_s)
    assert ("Failsafe activated" in bench.texts()) is trips


# -- automatic flight ------------------------------------------------------------------------


@pytest.mark.parametrize("hover_thrust", [0.15, 0.2, 0.8])
def test_vehicles_far_from_the_believed_hover_thrust_hold_and_land(hover_thrust: float) -> None:
    """MPC_THR_HOVER is 0.5; the integral, of up to g, makes up for the rest."""
    believed = px4_vehicle()
    bench = Bench(vehicle=believed.model_copy(update={"hover_thrust": hover_thrust}))
    bench.fly_offboard(2.0)
    bench.run(8.0, lambda: bench.position(0, 0, -2))
    assert bench.height_m == pytest.approx(2.0, abs=0.02)
    bench.command(21)
    bench.run_until(lambda: not bench.armed, 16.0)


def test_a_least_thrust_that_lifts_never_lands() -> None:
    """PX4 1.16.1's SIH that hovers at 0.1 climbed in AUTO.LAND at 1.7 .. 2.3 m/s."""
    bench = Bench(vehicle=px4_vehicle().model_copy(update={"hover_thrust": 0.1}))
    bench.fly_offboard(2.0)
    bench.command(21)
    bench.run(10.0)
    assert -bench.instance.autopilot.state.truth.velocity_ned_mps[2] == pytest.approx(2.0, abs=0.3)
    set_parameter(bench, "MPC_THR_MIN", 0.05)
    bench.run_until(lambda: not bench.armed, 60.0)


@pytest.mark.parametrize("estimator", [EstimatorName.PERFECT, EstimatorName.PX4_LIKE])
def test_hold_by_position_setpoints_is_as_good_as_the_estimate(estimator: EstimatorName) -> None:
    """Its own loop feeds the raw velocity back: PX4 wanders by 0.47 m in hover, 0.26-0.56."""
    bench = Bench(estimator, seed=3)
    bench.boot()
    bench.run(0.6, lambda: bench.position(0, 0, -5))
    bench.ask_mode(OFFBOARD)
    bench.command(400, 1)
    bench.run(12.0, lambda: bench.position(0, 0, -5))
    begun_s = bench.time_s
    seconds = 10.0 if estimator is EstimatorName.PERFECT else 60.0
    bench.run(seconds, lambda: bench.position(0, 0, -5))
    squares = [m.x**2 + m.y**2 + (m.z + 5) ** 2 for _, m in bench.of("LOCAL_POSITION_NED", begun_s)]
    rms_m = math.sqrt(sum(squares) / len(squares))
    if estimator is EstimatorName.PERFECT:
        assert rms_m < 0.02
    else:
        assert 0.15 < rms_m < 0.8


# -- attitude setpoints: PX4's rules and lack of checks ---------------------------------------


def climb_rate_after(bench: Bench, duration_s: float, **setpoint: object) -> float:
    bench.run(duration_s, lambda: bench.attitude(**setpoint))
    return -float(bench.instance.autopilot.state.truth.velocity_ned_mps[2])


@pytest.mark.parametrize(
    ("setpoint", "low", "high"),
    [
        ({"thrust": HOVER}, -0.1, 0.1),
        ({"thrust": math.nan}, -5.0, -2.5),
        ({"thrust": HOVER, "mask": 71}, -5.0, -2.5),
        ({"thrust": -1.0}, -5.0, -2.5),
        ({"thrust": 1.5}, 2.5, 6.0),
        ({"quaternion": (2.0, 0, 0, 0)}, -0.1, 0.1),
        ({"quaternion": (0.0, 0, 0, 0)}, -0.1, 0.1),
        ({"quaternion": (NAN, 0, 0, 0)}, -0.1, 0.1),
    ],
)
def test_thrust_outside_its_range_is_clipped_or_zero(
    setpoint: dict, low: float, high: float
) -> None:
    bench = offboard_attitude()
    assert low < climb_rate_after(bench, 0.6, **setpoint) < high


# -- going where it is told --------------------------------------------------------------------


def test_position_gains_and_speeds_are_obeyed_while_flying() -> None:
    bench = Bench()
    bench.fly_offboard()
    assert bench.instance.autopilot.parameters.set("MPC_XY_VEL_MAX", 1.0)
    bench.run(9.0, lambda: bench.position(20, 0, -3))
    speed_mps = math.hypot(*bench.instance.autopilot.state.truth.velocity_ned_mps[:2])
    assert speed_mps == pytest.approx(1.0, abs=0.1)
