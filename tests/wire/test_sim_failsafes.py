"""Failsafes by battery and position, and what the estimator reports; recordings have the rest."""

from __future__ import annotations

import pytest
from sim_bench import LAND, LOITER, OFFBOARD, Bench, px4_vehicle

from simulator.config import Scenario
from simulator.faults import GpsLoss, VelocityError
from simulator.firmware.ardupilot import ARDUPILOT
from simulator.firmware.px4 import PX4


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


def test_estimator_reports_lose_the_position_with_the_fix() -> None:
    """PX4 after EKF2_NOAID_TOUT (5 s): the flags that it has before the first fix."""
    lost = Scenario(name="lost", faults=(GpsLoss(fault="gps_loss", at_s=4.0, for_s=8.0),))
    bench = Bench(scenario=lost, vehicle=px4_vehicle())
    bench.run(14.0)
    flags = {round(at_s): m.flags for at_s, m in bench.of("ESTIMATOR_STATUS")}
    assert [flags[second] for second in (4, 8, 10, 11, 13)] == [895, 895, 229, 229, 895]


@pytest.mark.parametrize(
    ("firmware", "message_id", "kind", "name", "ratios"),
    [
        (PX4, 230, "ESTIMATOR_STATUS", "vel_ratio", (0.12, 1.0, 4.0)),
        (ARDUPILOT, 193, "EKF_STATUS_REPORT", "velocity_variance", (0.02, 1.0, 2.0)),
    ],
    ids=["px4", "ardupilot"],
)  # fmt: skip
def test_ratio_of_a_wrong_velocity(
    firmware: object, message_id: int, kind: str, name: str, ratios: tuple[float, ...]
) -> None:
    """Innovation over gate times noise, 5 x 0.3 m/s; PX4 reports the square."""
    found = []
    for error_mps in (0.0, 1.5, 3.0):
        fault = VelocityError(fault="velocity_error", offset_ned_mps=(0.0, error_mps, 0.0))
        wrong = Scenario(name="wrong", faults=(fault,) if error_mps else ())
        wrong = wrong.model_copy(
            update={"conditions": wrong.conditions.model_copy(update={"boot_scale": 0.1})}
        )
        bench = Bench(firmware=firmware, scenario=wrong)  # type: ignore[arg-type]
        bench.boot()
        assert bench.command(512, message_id) == [0]
        found.append(getattr(bench.of(kind)[-1][1], name))
    assert found == pytest.approx(ratios)
