"""The fastest times through waypoints: within their limits, and no leg can be shorter."""

from __future__ import annotations

import numpy as np
import pytest

from offboard.reference.fastest import PathLimits, fastest_times
from offboard.reference.path import Smoothness, Spline, through

POINTS = ((0.0, 0.0, 0.0), (8.0, 3.0, 1.0), (12.0, 10.0, 3.0), (4.0, 12.0, 1.0), (0.0, 4.0, 2.0))
NED = np.array(POINTS) * (1.0, 1.0, -1.0)
GRAVITY, DRAG = np.array([0.0, 0.0, 9.80665]), 0.3
LIMITS = PathLimits(
    speed_mps=8.0, thrust_mps2=14.0, tilt_deg=35.0, tilt_rate_dps=90.0, drag_per_mass_ps=DRAG
)


def shares(path: Spline) -> tuple[float, float, float, float]:
    """The greatest speed, thrust, tilt and turn rate of the thrust, of their limits, from positions
    alone: by differences of a fine grid."""
    s, step_s = np.linspace(0.0, path.length_s, 40_001, retstep=True)
    position = path.jet(s)[0]
    velocity = np.gradient(position, step_s, axis=0)[3:-3]
    thrust = GRAVITY - np.gradient(velocity, step_s, axis=0) - DRAG * velocity
    size = np.linalg.norm(thrust, axis=1)[3:-3]
    direction = thrust[3:-3] / size[:, None]
    turned = np.linalg.norm(np.diff(direction, axis=0), axis=1) / step_s
    return (
        float(np.linalg.norm(velocity, axis=1).max() / LIMITS.speed_mps),
        float(size.max() / LIMITS.thrust_mps2),
        float(np.degrees(np.arccos(direction[:, 2])).max() / LIMITS.tilt_deg),
        float(np.degrees(turned).max() / LIMITS.tilt_rate_dps),
    )


@pytest.mark.parametrize("smoothness", [Smoothness.SNAP, Smoothness.JERK])
def test_the_fastest_path_keeps_its_limits_and_no_leg_can_be_shorter(
    smoothness: Smoothness,
) -> None:
    times_s = fastest_times(POINTS, smoothness, LIMITS)
    path = through(NED, times_s, smoothness)
    assert path.jet(times_s)[0] == pytest.approx(NED, abs=1e-9)
    assert 0.98 < max(shares(path)) < 1.01
    for leg in range(len(POINTS) - 1):
        legs_s = np.diff(times_s)
        legs_s[leg] *= 0.95
        shorter = through(NED, np.append(0.0, np.cumsum(legs_s)), smoothness)
        assert max(shares(shorter)) > 1.01, leg


def test_the_fastest_path_is_faster_than_the_best_constant_mean_speed() -> None:
    """By 8 % here: at one mean speed a single leg decides how fast all are flown."""
    times_s = fastest_times(POINTS, Smoothness.SNAP, LIMITS)
    lengths_m = np.linalg.norm(np.diff(NED, axis=0), axis=1) * (1.5, 1.0, 1.0, 1.5)
    even_s = np.append(0.0, np.cumsum(lengths_m)) * times_s[-1] / lengths_m.sum()
    assert max(shares(through(NED, 1.05 * even_s, Smoothness.SNAP))) > 1.01
