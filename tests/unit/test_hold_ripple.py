"""The ripple of held commands: against a staircase that SciPy integrates, and what it costs."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from attitude_plant import Truth, fly, lemniscate
from laws import PX4, G, at, lqr
from scipy.integrate import solve_ivp

from offboard.control.gains import thrust_ripple, tilt_ripple
from offboard.reference.base import FlatSample

PERIOD_S = 0.1
HOLDS = 60


def _after(held: bool) -> np.ndarray:
    """[b, b', T] (3,) after HOLDS of the ramp u = t, or of the staircase through its middles."""
    wn, z, lag = PX4.tilt.natural_frequency_radps, PX4.tilt.damping, PX4.thrust_lag_s
    x = np.zeros(3)
    for k in range(HOLDS):
        middle = (k + 0.5) * PERIOD_S

        def motion(t: float, x: np.ndarray, middle: float = middle) -> list[float]:
            u = middle if held else t
            return [x[1], wn**2 * (u - x[0]) - 2 * z * wn * x[1], (u - x[2]) / lag]

        x = solve_ivp(motion, (k * PERIOD_S, (k + 1) * PERIOD_S), x, rtol=1e-10, atol=1e-12).y[
            :, -1
        ]
    return x


def test_ripple_is_what_a_staircase_leaves_where_it_steps() -> None:
    off = _after(held=True) - _after(held=False)
    assert tilt_ripple(PX4, PERIOD_S) == pytest.approx(off[:2], abs=1e-6)
    assert thrust_ripple(PX4, PERIOD_S) == pytest.approx(off[2], abs=1e-6)


@dataclass
class Jerking:
    """At rest, level and unaccelerated at 0.057 s, with a constant jerk, NED."""

    jerk_ned_mps3: tuple[float, float, float]
    duration_s = 3600.0

    def sample(self, time_s: float | np.ndarray) -> FlatSample:
        time = np.asarray(time_s, dtype=np.float64)[..., None] - 0.057
        jerk = np.array(self.jerk_ned_mps3) + 0.0 * time
        none, still = np.zeros_like(jerk), np.zeros_like(time[..., 0])
        position, velocity = time**3 / 6.0 * jerk, 0.5 * time**2 * jerk
        return FlatSample(position, velocity, time * jerk, jerk, none, still, still, still)


def test_the_target_ripples_as_the_staircase_does() -> None:
    """At a jerk of 1 m/s^3 b_c is a ramp of -1 / g per second, T one of -1 m/s^2 per second."""
    without_drag = PX4.model_copy(update={"drag_translation_npmps": (0.0,) * 3})
    law = lqr(vehicle=without_drag)
    off = _after(held=True) - _after(held=False)
    level = at((0.0, 0.0, 0.0), 0.0)
    target = law.target(Jerking((1.0, -1.0, 0.0)), 0.0, level)
    assert target.lateral[2] == pytest.approx(np.array([-1.0, 1.0]) / G * off[0], rel=1e-3)
    leaning = np.array([-1.0, 1.0]) / G
    assert target.lateral[3] == pytest.approx(leaning * (1.0 + off[1]), rel=1e-3)
    climbing = law.target(Jerking((0.0, 0.0, 1.0)), 0.0, level)
    assert climbing.vertical[2] - G == pytest.approx(-off[2], rel=1e-3)


@pytest.mark.parametrize(("vertical_m", "most_m"), [(0.0, 0.0002), (0.4, 0.0008)])
def test_what_is_left_on_a_known_vehicle(vertical_m: float, most_m: float) -> None:
    """Without noise, everything known: 0.8 and 1.5 mm by a law that fights its own ripple."""
    reference = lemniscate(8.0, vertical_m=vertical_m)
    assert fly(Truth(PX4), lqr(), PX4, reference, 16.0) < most_m
