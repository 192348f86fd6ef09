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
