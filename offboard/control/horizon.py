"""The law `horizon`: the swarm over N decisions of nonlinear roll-outs, around keep-out volumes.

A plan is a base (inputs and the states they lead to), which the feedback of the closed form
follows, plus a few knots of the inputs, interpolated over its steps. The first base is the cheaper
of the closed form's plan and the previous plan. The cheapest of the following are bases too, if
they cost less: the exact plan of the linear problem (`mpc`), the ways past each side of each
volume, and the reference flown no faster than a speed limit. The swarm searches for the best knots
about each base; the result never costs more than any of these.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from operator import attrgetter
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from offboard.control.base import Certificate, Decision, DecisionError, Situation
from offboard.control.keep_out import CENTRE, HALF, RADIUS, ROUND, KeepOut, pack, placed_at, refusal
from offboard.control.law import TrackingLaw, TrackingProblem, TrackingSettings, decision
from offboard.control.mpc import MOST_STEPS, OUTLOOK, HorizonQuadratic, look_ahead
from offboard.control.quadratic import ExactMinimum
from offboard.control.roll_out import (
    INPUTS,
    STATE_SIZE,
    B,
    F,
    P,
    T,
    V,
    W,
    Z,
    plant_of,
    roll_out,
)
from offboard.control.swarm import Swarm, SwarmSettings
from offboard.model.axes import b_z_of
from offboard.model.vehicle import Vehicle
from offboard.reference.base import Reference

Array = NDArray[np.float64]

STEPS, STEPS_AROUND = 10, 20
VERTICAL_REACH_MPS2 = 3.0  # largest knots of the vertical thrust
PLANNED_MARGIN_M = 0.05  # beyond the clearance: for tracking errors, and because it is a soft limit
RIVALS = 2  # bases, besides our own plan, that the swarm also searches about
DETOUR_M = 1.0  # volumes whose clearance is further from the reference need no detour
COST = attrgetter("cost")  # sort key of plans; infinite if a roll-out is not finite

# Places of the knots as fractions of the plan: dense at its start, because that is commanded
KNOT_SHARES = (0.0, 0.15, 0.4, 0.8)
# NED axis and sign of the sides that detours pass; none passes below a volume
SIDES = ((0, 1.0), (0, -1.0), (1, 1.0), (1, -1.0), (2, -1.0))
ROWS = ((P, V), (P + 1, V + 1), (Z, W))  # position and velocity of each axis in a state


class HorizonSettings(TrackingSettings):
    """Settings of the law `horizon`.

    `steps` is the number of decisions planned (default: 10; with keep-out volumes 20, so that a
    way round one fits in), `keep_out` the volumes to avoid by at least `clearance_m`,
    `speed_limit_mps` the highest speed (default: unlimited).
    """

    law: Literal["horizon"] = "horizon"
    steps: int | None = Field(default=None, ge=2, le=MOST_STEPS)
    keep_out: tuple[KeepOut, ...] = ()
    clearance_m: float = Field(default=0.3, ge=0, le=50)
    speed_limit_mps: float | None = Field(default=None, gt=0, le=50)
    swarm: SwarmSettings = SwarmSettings(particles=20, iterations=40, damping=0.8)

    @property
    def planned(self) -> int:
        """Number of decisions planned, as set or by default."""
        return self.steps or (STEPS_AROUND if self.keep_out else STEPS)

    @property
    def reach_m(self) -> float:
        """Distance that plans keep from the surface of a volume, m."""
        return self.clearance_m + PLANNED_MARGIN_M

    def build(self, vehicle: Vehicle, *, period_s: float, seed: int) -> HorizonLaw:
        return HorizonLaw(vehicle, self, period_s=period_s, seed=seed)

    def refusal(self, reference: Reference) -> str | None:
        return refusal(self.keep_out, self.clearance_m, reference)


@dataclass(frozen=True, slots=True)
class Plan:
    """Inputs (N, 3), the states (N + 1, STATE_SIZE) that they lead to, and their cost."""

    inputs: Array
    states: Array
    cost: float


class HorizonLaw(TrackingLaw):
    """Particle swarm over the knots of a plan. `previous` is the vehicle time of the last decision
    and its plan."""

    def __init__(
        self, vehicle: Vehicle, settings: HorizonSettings, *, period_s: float = 0.1, seed: int = 0
    ) -> None:
        self._settings, self._seed = settings, seed
        super().__init__(vehicle, settings, period_s)
        steps, particles = settings.planned, settings.swarm.particles
        self._volumes = self._placed = pack(settings.keep_out)
        self._exact = ExactMinimum(INPUTS * steps)
        self.outlook = np.zeros(1, OUTLOOK)
        self._start, self._floor_down_m = np.zeros(STATE_SIZE), 0.0
        self._nowhere = np.zeros((steps + 1, STATE_SIZE))
        self._weights = knot_weights(steps)
        self.reach = np.full((self._weights.shape[1], INPUTS), settings.feedback_limit)
        self.reach[:, 2] = VERTICAL_REACH_MPS2
        self.previous: tuple[float, Plan] | None = None
        self._rng = np.random.default_rng(seed)
        drawn = np.random.default_rng(particles).uniform(-1.0, 1.0, (particles, self.reach.size))
        # The first particle starts at the base, the others are scattered increasingly wide about it
        self._starts = np.linspace(0.0, 1.0, particles)[:, None] * drawn * self.reach.ravel()

    def reset(self) -> None:
        super().reset()
        self.previous = None
        self._rng = np.random.default_rng(self._seed)

    def _use_gains(self) -> None:
        super()._use_gains()
        settings = self._settings
        self.quadratic = HorizonQuadratic(self, settings.planned)
        speed_limit_mps = settings.speed_limit_mps or math.inf
        self._plant = plant_of(self, speed_limit_mps=speed_limit_mps, clearance_m=settings.reach_m)

    def decide(self, situation: Situation) -> Decision:
        problem = self.prepare(situation)
        own, others = self._own_plan(situation.time_s), self._other_plans(problem)
        rivals = sorted((plan for plan in others if plan.cost < own.cost), key=COST)
        bases = [own, *rivals[:RIVALS]]
        seed_cost = min(plan.cost for plan in bases)
        if not math.isfinite(seed_cost):
            raise DecisionError("no plan over the horizon has a finite cost")
        best, found = self._searched(bases, situation.remaining_s)
        self.previous = (situation.time_s, best)
        chosen, lower, upper = best.inputs[0], self.outlook["lower"][0], self.outlook["upper"][0]
        certificate = replace(
            found,
            at_bound=bool(((chosen <= lower[0]) | (chosen >= upper[0])).any()),
            seed_cost=seed_cost,
        )
        return decision(problem.quadratic.clip(problem.inputs(chosen)), certificate)

    def prepare(self, situation: Situation) -> TrackingProblem:
        """Prepare the roll-outs for this situation and return its problem."""
        problem, settings = self.problem(situation), self._settings
        self.outlook = look_ahead(self, situation, problem, settings.planned)
        delay_s = situation.state.time_s - situation.time_s
        origin_ned_m = np.array(situation.origin_ned_m, np.float64)
        self._placed = placed_at(self._volumes, origin_ned_m, situation.track_time_s + delay_s)
        self._floor_down_m = situation.origin_ned_m[2] - settings.clearance_m
        self._start[P:Z] = problem.lateral.reshape(-1)
        self._start[Z:T] = problem.vertical
        ahead = self.outlook[0]
        b_n, b_e = ahead["directions"][0, :2]
        leant = b_z_of(b_n + self._start[B], b_e + self._start[B + 1]) - b_z_of(b_n, b_e)
        thrust, b_z = ahead["thrusts_vertical"][0], ahead["b_z"][0]
        self._start[T] = (thrust * b_z + self._start[F]) / (b_z + leant) - thrust
        return problem

    def fly(
        self, inputs: Array, states: Array | None = None, knots: Array | None = None
    ) -> tuple[Plan, Array]:
        """Roll out n plans: `inputs` (N, 3), plus the closed form's feedback towards `states`
        (N + 1, STATE_SIZE) if given, plus `knots` (n, M, 3); n is 1 without knots. Return the
        cheapest plan and the costs (n,) of all."""
        steps = self._settings.planned
        if knots is None:
            knots = np.zeros((1, *self.reach.shape))
        chosen = np.empty((len(knots), steps, INPUTS))
        flown, costs = np.empty((len(knots), steps + 1, STATE_SIZE)), np.empty(len(knots))
        feedback, towards = (0.0, self._nowhere) if states is None else (1.0, states)
        roll_out(
            self._plant, self.outlook, self._placed, self._floor_down_m, self._start,
            np.ascontiguousarray(inputs), np.ascontiguousarray(towards), feedback,
            self._weights, np.ascontiguousarray(knots),
            flown, chosen, costs,
        )  # fmt: skip
        first = int(np.argmin(costs))
        return Plan(chosen[first], flown[first], float(costs[first])), costs

    def _own_plan(self, time_s: float) -> Plan:
        """Return the cheaper of the closed form's plan and the rest of the previous plan."""
        steps = self._settings.planned
        inputs, states = np.zeros((steps, INPUTS)), self._nowhere.copy()
        plan, _ = self.fly(inputs, states)
        if self.previous is not None:
            decided_s, before = self.previous
            gone = round((time_s - decided_s) / self.period_s)
            if 0 <= gone < steps:
                inputs[: steps - gone] = before.inputs[gone:]
                states[: steps - gone + 1] = before.states[gone:]
                plan = min(plan, self.fly(inputs, states)[0], key=COST)
        return plan

    def _other_plans(self, problem: TrackingProblem) -> list[Plan]:
        """Return the exact plan of the linear problem, and the plans that follow other ways."""
        exact = self._exact.minimise(self.quadratic.over(problem, self.outlook))
        plans = []
        if np.isfinite(exact).all():
            plans.append(self.fly(self.quadratic.plan(exact))[0])
        nothing = np.zeros((self._settings.planned, INPUTS))
        plans.extend(self.fly(nothing, way)[0] for way in (*self._detours(), *self._slower()))
        return plans

    def _detours(self) -> list[Array]:
        """Return ways round the volumes near the reference, one past each side of each volume, as
        states (N + 1, STATE_SIZE) that the closed form follows. A way need not be good, because the
        search improves it, but the search alone would not find the other side of a wide volume."""
        ways = []
        nodes = slice(0, 2 * self._settings.planned + 1, 2)
        places, speeds = self.outlook["positions"][0, nodes], self.outlook["velocities"][0, nodes]
        for volume in self._placed:
            half = volume[HALF : HALF + 3] + volume[ROUND] + self._settings.reach_m
            half[:2] += volume[RADIUS]
            centre = volume[CENTRE : CENTRE + 3]
            if not (np.abs(places - centre) - half < DETOUR_M).all(axis=1).any():
                continue
            for axis, sign in SIDES:
                way = self._nowhere.copy()
                aside = centre[axis] + sign * half[axis] - places[:, axis]
                past = sign * aside > 0.0
                position, velocity = ROWS[axis]
                way[past, position] = aside[past]
                way[past, velocity] = -speeds[past, axis]
                ways.append(way)
        return ways

    def _slower(self) -> list[Array]:
        """Return the reference from the present position on, no faster than the speed limit, as
        states (N + 1, STATE_SIZE); nothing without a speed limit."""
        way, limit_mps = self._nowhere.copy(), self._settings.speed_limit_mps
        if limit_mps is None:
            return []
        velocities = self.outlook["velocities"][0, 0 : 2 * len(way) - 1 : 2]
        speeds_mps = np.linalg.norm(velocities, axis=1, keepdims=True)
        less_mps = np.minimum(limit_mps / np.maximum(speeds_mps, limit_mps) - 1.0, 0.0) * velocities
        behind_m = np.cumsum(less_mps[:-1], axis=0) * self.period_s
        for axis, (position, velocity) in enumerate(ROWS):
            way[:, position] = self._start[position]
            way[1:, position] += behind_m[:, axis]
            way[:, velocity] = less_mps[:, axis]
        return [way]

    def _searched(
        self, bases: list[Plan], remaining_s: Callable[[], float] | None
    ) -> tuple[Plan, Certificate]:
        """Return the best plan about any of the bases, which share the iterations. A search about
        the cheapest base alone ends in worse local minima than one about our own plan as well."""
        settings = self._settings.swarm
        share = max(1, settings.iterations // len(bases))
        each = settings.model_copy(update={"iterations": share})
        answers = [self._search(base, each, remaining_s) for base in bases]
        return min(answers, key=lambda answer: answer[0].cost)

    def _search(
        self, base: Plan, settings: SwarmSettings, remaining_s: Callable[[], float] | None
    ) -> tuple[Plan, Certificate]:
        """Return the best plan with knots within +-`reach` (M, 3) about `base`. It never costs more
        than `base`, where the first particle starts."""
        limit = self.reach.ravel()
        swarm = Swarm(settings, -limit, limit, self._rng, self._starts)
        best, late = base, False
        for iteration in range(settings.iterations):
            knots = swarm.ask().reshape(-1, *self.reach.shape)
            cheapest, costs = self.fly(base.inputs, base.states, knots)
            best = min(best, cheapest, key=COST)
            swarm.tell(costs)
            if remaining_s is not None and remaining_s() <= 0:
                late = iteration + 1 < settings.iterations
                break
        found = swarm.result()
        return best, Certificate(
            cost=best.cost, spread=found.spread, iterations=found.iterations, cut_short=late
        )


def knot_weights(steps: int) -> Array:
    """Return the weights (N, M) of M knots in each step, linear between knots and constant after
    the last one."""
    places = sorted({round(share * (steps - 1)) for share in KNOT_SHARES})
    every = np.arange(steps)
    return np.column_stack([np.interp(every, places, unit) for unit in np.eye(len(places))])
