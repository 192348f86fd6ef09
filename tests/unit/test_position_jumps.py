"""Jumps of the reported position, told from its noise."""

from __future__ import annotations

import numpy as np
import pytest

from offboard.flight.estimates import PositionJumps
from offboard.mavlink.events import LocalPosition

SPEED = (1.0, -0.5, 0.2)


def found(sd_m: float, jump_m: float) -> list[float]:
    """Sizes of the jumps found in 20 s at 100 Hz of steady motion with white noise and, at 10 s,
    a jump to the east."""
    random, jumps = np.random.default_rng(4), PositionJumps()
    sizes = []
    for time_s in np.arange(2000) / 100.0:
        place = time_s * np.array(SPEED) + random.normal(0.0, sd_m, 3)
        place[1] += jump_m * (time_s >= 10.0)
        jump = jumps.on_position(LocalPosition(float(time_s), tuple(place.tolist()), SPEED))
        if jump is not None and time_s > 1.0:
            sizes.append(float(np.linalg.norm(jump)))
    return sizes


@pytest.mark.parametrize("sd_m", [0.0, 0.05, 0.07, 0.1, 0.2])
def test_noise_is_no_jump(sd_m: float) -> None:
    assert found(sd_m, 0.0) == []


@pytest.mark.parametrize(("sd_m", "jump_m"), [(0.0, 0.35), (0.02, 0.5), (0.1, 2.0)])
def test_a_jump_is_found_in_noise(sd_m: float, jump_m: float) -> None:
    assert found(sd_m, jump_m) == [pytest.approx(jump_m, abs=6.0 * sd_m + 1e-9)]


@pytest.mark.parametrize(("rises_mps", "drift_m"), [(0.0, 1.0), (-0.2, 1.2)])
def test_a_position_that_leaves_its_velocity_drifts(rises_mps: float, drift_m: float) -> None:
    """In the steady state by the difference of the two velocities in one second; a jump is none."""
    jumps = PositionJumps()
    for time_s in np.arange(1000) / 100.0:
        height_m = rises_mps * time_s + 5.0 * (time_s >= 5.0)
        position = LocalPosition(float(time_s), (3.0, 4.0, float(height_m)), (0.0, 0.0, 1.0))
        jumps.on_position(position)
    assert jumps.drift_m == pytest.approx(drift_m, rel=0.01)
