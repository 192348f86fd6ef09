"""Limits on state variables, which the paper's conclusions ask for, as bounds on the next input.

A limit checked at k+1 alone can be kept until it cannot: at the edge with a rate outwards no input
helps. So an input is admitted only if from x(k+1) on a fixed linear regulator would stop the
vehicle without any limit, or its own input, being exceeded (a maximal output admissible set,
Gilbert and Tan 1991). The regulator's own input is then always admitted, whatever happened before:
what is kept once is kept for ever, on the linear model exactly. In the hover model each of these
conditions meets one input only, so they narrow the box of Eq. 22; swarm and certificate stay.
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

_STATES = (PHI, THETA, P, Q, R, U, V, W)  # closed in the hover model: neither position nor course
_LOOK_AHEAD = 80  # steps of the regulator; what is left of any motion after them is nothing
_SLIGHT = 1e-9  # of an input's greatest influence on any condition: none
_REACH = 3.0  # the regulator brakes gently: a limit's full error asks for a third of the box

Bound = Annotated[float, Field(gt=0)]


class StateLimits(Parameters):
    """Largest magnitudes; what is absent is not limited. Speeds are in the heading frame, per axis.

    `margin` keeps this fraction of every limit free for what the linear model leaves out.
    """

    tilt_rad: Bound | None = None  # phi and theta
    tilt_rate_radps: Bound | None = None  # p and q
    yaw_rate_radps: Bound | None = None  # r
    speed_mps: Bound | None = None  # u and v
    climb_mps: Bound | None = None  # w
    margin: float = Field(default=0.0, ge=0, lt=1)

    def per_state(self) -> dict[int, float]:
        """{index in Eq. 5: largest magnitude}, less the margin."""
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
    """The box of Eq. 22, narrowed at each state to the inputs after which all limits can be held.

    dynamics (12, 12), inputs (12, 4): Eq. 14; lower < 0 < upper (4,). Raises ValueError where a
    limited state answers to several inputs or a limit can never be held.
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
        # An exact zero where axes do not couple; late steps of the look-ahead fade to nothing
        meets = np.abs(influence) > _SLIGHT * np.abs(influence).max(axis=0)
        if (meets.sum(axis=1) > 1).any():
            raise ValueError("state limits need axes that do not couple")
        kept = meets.any(axis=1)
        self._channel = np.argmax(meets[kept], axis=1)
        self._slope = influence[kept, self._channel]
        self._free = rows[kept] @ a
        self._ceiling = ceilings[kept]

    def narrow(self, state: Array) -> tuple[Array, Array]:
        """Lower and upper (4,) at the state x(k) (12,), one of finite width or a single point.

        Where no input keeps the limits any more (a gust, a start outside), the regulator's.
        """
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
    """K (4, 8) of u = -K x, which stops the vehicle: Riccati, scaled by limits and box."""
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
