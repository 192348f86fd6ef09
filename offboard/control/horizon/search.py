"""The swarm's search for the knots of a plan, and its roll-outs.

A plan is a base (inputs and the states they lead to) that the feedback of the closed form follows,
plus a few knots interpolated over its steps. `Evaluator` runs the roll-outs.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

from offboard.control.horizon.keep_out import CENTRE, HALF, PACKED_SIZE, RADIUS, ROUND
from offboard.control.horizon.plant import (
    INPUTS,
    PLANT,
    SCENE,
    STATE_SIZE,
    P,
    Scene,
    V,
    W,
    Z,
    start_state,
)
from offboard.control.horizon.roll_out import VOLUME, excesses, limits_of, roll_out, share_of
from offboard.control.law import Task
from offboard.control.swarm import Swarm, SwarmSettings

Array = NDArray[np.float64]
Remaining = Callable[[], float] | None

# Places of the knots as fractions of the plan: dense at its start, which is what is commanded
KNOT_SHARES = (0.0, 0.15, 0.4, 0.8)
NEAR_M = 1.0  # volumes whose clearance is further from the reference need no detour
# Axis NED and sign: a detour never passes below a volume
SIDES = ((0, 1.0), (0, -1.0), (1, 1.0), (1, -1.0), (2, -1.0))
ROWS = ((P, V), (P + 1, V + 1), (Z, W))  # position and velocity of each axis in a state


@dataclass(frozen=True, slots=True)
class Plan:
    """Inputs (N, 3), the states (N + 1, STATE_SIZE) they lead to, and the cost."""

    inputs: Array
    states: Array
    cost: float


@dataclass(frozen=True, slots=True)
class Found:
    """The plan that a search ended with; `spread` of its last knots."""

    plan: Plan
    spread: float
    iterations: int
    cut_short: bool


def knot_weights(steps: int) -> Array:
    """Weights (N, M) of M knots in each step: linear between knots, constant after the last."""
    places = sorted({round(share * (steps - 1)) for share in KNOT_SHARES})
    every = np.arange(steps)
    return np.column_stack([np.interp(every, places, unit) for unit in np.eye(len(places))])


class Evaluator:
    """Runs roll-outs of `steps` holds in one situation, with `volumes` keep-out volumes."""

    def __init__(self, steps: int, volumes: int) -> None:
        self.steps = steps
        self.knots = knot_weights(steps)
        self.plant, self._record = np.zeros(1, PLANT), np.zeros(1, SCENE)
        self._volumes = np.zeros((volumes, PACKED_SIZE))
        self._nothing = np.zeros((steps, INPUTS)), np.zeros((steps + 1, STATE_SIZE))
        self._each_step = np.eye(steps)
        self._batches: dict[int, _Batch] = {}

    def prepare(self, plant: NDArray[np.void], scene: Scene, task: Task) -> None:
        """Set the situation of the next roll-outs: one `PLANT`, the scene, and the task whose
        state they start from."""
        self.scene = scene
        self.plant[:] = plant
        scene.fill(self._record, self._volumes)
        self._record["start"] = start_state(task, scene.ahead)

    @property
    def lower(self) -> Array:
        """Lower bounds of the inputs, (N, 3)."""
        return self.scene.within.lower

    @property
    def upper(self) -> Array:
        """Upper bounds of the inputs, (N, 3)."""
        return self.scene.within.upper

    def of_knots(self, base: Plan, knots: Array) -> Array:
        """Costs (n,) of knots (M, 3, n) about `base`; `plan` returns one of these plans."""
        return self._run((base.inputs, base.states), 1.0, self.knots, knots)

    def of_inputs(self, inputs: Array) -> Array:
        """Costs (n,) of input sequences (N, 3, n), clipped to the bounds."""
        return self._run(self._nothing, 0.0, self._each_step, inputs)

    def follow(self, inputs: Array, states: Array) -> Plan:
        """The plan of inputs (N, 3) plus feedback towards states (N + 1, STATE_SIZE)."""
        no_knots = np.zeros((self.knots.shape[1], INPUTS, 1))
        self._run((inputs, states), 1.0, self.knots, no_knots)
        return self.plan(1, 0)

    def open_loop(self, inputs: Array) -> Plan:
        """The plan of inputs (N, 3) without feedback."""
        self.of_inputs(inputs[:, :, None])
        return self.plan(1, 0)

    def plan(self, count: int, index: int) -> Plan:
        """Plan number `index` of the last roll-outs with `count` particles."""
        batch = self._batches[count]
        inputs, states = batch.inputs[:, :, index].copy(), batch.states[:, :, index].copy()
        return Plan(inputs, states, float(batch.costs[index]))

    def last_states(self, count: int) -> tuple[Array, Array]:
        """States (N + 1, STATE_SIZE, count) of the last roll-outs with `count` particles, and
        their `excesses`."""
        states = self._batches[count].states
        return states, self._excesses(states)

    def shares(self) -> Array:
        """(N * limits,): the seconds for which each of `excesses` is penalised."""
        hold_s = float(self.plant["hold_s"][0])
        limits = range(limits_of(self._volumes))
        return np.tile([share_of(hold_s, limit) for limit in limits], self.steps)

    def is_near(self, plan: Plan, margin_m: float) -> bool:
        """Whether a plan comes within `margin_m` of the clearance of any volume, or into it."""
        over = self._excesses(plan.states[:, :, None])
        return bool((over.reshape(self.steps, -1)[:, VOLUME:] > -margin_m).any())

    def _excesses(self, states: Array) -> Array:
        over = np.empty((self.steps * limits_of(self._volumes), states.shape[2]))
        excesses(self.plant, self._record, self._volumes, states, over)
        return over

    def _run(
        self, base: tuple[Array, Array], feedback: float, weights: Array, knots: Array
    ) -> Array:
        count = knots.shape[2]
        batch = self._batches.get(count)
        if batch is None:
            batch = self._batches[count] = _Batch(self.steps, count)
        base_inputs, base_states, knots = map(np.ascontiguousarray, (*base, knots))
        roll_out(
            self.plant, self._record, self._volumes,
            base_inputs, base_states, feedback, weights, knots,
            batch.states, batch.inputs, batch.over, batch.costs,
        )  # fmt: skip
        return batch.costs


class _Batch:
    """Arrays for the results of `roll_out` with `count` particles, made once."""

    def __init__(self, steps: int, count: int) -> None:
        self.states = np.empty((steps + 1, STATE_SIZE, count))
        self.inputs = np.empty((steps, INPUTS, count))
        self.over, self.costs = np.empty(count), np.empty(count)


def swarm(
    evaluate: Evaluator,
    base: Plan,
    reach: Array,
    settings: SwarmSettings,
    rng: np.random.Generator,
    remaining_s: Remaining,
) -> Found:
    """The best plan whose knots are within +-reach (M, 3) about `base`. The first particle starts
    at the base, so the answer is never worse."""
    limit = reach.ravel()
    starts = _starts(settings.particles, len(limit)) * limit
    particles = Swarm(settings, -limit, limit, rng, starts)
    shape = (*reach.shape, settings.particles)
    best, cut_short = base, False
    for iteration in range(settings.iterations):
        knots = particles.ask().T.reshape(shape)
        costs = evaluate.of_knots(base, knots)
        first = int(np.argmin(costs))
        if costs[first] < best.cost:
            best = evaluate.plan(settings.particles, first)
        particles.tell(costs)
        if remaining_s is not None and remaining_s() <= 0 and iteration + 1 < settings.iterations:
            cut_short = True
            break
    result = particles.result(cut_short)
    return Found(best, result.spread, result.iterations, cut_short)


@cache
def _starts(count: int, size: int) -> Array:
    """Where the particles start, (count, size), as fractions of their bounds: the first at the
    base, the others scattered about it, each wider than the one before. Equal in all decisions;
    their motion is random."""
    drawn = np.random.default_rng(count).uniform(-1.0, 1.0, (count, size))
    widened: Array = np.linspace(0.0, 1.0, count)[:, None] * drawn
    return widened


def sequences(stacked: Array) -> Array:
    """Inputs (3 N, n) in the order of `HorizonQuadratic` as (N, 3, n)."""
    size, count = stacked.shape
    return stacked.reshape(INPUTS, size // INPUTS, count).transpose(1, 0, 2)


def detours(scene: Scene, reach_m: float) -> list[Array]:
    """Ways round the volumes that are near the reference, one past each side of each, as states
    (N + 1, STATE_SIZE) that the closed form follows. A way need not be good, the search improves
    it; but the search alone would not find the other side of a wide volume. `reach_m` is the
    distance to keep from the surface of a volume."""
    ways = []
    places, speeds = scene.ahead.positions_ned_m[::2], scene.ahead.velocities_ned_mps[::2]
    for volume in scene.volumes:
        half = volume[HALF : HALF + 3] + volume[ROUND]
        half[:2] += volume[RADIUS]
        centre = volume[CENTRE : CENTRE + 3]
        off = np.abs(places - centre) - half - reach_m
        if not bool((off < NEAR_M).all(axis=1).any()):
            continue
        for axis, sign in SIDES:
            way = np.zeros((len(places), STATE_SIZE))
            beside = centre[axis] + sign * (half[axis] + reach_m)
            past = sign * (beside - places[:, axis]) > 0.0
            position, velocity = ROWS[axis]
            way[past, position] = beside - places[past, axis]
            way[past, velocity] = -speeds[past, axis]
            ways.append(way)
    return ways
