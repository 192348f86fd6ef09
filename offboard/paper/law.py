"""The paper's law on any plant of Eq. 14: settings, and one input u(k) per state and reference.

J(u) = e'Qe + u'Ru + (u - u(k-1))'R_du(u - u(k-1)),  e = x_ref(k+1) - A x - B u

is Eq. 21, a quadratic in u; the swarm searches for its minimum within the bounds of Eq. 22. With
two extensions that the conclusions propose, J stays a quadratic in four bounded inputs. Integral
term: the state of Eq. 5 is extended by xi, the tracking error of [x y z psi] summed over time, and
xi(k+1) is weighted like any other state. State limits: see `LimitedBox`. This module knows no
vehicle and no autopilot.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field
from scipy.linalg import block_diag

from offboard.control.quadratic import BoxQuadratic, at_bound
from offboard.control.swarm import SwarmResult, SwarmSettings, minimise
from offboard.documents.parameters import Parameters
from offboard.model.rigid_body import PHI, PSI, THETA, P, Q, R, U, V, W, X, Z

Array = NDArray[np.float64]
Weight = Annotated[float, Field(ge=0)]
Limit = Annotated[float, Field(gt=0)]
Four = tuple[float, float, float, float]
FourWeights = tuple[Weight, Weight, Weight, Weight]
TwelveWeights = tuple[
    Weight, Weight, Weight, Weight, Weight, Weight, Weight, Weight, Weight, Weight, Weight, Weight
]

PAPER_STEP_S = 0.1  # sampling time that reproduces Eq. 16; the paper prints 0.05

INTEGRATED = (X, X + 1, Z, PSI)  # indices in Eq. 5
# States that in the hover model do not depend on position and heading
_MOVING = [PHI, THETA, P, Q, R, U, V, W]
_LOOK_AHEAD = 80  # steps of the regulator, after which all motion has ended
_SLIGHT = 1e-9  # a smaller share of an input's greatest influence counts as no influence
_REACH = 3.0  # the regulator uses a third of the input bounds at the limit of a state


class IntegralSettings(Parameters):
    """Settings of the integral term: `weights` of the squared summed errors of x, y, z (m s) and
    psi (rad s). Each sum is kept within +-`limits`."""

    weights: FourWeights = (80.0, 80.0, 15.0, 0.0)
    limits: tuple[Limit, Limit, Limit, Limit] = (200.0, 200.0, 200.0, 5.0)


class StateLimits(Parameters):
    """Largest magnitudes of states; None: not limited. Speeds are per axis of the heading frame.

    `margin` is the fraction of every limit that is reserved for errors of the linear model.
    """

    tilt_rad: Limit | None = None  # phi and theta
    tilt_rate_radps: Limit | None = None  # p and q
    yaw_rate_radps: Limit | None = None  # r
    speed_mps: Limit | None = None  # u and v
    climb_mps: Limit | None = None  # w
    margin: float = Field(default=0.0, ge=0, lt=1)

    def per_state(self) -> dict[int, float]:
        """Return {index in Eq. 5: largest magnitude reduced by the margin}."""
        tilt, rate, speed = self.tilt_rad, self.tilt_rate_radps, self.speed_mps
        each = (tilt, tilt, rate, rate, self.yaw_rate_radps, speed, speed, self.climb_mps)
        given = zip(_MOVING, each, strict=True)
        return {index: (1.0 - self.margin) * limit for index, limit in given if limit is not None}


class PaperSettings(Parameters):
    """Weights, bounds and swarm of the paper, by default the final ones (section 4.3).

    States are in the order of Eq. 5, SI (psi in radians). Inputs are those of the paper's vehicle,
    relative to hover. For another vehicle they are scaled so that the same numbers cause the same
    accelerations, and bounds and weights keep their meaning; f_t is limited further so that the
    total thrust is neither negative nor above the vehicle's maximum.

    `integral` adds the summed position and heading error to the cost, `limits` keeps tilt, rates
    and speeds within bounds; without them the law is the paper's.
    """

    fitness: TwelveWeights = (1, 1, 25, 1, 1, 1, 20, 20, 5, 20, 20, 5)  # diag Q, Eq. 33
    energy: FourWeights = (0.00057, 0.125, 0.125, 0.5)  # diag R, Eq. 34
    rate: FourWeights = (1, 1, 1, 1)  # diag R_du, Eqs. 25 and 35
    lower: Four = (-4.0, -0.2, -0.2, -0.1)  # N, N, N, N m, Eq. 26
    upper: Four = (3.942, 0.2, 0.2, 0.1)  # Eq. 26
    keep_constant: bool = True  # the constant of J; its rounding determines epsilon of Eq. 29
    integral: IntegralSettings | None = None
    limits: StateLimits | None = None
    swarm: SwarmSettings = SwarmSettings()

    @classmethod
    def first_configuration(cls) -> PaperSettings:
        """Return the settings of section 4.1: Q = I (the paper does not print Eq. 23; I gives its
        magnitudes), R of Eq. 24, no damping, and no rebound, which gives the paper's epsilon."""
        return cls(
            fitness=(1,) * 12,
            energy=(0.0057, 1.25, 1.25, 5.0),
            swarm=SwarmSettings(damping=1.0, rebound=0.0),
        )


