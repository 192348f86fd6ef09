"""Searches for the knots of a plan, and the polish of what they find.

A plan is a base (inputs and the states they lead to), held by the closed form's feedback, plus a
few knots interpolated over its steps. The searches know it only through `Evaluator`, which runs
the roll-outs; `swarm`, `mppi` and `cem` spend the same number of them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

from offboard.control.horizon.limits import VOLUME, excesses, limits_of, share_of
from offboard.control.horizon.plant import INPUTS, STATE_SIZE, Plant, Scene
from offboard.control.horizon.roll_out import roll_out
from offboard.control.swarm import RandomLanes, Swarm, SwarmSettings

Array = NDArray[np.float64]
Remaining = Callable[[], float] | None

# Steps of the knots: dense where the next command is, sparse where it will be decided again
KNOT_SHARES = (0.0, 0.15, 0.4, 0.8)


@dataclass(frozen=True, slots=True)
class Plan:
    """Inputs (N, 3), the states (N + 1, STATE_SIZE) they lead to, and the cost."""

    inputs: Array
    states: Array
    cost: float


@dataclass(frozen=True, slots=True)
class Found:
    """The plan a search ended with and how."""

    plan: Plan
    spread: float
    iterations: int
    cut_short: bool


def knot_weights(steps: int) -> Array:
    """(N, M): linear between knots, held after the last one."""
    places = sorted({round(share * (steps - 1)) for share in KNOT_SHARES})
    weights = np.zeros((steps, len(places)))
    for step in range(steps):
        for m in range(len(places)):
            unit = np.zeros(len(places))
            unit[m] = 1.0
            weights[step, m] = np.interp(step, places, unit)
    return weights


class Evaluator:
    """Runs roll-outs of one situation; arrays are made once per number of particles."""

    def __init__(self, steps: int) -> None:
        self.steps = steps
        self.knots = knot_weights(steps)
        self._each_step = np.eye(steps)
        self._arrays: dict[int, tuple[Array, Array, Array]] = {}
        self._no_states = np.zeros((steps + 1, STATE_SIZE))

    def settle(self, plant: Plant, scene: Scene, start: Array) -> None:
        """The situation of the roll-outs that follow."""
        self._plant, self._scene, self._start = plant, scene, start

    @property
    def scene(self) -> Scene:
        return self._scene

    @property
    def lower(self) -> Array:
        return self._scene.lower

    @property
    def upper(self) -> Array:
        return self._scene.upper

    def of_knots(self, base: Plan, knots: Array) -> Array:
        """Costs (n,) of knots (M, 3, n) about `base`; a plan is read with `picked`."""
        return self._run(base.inputs, base.states, 1.0, self.knots, knots)

    def of_inputs(self, inputs: Array) -> Array:
        """Costs (n,) of input sequences (N, 3, n), clipped to the bounds."""
        nothing = np.zeros((self.steps, INPUTS))
        return self._run(nothing, self._no_states, 0.0, self._each_step, inputs)

    def held(self, inputs: Array, states: Array) -> Plan:
        """What becomes of inputs (N, 3) with the feedback that holds states (N + 1, .)."""
        none = np.zeros((self.knots.shape[1], INPUTS, 1))
        self._run(inputs, states, 1.0, self.knots, none)
        return self.picked(1, 0)

    def flown(self, inputs: Array) -> Plan:
        """What becomes of inputs (N, 3) without feedback."""
        self.of_inputs(np.ascontiguousarray(inputs[:, :, None]))
        return self.picked(1, 0)

    def picked(self, count: int, index: int) -> Plan:
        """Plan `index` of the last roll-outs with `count` particles."""
        states, inputs, costs = self._arrays[count]
        return Plan(inputs[:, :, index].copy(), states[:, :, index].copy(), float(costs[index]))

    @property
    def plant(self) -> Plant:
        return self._plant

    def rolled(self, count: int) -> tuple[Array, Array]:
        """States (N + 1, STATE_SIZE, count) of the last roll-outs with `count` particles, and by
        how much they exceed each limit: see `excesses`."""
        states = self._arrays[count][0]
        over = np.empty((self.steps * limits_of(self._scene), count))
        excesses(self._plant, self._scene, states, over)
        return states, over

    def shares(self) -> Array:
        """(N * limits,): for how many seconds each of `excesses` is paid."""
        limits = range(limits_of(self._scene))
        return np.tile([share_of(self._plant, limit) for limit in limits], self.steps)

    def meets(self, plan: Plan, margin_m: float) -> bool:
        """Whether a plan comes closer to the clearance of any volume than `margin_m`."""
        over = np.empty((self.steps * limits_of(self._scene), 1))
        excesses(self._plant, self._scene, plan.states[:, :, None], over)
        return bool((over.reshape(self.steps, -1)[:, VOLUME:] > -margin_m).any())

    def _run(
        self, inputs: Array, states: Array, feedback: float, weights: Array, knots: Array
    ) -> Array:
        count = knots.shape[2]
        if count not in self._arrays:
            self._arrays[count] = (
                np.empty((self.steps + 1, STATE_SIZE, count)),
                np.empty((self.steps, INPUTS, count)),
                np.empty(count),
            )
        arrays = self._arrays[count]
        roll_out(
            self._plant, self._scene, self._start, inputs, states, feedback, weights, knots, *arrays
        )
        return arrays[2]


def swarm(
    evaluate: Evaluator,
    base: Plan,
    reach: Array,
    settings: SwarmSettings,
    lanes: RandomLanes,
    remaining_s: Remaining,
) -> Found:
    """Particles of knots within +-reach (M, 3) of `base`; the first one stands on it, and so
    the answer is never worse."""
    limit = reach.ravel()
    particles = Swarm(-limit, limit, settings, lanes, _graded(limit, settings.particles))
    shape = (*reach.shape, settings.particles)
    best, cut_short = base, False
    for iteration in range(settings.iterations):
        knots = np.ascontiguousarray(particles.ask().T).reshape(shape)
        costs = evaluate.of_knots(base, knots)
        first = int(np.argmin(np.where(np.isfinite(costs), costs, np.inf)))
        if costs[first] < best.cost:
            best = evaluate.picked(settings.particles, first)
        particles.tell(costs)
        if remaining_s is not None and remaining_s() <= 0 and iteration + 1 < settings.iterations:
            cut_short = True
            break
    result = particles.result(cut_short)
    return Found(best, result.spread, result.iterations, cut_short)


def _graded(limit: Array, count: int) -> list[Array]:
    """Where the particles start, (n,) each: the first on the base, the others scattered about it,
    ever wider. The same at each decision: what differs is their motion."""
    return list(_directions(count, len(limit)) * limit)


@cache
def _directions(count: int, size: int) -> Array:
    drawn = np.random.default_rng(count).uniform(-1.0, 1.0, (count, size))
    widened: Array = np.linspace(0.0, 1.0, count)[:, None] * drawn
    return widened


def sequences(stacked: Array) -> Array:
    """(3 N, n) of the quadratic's order to (N, 3, n)."""
    size, count = stacked.shape
    return np.ascontiguousarray(stacked.reshape(INPUTS, size // INPUTS, count).transpose(1, 0, 2))
