"""What a decision over a horizon costs: run with `--benchmark-enable`. Nothing asserts on time."""

from __future__ import annotations

import math
from itertools import cycle
from typing import Any

import numpy as np
import pytest

from offboard.config import load
from offboard.control.base import Command, PredictedState, Situation
from offboard.control.catalogue import LAWS, build
from offboard.reference.transfer import transfer

SPHERE = {"shape": "sphere", "north_m": 1.5, "east_m": 0.3, "height_m": 3.0, "radius_m": 0.4}
VEHICLE = load("flight").vehicle


def situations() -> list[Situation]:
    """Fifty states about a brisk transfer, a decision apart."""
    rng = np.random.default_rng(3)
    reference = transfer((0, 0, -3), (6, 2, -4), 0.0, 0.5)
    found = []
    for k in range(50):
        at_s = 0.1 * k
        sample = reference.sample(at_s + 0.057)
        tilt = 0.03 * rng.normal(size=2)
        state = PredictedState(
            at_s + 0.057,
            sample.position_ned_m + 0.1 * rng.normal(size=3),
            sample.velocity_ned_mps + 0.1 * rng.normal(size=3),
            np.array([*tilt, math.sqrt(1.0 - tilt @ tilt)]),
            np.zeros(3), 0.0, 0.0, 9.8, np.zeros(3), np.zeros(3),
        )  # fmt: skip
        level = Command(9.8, (0.0, 0.0, 1.0), 0.0)
        found.append(Situation(at_s, state, reference, level))
    return found


@pytest.mark.benchmark(group="one decision")
@pytest.mark.parametrize(
    ("law", "volumes"),
    [("pid", 0), ("lqr", 0), ("pso", 0), ("mpc", 0), ("horizon", 0), ("horizon", 1), ("horizon", 3),
     ("mppi", 0), ("mppi", 1), ("cem", 0), ("cem", 1)],
)  # fmt: skip
def test_decision(law: str, volumes: int, benchmark: Any) -> None:
    settings: dict[str, Any] = {"law": law}
    if volumes:
        settings["keep_out"] = [SPHERE] * volumes
    controller = build(LAWS[law].model_validate(settings), VEHICLE, 0.1, 7)  # type: ignore[arg-type]
    met = cycle(situations())
    controller.decide(next(met))
    decision = benchmark(lambda: controller.decide(next(met)))
    assert np.linalg.norm(decision.command.thrust_direction_ned) == pytest.approx(1.0)