@dataclass(frozen=True, slots=True)
class Move:
    """The inputs u(k) (4,), the state x(k+1) (12,) that follows, the problem and its result."""

    inputs: Array
    following: Array
    problem: BoxQuadratic
    result: SwarmResult


class PaperLaw:
    """The law on any plant of Eq. 14: dynamics (12, 12), inputs (12, 4), lower and upper (4,).

    Its memory is the last input (for R_du), the summed error and the random stream; `reset` clears
    it. `terminal` (12, 12) replaces diag(Q): with the Riccati solution of the same weights the
    minimum is optimal over an infinite horizon. Raises ValueError if this plant cannot keep the
    state limits of the settings.
    """

    def __init__(
        self,
        dynamics: Array,
        inputs: Array,
        settings: PaperSettings,
        lower: Array | None = None,
        upper: Array | None = None,
        terminal: Array | None = None,
        step_s: float = PAPER_STEP_S,
        seed: int = 0,
    ) -> None:
        self._settings, self._seed, self._step_s = settings, seed, step_s
        self._lower = np.array(settings.lower if lower is None else lower, np.float64)
        self._upper = np.array(settings.upper if upper is None else upper, np.float64)
        weight = np.diag(settings.fitness) if terminal is None else terminal
        self._limits = (
            LimitedBox(dynamics, inputs, settings.limits, self._lower, self._upper)
            if settings.limits
            else None
        )
        if settings.integral:
            dynamics, inputs, self._extend_reference = with_error_sum(dynamics, inputs, step_s)
            weight = block_diag(weight, np.diag(settings.integral.weights))
        self._dynamics, self._inputs, self._weight = dynamics, inputs, weight
        self._rate = np.diag(settings.rate)
        curvature = inputs.T @ weight @ inputs + np.diag(settings.energy) + self._rate
        self._hessian = curvature + curvature.T
        self.reset()

    def reset(self) -> None:
        """Forget the last input and the summed error, and restart the random stream."""
        self._previous = np.zeros(len(self._lower))
        self._summed = np.zeros(len(INTEGRATED))
        self._held = False  # whether the last input was at its bound
        self._rng = np.random.default_rng(self._seed)

    def move(
        self,
        state: Array,
        reference_next: Array,
        remaining_s: Callable[[], float] | None = None,
        *,
        error: Array | None = None,
        heading_rad: float = 0.0,
    ) -> Move:
        """Return u(k) for the state x(k) (12,) and the reference x_ref(k+1) (12,), Eq. 27.

        `error` (4,) is the present error of `INTEGRATED`, NED, which the integral term sums;
        `heading_rad` is the heading of the axes of `state`; `remaining_s` is that of
        `swarm.minimise`.
        """
        bounds = self._limits.narrow(state) if self._limits else (self._lower, self._upper)
        whole = state
        if self._settings.integral:
            self._sum(error, self._settings.integral)
            whole = np.concatenate([state, along_heading(self._summed, heading_rad)])
            reference_next = self._extend_reference @ reference_next
        problem = BoxQuadratic(self._hessian, *self._slope(whole, reference_next), *bounds)
        result = minimise(self._settings.swarm, problem, self._rng, remaining_s=remaining_s)
        self._previous = result.best
        self._held = at_bound(problem, result.best)
        following = whole @ self._dynamics.T + result.best @ self._inputs.T
        return Move(result.best, following[: len(state)], problem, result)

    def _sum(self, error: Array | None, settings: IntegralSettings) -> None:
        """Add the error (4,) of this step to the sum, but not while the input is at its bound
        (anti-windup)."""
        if error is not None and not self._held and np.isfinite(error).all():
            limits = np.array(settings.limits)
            self._summed = np.clip(self._summed + self._step_s * error, -limits, limits)

    def _slope(self, state: Array, reference_next: Array) -> tuple[Array, float]:
        """Return gradient (4,) and constant of Eq. 21 at u = 0. The constant does not move the
        minimum, but its rounding limits epsilon of Eq. 29: only with it does epsilon equal that of
        the paper."""
        error = self._dynamics @ state - reference_next
        weighed, pull = self._weight @ error, self._rate @ self._previous
        gradient = 2.0 * (self._inputs.T @ weighed - pull)
        if not self._settings.keep_constant:
            return gradient, 0.0
        return gradient, float(error @ weighed + self._previous @ pull)


