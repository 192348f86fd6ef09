"""Limits on state variables, which the paper's conclusions propose, as bounds on the next input.

Checking a limit at k+1 alone is not enough: at the limit with a rate outwards no input keeps it any
more. Therefore an input is allowed only if a fixed linear regulator could stop the vehicle from
x(k+1) on without exceeding any limit or the bounds of its own input (a maximal output admissible
set, Gilbert and Tan 1991). The regulator's input is then always allowed, so on the linear model the
limits are kept for ever once they are kept. In the hover model each of these conditions depends on
one input only; they narrow the bounds of Eq. 22, and swarm and certificate are the same.
"""

from __future__ import annotations

from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from scipy.linalg import solve_discrete_are

from offboard.documents.parameters import Parameters
from offboard.model.state import PHI, THETA, P, Q, R, U, V, W

Array = NDArray[np.float64]

_STATES = (PHI, THETA, P, Q, R, U, V, W)  # in the hover model independent of position and course
_LOOK_AHEAD = 80  # steps of the regulator, after which all motion has ended
_SLIGHT = 1e-9  # of an input's greatest influence on any condition: counts as none
_REACH = 3.0  # the regulator uses a third of the input bounds at the limit of a state

Bound = Annotated[float, Field(gt=0)]


class StateLimits(Parameters):
    """Largest magnitudes; None: not limited. Speeds are per axis of the heading frame.

    `margin` is the fraction of every limit that is reserved for errors of the linear model.
    """

    tilt_rad: Bound | None = None  # phi and theta
    tilt_rate_radps: Bound | None = None  # p and q
    yaw_rate_radps: Bound | None = None  # r
    speed_mps: Bound | None = None  # u and v
    climb_mps: Bound | None = None  # w
    margin: float = Field(default=0.0, ge=0, lt=1)

    def per_state(self) -> dict[int, float]:
        """{index in Eq. 5: largest magnitude}, reduced by the margin."""
        groups = (
            (self.tilt_rad, (PHI, THETA)),
            (self.tilt_rate_radps, (P, Q)),
            (self.yaw_rate_radps, (R,)),
            (self.speed_mps, (U, V)),
            (self.climb_mps, (W,)),
        )
        return {
            index: (1.0 - self.margin) * limit
            for limit, indices in groups
            if limit is not None
            for index in indices
        }


class LimitedBox:
    """The bounds of Eq. 22, narrowed at each state to inputs after which all limits can be kept.

    dynamics (12, 12), inputs (12, 4): Eq. 14; lower < 0 < upper (4,). Raises ValueError where a
    condition depends on several inputs.
    """

    def __init__(
        self, dynamics: Array, inputs: Array, limits: StateLimits, lower: Array, upper: Array
    ) -> None:
        states = list(_STATES)
        a, b = dynamics[np.ix_(states, states)], inputs[states]
        self._lower, self._upper = lower, upper
        magnitudes = limits.per_state()
        self._gain = _regulator(a, b, np.minimum(-lower, upper), magnitudes)
        rows, ceilings = _conditions(a, b, self._gain, lower, upper, magnitudes)
        influence = rows @ b
        # Exactly zero where axes do not couple, and nearly zero in late steps of the look-ahead
        depends = np.abs(influence) > _SLIGHT * np.abs(influence).max(axis=0)
        if (depends.sum(axis=1) > 1).any():
            raise ValueError("state limits need axes that do not couple")
        kept = depends.any(axis=1)
        self._channel = np.argmax(depends[kept], axis=1)
        self._slope = influence[kept, self._channel]
        self._free = rows[kept] @ a
        self._ceiling = ceilings[kept]

    def narrow(self, state: Array) -> tuple[Array, Array]:
        """Lower and upper (4,) at the state x(k) (12,). Where no input keeps the limits (after a
        gust, or a start outside of them), both are the input of the regulator."""
        inside = state[list(_STATES)]
        edges = (self._ceiling - self._free @ inside) / self._slope
        lower, upper = self._lower.copy(), self._upper.copy()
        above = self._slope > 0
        np.minimum.at(upper, self._channel[above], edges[above])
        np.maximum.at(lower, self._channel[~above], edges[~above])
        braking = np.clip(-self._gain @ inside, self._lower, self._upper)
        empty = lower > upper
        lower[empty] = upper[empty] = braking[empty]
        return lower, upper


def _regulator(a: Array, b: Array, box: Array, magnitudes: dict[int, float]) -> Array:
    """K (4, 8) of u = -K x, which stops the vehicle: Riccati, scaled by the limits and bounds."""
    scale = [magnitudes.get(index, 1.0) for index in _STATES]
    weight = np.diag(1.0 / np.square(scale))
    energy = np.diag(np.square(_REACH / box))
    p = solve_discrete_are(a, b, weight, energy)
    gain: Array = np.linalg.solve(energy + b.T @ p @ b, b.T @ p @ a)
    return gain


def _conditions(
    a: Array, b: Array, gain: Array, lower: Array, upper: Array, magnitudes: dict[int, float]
) -> tuple[Array, Array]:
    """rows (M, 8) and ceilings (M,): x(k+1) is safe if rows @ x(k+1) <= ceilings."""
    pick = np.eye(len(_STATES))[[_STATES.index(index) for index in magnitudes]]
    most = np.array(list(magnitudes.values()))
    once = np.vstack([pick, -pick, -gain, gain])
    ceiling = np.concatenate([most, most, upper, -lower])
    closed = a - b @ gain
    rows, power = [], np.eye(len(a))
    for _ in range(_LOOK_AHEAD):
        rows.append(once @ power)
        power = closed @ power
    return np.vstack(rows), np.tile(ceiling, _LOOK_AHEAD)
