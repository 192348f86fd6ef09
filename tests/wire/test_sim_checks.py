"""MAV_CMD_RUN_PREARM_CHECKS and the estimator's report, as the firmwares answer."""

from __future__ import annotations

import pytest
from sim_bench import Bench, px4_vehicle

from simulator.config import Scenario
from simulator.faults import GpsLoss, VelocityError
from simulator.firmware.ardupilot import ARDUPILOT
from simulator.firmware.px4 import PX4

RUN_CHECKS, REQUEST_MESSAGE = 401, 512
ESTIMATOR_STATUS, EKF_STATUS_REPORT = 230, 193
ACCEPTED, TEMPORARILY_REJECTED = 0, 1
GUIDED = 4


def checked(bench: Bench) -> list[str]:
    since_s = bench.time_s
    assert bench.command(RUN_CHECKS) == [ACCEPTED]
    bench.run(0.1)
    return bench.texts(since_s)


def test_healthy_vehicles_say_nothing() -> None:
    for bench in (Bench(), Bench(firmware=ARDUPILOT, boot_scale=0.1)):
        bench.boot()
        assert checked(bench) == []


def test_arducopter_says_at_each_stage_of_its_start_what_refuses_arming() -> None:
    """The same as after an arm command, with another word in front."""
    bench = Bench(firmware=ARDUPILOT)
    bench.run(1.0)
    assert checked(bench) == ["PreArm: System not initialised"]
    bench.run(4.0)
    texts = checked(bench)
    assert "PreArm: EKF attitude is bad" in texts
    since_s = bench.time_s
    bench.command(400, 1)
    assert [t.replace("Arm:", "PreArm:", 1) for t in bench.texts(since_s)] == texts
    bench.run(20.0)
    assert checked(bench) == []  # STABILIZE needs no position
    bench.command(176, 1, GUIDED)
    assert checked(bench) == ["PreArm: Need Position Estimate"]


def test_arducopter_refuses_while_it_is_armed() -> None:
    bench = Bench(firmware=ARDUPILOT, boot_scale=0.1)
    bench.boot()
    assert bench.command(400, 1) == [ACCEPTED]
    assert bench.command(RUN_CHECKS) == [TEMPORARILY_REJECTED]


@pytest.mark.parametrize(
    ("arm_without_gps", "texts"),
    [(0, ["Preflight Fail: GPS fix too low"]), (1, ["Preflight: GPS fix too low"]), (2, [])],
)
def test_px4_without_a_fix(arm_without_gps: int, texts: list[str]) -> None:
    lost = Scenario(name="lost", faults=(GpsLoss(fault="gps_loss", at_s=3.0),))
    bench = Bench(scenario=lost, vehicle=px4_vehicle())
    bench.instance.autopilot.parameters.set("COM_ARM_WO_GPS", arm_without_gps)
    bench.run(5.0)
    assert checked(bench) == texts


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
        (PX4, ESTIMATOR_STATUS, "ESTIMATOR_STATUS", "vel_ratio", (0.12, 1.0, 4.0)),
        (ARDUPILOT, EKF_STATUS_REPORT, "EKF_STATUS_REPORT", "velocity_variance", (0.02, 1.0, 2.0)),
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
        assert bench.command(REQUEST_MESSAGE, message_id) == [ACCEPTED]
        found.append(getattr(bench.of(kind)[-1][1], name))
    assert found == pytest.approx(ratios)
