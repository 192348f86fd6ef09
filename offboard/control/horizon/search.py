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

from offboard.control.horizon.keep_out import PACKED_SIZE
from offboard.control.horizon.limits import VOLUME, excesses, limits_of, share_of
from offboard.control.horizon.plant import INPUTS, PLANT, SCENE, STATE_SIZE, Scene
from offboard.control.horizon.roll_out import roll_out
from offboard.control.swarm import RandomLanes, Swarm, SwarmSettings
from offboard.model.kernel import address

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
    """Runs roll-outs of one situation, which may have so many volumes to keep out of. What compiled
    code needs stays where it is in memory."""

    def __init__(self, steps: int, volumes: int) -> None:
        self.steps = steps
        self.knots = knot_weights(steps)
        self.plant, self._record = np.zeros(1, PLANT), np.zeros(1, SCENE)
        self._volumes = np.zeros((volumes, PACKED_SIZE))
        self._base = np.zeros((steps, INPUTS)), np.zeros((steps + 1, STATE_SIZE))
        self._nothing = np.zeros((steps, INPUTS)), np.zeros((steps + 1, STATE_SIZE))
        self._each_step = np.eye(steps)
        self._batches: dict[int, _Batch] = {}

    def settle(self, plant: NDArray[np.void], scene: Scene, start: Array) -> None:
        """The situation of the roll-outs that follow: one `PLANT`, and a state (STATE_SIZE,)."""
        self.scene = scene
        self.plant[:] = plant
        scene.fill(self._record, self._volumes)
        self._record["start"] = start

    @property
    def lower(self) -> Array:
        return self.scene.lower

    @property
    def upper(self) -> Array:
        return self.scene.upper

    def of_knots(self, base: Plan, knots: Array) -> Array:
        """Costs (n,) of knots (M, 3, n) about `base`; a plan is read with `picked`."""
        return self._run(base.inputs, base.states, knots)

    def of_inputs(self, inputs: Array) -> Array:
        """Costs (n,) of input sequences (N, 3, n), clipped to the bounds."""
        return self._run(None, None, inputs)

    def held(self, inputs: Array, states: Array) -> Plan:
        """What becomes of inputs (N, 3) with the feedback that holds states (N + 1, .)."""
        self._run(inputs, states, np.zeros((self.knots.shape[1], INPUTS, 1)))
        return self.picked(1, 0)

    def flown(self, inputs: Array) -> Plan:
        """What becomes of inputs (N, 3) without feedback."""
        self.of_inputs(inputs[:, :, None])
        return self.picked(1, 0)

    def picked(self, count: int, index: int) -> Plan:
        """Plan `index` of the last roll-outs with `count` particles."""
        batch = self._batches[count]
        inputs, states = batch.inputs[:, :, index].copy(), batch.states[:, :, index].copy()
        return Plan(inputs, states, float(batch.costs[index]))

    def rolled(self, count: int) -> tuple[Array, Array]:
        """States (N + 1, STATE_SIZE, count) of the last roll-outs with `count` particles, and by
        how much they exceed each limit: see `excesses`."""
        states = self._batches[count].states
        return states, self._excesses(states)

    def shares(self) -> Array:
        """(N * limits,): for how many seconds each of `excesses` is paid."""
        hold_s = float(self.plant["hold_s"][0])
        limits = range(limits_of(self._volumes))
        return np.tile([share_of(hold_s, limit) for limit in limits], self.steps)

    def meets(self, plan: Plan, margin_m: float) -> bool:
        """Whether a plan comes closer to the clearance of any volume than `margin_m`."""
        over = self._excesses(plan.states[:, :, None])
        return bool((over.reshape(self.steps, -1)[:, VOLUME:] > -margin_m).any())

    def _excesses(self, states: Array) -> Array:
        over = np.empty((self.steps * limits_of(self._volumes), states.shape[2]))
        situation = address(self.plant), address(self._record), self._volumes
        excesses.call(*situation, states, over)
        return over

    def _run(self, inputs: Array | None, states: Array | None, knots: Array) -> Array:
        count = knots.shape[2]
        batch = self._batches.get(count)
        if batch is None:
            batch = self._batches[count] = self._batch(count)
        if inputs is None:
            batch.sequences[:] = knots
            batch.fly_sequences()
        else:
            self._base[0][:], self._base[1][:] = inputs, states
            batch.knots[:] = knots
            batch.fly_knots()
        return batch.costs

    def _batch(self, count: int) -> _Batch:
        knots = np.empty((self.knots.shape[1], INPUTS, count))
        sequences, inputs = (np.empty((self.steps, INPUTS, count)) for _ in range(2))
        states = np.empty((self.steps + 1, STATE_SIZE, count))
        over, costs = (np.empty(count) for _ in range(2))
        situation, flown = (self.plant, self._record, self._volumes), (states, inputs, over, costs)
        about = roll_out.bound(*situation, *self._base, 1.0, self.knots, knots, *flown)
        alone = roll_out.bound(*situation, *self._nothing, 0.0, self._each_step, sequences, *flown)
        return _Batch(knots, sequences, about, alone, states, inputs, costs)


@dataclass(frozen=True, slots=True)
class _Batch:
    """The arrays of the roll-outs of so many particles: what they are given, and what comes out."""

    knots: Array
    sequences: Array
    fly_knots: Callable[[], int]
    fly_sequences: Callable[[], int]
    states: Array
    inputs: Array
    costs: Array


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
        knots = particles.ask().T.reshape(shape)
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
    return stacked.reshape(INPUTS, size // INPUTS, count).transpose(1, 0, 2)