def along_heading(summed: Array, heading_rad: float) -> Array:
    """Return a summed error (4,) in axes along and across the nose. Errors are summed in NED,
    because a wind is constant there."""
    cosine, sine = np.cos(heading_rad), np.sin(heading_rad)
    north, east, down, heading = summed
    return np.array([cosine * north + sine * east, cosine * east - sine * north, down, heading])


def with_error_sum(dynamics: Array, inputs: Array, step_s: float) -> tuple[Array, Array, Array]:
    """Return A (16, 16) and B (16, 4) of [x, xi] from those of Eq. 14, and E (16, 12).

    xi(k+1) = xi(k) + step_s S (x(k+1) - x_ref(k+1)), where S selects `INTEGRATED`; the reference of
    [x, xi] is E x_ref(k+1).
    """
    size, count = len(dynamics), len(INTEGRATED)
    summing = step_s * np.eye(size)[list(INTEGRATED)]
    upper = np.hstack([dynamics, np.zeros((size, count))])
    lower = np.hstack([summing @ dynamics, np.eye(count)])
    whole = np.vstack([inputs, summing @ inputs])
    return np.vstack([upper, lower]), whole, np.vstack([np.eye(size), summing])


class LimitedBox:
    """The bounds of Eq. 22, narrowed at each state to inputs after which all limits can be kept.

    An input is allowed only if a linear regulator could stop the vehicle from x(k+1) on within all
    limits and its own bounds (a maximal output admissible set, Gilbert and Tan 1991). On the linear
    model, limits that are kept once are therefore always kept. In the hover model each of these
    conditions depends on one input only and narrows a bound of Eq. 22.

    dynamics (12, 12), inputs (12, 4): Eq. 14; lower < 0 < upper (4,). Raises ValueError if a
    condition depends on several inputs.
    """

    def __init__(
        self, dynamics: Array, inputs: Array, limits: StateLimits, lower: Array, upper: Array
    ) -> None:
        import control  # takes a second: imported only for a design

        a, b = dynamics[np.ix_(_MOVING, _MOVING)], inputs[_MOVING]
        self._lower, self._upper = lower, upper
        most = limits.per_state()
        scale = [most.get(index, 1.0) for index in _MOVING]
        energy = np.diag(np.square(_REACH / np.minimum(-lower, upper)))
        self._gain, _, _ = control.dlqr(a, b, np.diag(1.0 / np.square(scale)), energy)
        limited = np.eye(len(_MOVING))[[_MOVING.index(index) for index in most]]
        once = np.vstack([limited, -limited, -self._gain, self._gain])
        ceiling = np.concatenate([[*most.values()] * 2, upper, -lower])
        # x(k+1) is safe if rows @ x(k+1) <= ceiling, for each step of the look-ahead
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
        """Return lower and upper bounds (4,) at the state x(k) (12,). If no input keeps the limits
        (after a gust, or a start outside of them), both equal the input of the regulator."""
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
