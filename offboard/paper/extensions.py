"""What the paper's conclusions propose, for the same law: an integral term, and state limits.

Integral: the state of Eq. 5 is extended by xi, the tracking error of [x y z psi] summed over time,
and xi(k+1) is weighted like any other state. State limits: an input is allowed only if a linear
regulator could stop the vehicle from x(k+1) on within all limits and its own bounds (a maximal
output admissible set, Gilbert and Tan 1991), so on the linear model limits once kept are always
kept. In the hover model each of these conditions depends on one input only and narrows a bound of
Eq. 22. Both leave a quadratic in four bounded inputs.
"""

from __future__ import annotations

from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from offboard.documents.parameters import Parameters
from offboard.model.rigid_body import PHI, PSI, THETA, P, Q, R, U, V, W, X, Z

Array = NDArray[np.float64]
Weight = Annotated[float, Field(ge=0)]
Limit = Annotated[float, Field(gt=0)]

INTEGRATED = (X, X + 1, Z, PSI)  # indices in Eq. 5
_MOVING = [PHI, THETA, P, Q, R, U, V, W]  # in the hover model independent of position and heading
_LOOK_AHEAD = 80  # steps of the regulator, after which all motion has ended
_SLIGHT = 1e-9  # of an input's greatest influence on any condition: counts as none
_REACH = 3.0  # the regulator uses a third of the input bounds at the limit of a state


class IntegralSettings(Parameters):
    """`weights` of the squared summed errors of x, y, z (m s) and psi (rad s); each sum is kept
    within +-`limits`."""

    weights: tuple[Weight, Weight, Weight, Weight] = (80.0, 80.0, 15.0, 0.0)
    limits: tuple[Limit, Limit, Limit, Limit] = (200.0, 200.0, 200.0, 5.0)


class ErrorIntegral:
    """xi (4,), summed at each step. While the input is at its bound (`held`) the sum stops: it
    could not be acted upon and would have to be unwound later."""

    def __init__(self, settings: IntegralSettings, step_s: float) -> None:
        self._limits, self._step_s = np.array(settings.limits), step_s
        self.value = np.zeros(len(INTEGRATED))

    def add(self, error: Array, held: bool = False) -> Array:
        """Add the error (4,) of this step, state minus reference, and return the sum (4,)."""
        if not held and np.isfinite(error).all():
            total = self.value + self._step_s * error
            self.value = np.clip(total, -self._limits, self._limits)
        return self.value


def along_heading(summed: Array, heading_rad: float) -> Array:
    """A sum (4,) in axes along and across the nose; errors are summed in NED, in which a wind is
    constant."""
    cosine, sine = np.cos(heading_rad), np.sin(heading_rad)
    north, east, down, heading = summed
    return np.array([cosine * north + sine * east, cosine * east - sine * north, down, heading])


def with_error_sum(dynamics: Array, inputs: Array, step_s: float) -> tuple[Array, Array, Array]:
    """A (16, 16) and B (16, 4) of [x, xi] from those of Eq. 14, and E (16, 12) of its reference.

    xi(k+1) = xi(k) + step_s S (x(k+1) - x_ref(k+1)), where S selects `INTEGRATED`; the reference of
    [x, xi] is E x_ref(k+1).
    """
    size, count = len(dynamics), len(INTEGRATED)
    summing = step_s * np.eye(size)[list(INTEGRATED)]
    upper = np.hstack([dynamics, np.zeros((size, count))])
    lower = np.hstack([summing @ dynamics, np.eye(count)])
    whole = np.vstack([inputs, summing @ inputs])
    return np.vstack([upper, lower]), whole, np.vstack([np.eye(size), summing])


class StateLimits(Parameters):
    """Largest magnitudes; None: not limited. Speeds are per axis of the heading frame.

    `margin` is the fraction of every limit that is reserved for errors of the linear model.
    """

    tilt_rad: Limit | None = None  # phi and theta
    tilt_rate_radps: Limit | None = None  # p and q
    yaw_rate_radps: Limit | None = None  # r
    speed_mps: Limit | None = None  # u and v
    climb_mps: Limit | None = None  # w
    margin: float = Field(default=0.0, ge=0, lt=1)

    def per_state(self) -> dict[int, float]:
        """{index in Eq. 5: largest magnitude}, reduced by the margin."""
        tilt, rate, speed = self.tilt_rad, self.tilt_rate_radps, self.speed_mps
        each = (tilt, tilt, rate, rate, self.yaw_rate_radps, speed, speed, self.climb_mps)
        given = zip(_MOVING, each, strict=True)
        return {index: (1.0 - self.margin) * limit for index, limit in given if limit is not None}


class LimitedBox:
    """The bounds of Eq. 22, narrowed at each state to inputs after which all limits can be kept.

    dynamics (12, 12), inputs (12, 4): Eq. 14; lower < 0 < upper (4,). Raises ValueError where a
    condition depends on several inputs.
    """

    def __init__(
        self, dynamics: Array, inputs: Array, limits: StateLimits, lower: Array, upper: Array
    ) -> None:
        import control  # takes a second: only where something is designed

        a, b = dynamics[np.ix_(_MOVING, _MOVING)], inputs[_MOVING]
        self._lower, self._upper = lower, upper
        most = limits.per_state()
        scale = [most.get(index, 1.0) for index in _MOVING]
        energy = np.diag(np.square(_REACH / np.minimum(-lower, upper)))
        self._gain, _, _ = control.dlqr(a, b, np.diag(1.0 / np.square(scale)), energy)
        limited = np.eye(len(_MOVING))[[_MOVING.index(index) for index in most]]
        once = np.vstack([limited, -limited, -self._gain, self._gain])
        ceiling = np.concatenate([[*most.values()] * 2, upper, -lower])
        # x(k+1) is safe if rows @ x(k+1) <= ceiling, `_LOOK_AHEAD` times
        closed, rows = a - b @ self._gain, [once]
        power = np.eye(len(a))
        for _ in range(_LOOK_AHEAD - 1):
            power = closed @ power
            rows.append(once @ power)
        influence = np.vstack(rows) @ b
        # Exactly zero where axes do not couple, and nearly zero in late steps of the look-ahead
        depends = np.abs(influence) > _SLIGHT * np.abs(influence).max(axis=0)
        if (depends.sum(axis=1) > 1).any():
            raise ValueError("state limits need axes that do not couple")
        kept = depends.any(axis=1)
        self._channel = np.argmax(depends[kept], axis=1)
        self._slope = influence[kept, self._channel]
        self._free = np.vstack(rows)[kept] @ a
        self._ceiling = np.tile(ceiling, _LOOK_AHEAD)[kept]

    def narrow(self, state: Array) -> tuple[Array, Array]:
        """Lower and upper (4,) at the state x(k) (12,). Where no input keeps the limits (after a
        gust, or a start outside of them), both are the input of the regulator."""
        inside = state[_MOVING]
        edges = (self._ceiling - self._free @ inside) / self._slope
        lower, upper = self._lower.copy(), self._upper.copy()
        above = self._slope > 0
        np.minimum.at(upper, self._channel[above], edges[above])
        np.maximum.at(lower, self._channel[~above], edges[~above])
        braking = np.clip(-self._gain @ inside, self._lower, self._upper)
        empty = lower > upper
        lower[empty] = upper[empty] = braking[empty]
        return lower, upper
