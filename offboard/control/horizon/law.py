"""The law `horizon`: the swarm over N decisions of nonlinear roll-outs, around keep-out volumes.

A search starts from plans: the better of the closed form's and the previous one, and, where they
are cheaper than that, the exact plan of the linear problem and the ways past each side of each
volume. The answer is never worse than any of them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from operator import attrgetter
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from offboard.control.base import Certificate, Decision, DecisionError, Situation
from offboard.control.horizon.keep_out import KeepOut, pack, placed_at, refusal
from offboard.control.horizon.outlook import HorizonQuadratic, bounds, look_ahead
from offboard.control.horizon.plant import INPUTS, MOST_STEPS, STATE_SIZE, Scene, plant_of
from offboard.control.horizon.polish import Ended, polish
from offboard.control.horizon.search import Evaluator, Found, Plan, Remaining, detours, swarm
from offboard.control.law import Task, TrackingLaw, TrackingSettings, decision
from offboard.control.quadratic import ExactMinimum
from offboard.control.swarm import SwarmSettings
from offboard.model.vehicle import Vehicle
from offboard.reference.base import Reference

Array = NDArray[np.float64]

STEPS, STEPS_AROUND = 10, 20
VERTICAL_REACH_MPS2 = 3.0  # of the knots of the vertical thrust
PLANNED_MARGIN_M = 0.05  # beyond the clearance: for tracking errors, and because it is a soft limit
RIVALS = 2  # plans of other origin that are searched about too
MET_M = 0.3  # a plan that stays further than this outside every clearance needs no search
COST = attrgetter("cost")  # the order of plans: infinite where a roll-out is not finite


class HorizonSettings(TrackingSettings):
    """Settings of the law `horizon`.

    `steps` is the number of decisions planned (default: 10, and 20 with keep-out volumes, so that
    the way round one fits in), `keep_out` the volumes to avoid with `clearance_m` to spare,
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
        """The number of decisions planned, as chosen or by default."""
        return self.steps or (STEPS_AROUND if self.keep_out else STEPS)

    @property
    def reach_m(self) -> float:
        """Distance that plans keep from the surface of a volume."""
        return self.clearance_m + PLANNED_MARGIN_M

    def build(self, vehicle: Vehicle, *, period_s: float, seed: int) -> HorizonLaw:
        return HorizonLaw(vehicle, self, period_s=period_s, seed=seed)

    def refusal(self, reference: Reference) -> str | None:
        return refusal(self.keep_out, self.clearance_m, reference)


class HorizonLaw(TrackingLaw):
    """Particle swarm over the knots of a plan, then a local polish.

    `evaluate` runs the roll-outs of the situation, `previous` is the last plan and the vehicle time
    of its decision.
    """

    def __init__(
        self, vehicle: Vehicle, settings: HorizonSettings, *, period_s: float = 0.1, seed: int = 0
    ) -> None:
        self._settings, self._seed = settings, seed
        super().__init__(vehicle, settings, period_s)
        self._volumes = pack(settings.keep_out)
        self._exact = ExactMinimum(INPUTS * settings.planned)
        self.evaluate = Evaluator(settings.planned, len(self._volumes))
        self._reach = np.full((self.evaluate.knots.shape[1], INPUTS), settings.feedback_limit)
        self._reach[:, 2] = VERTICAL_REACH_MPS2
        self.previous: tuple[float, Plan] | None = None
        self._rng = np.random.default_rng(seed)

    def reset(self) -> None:
        super().reset()
        self.previous = None
        self._rng = np.random.default_rng(self._seed)

    def _use_gains(self, bandwidth_radps: float) -> None:
        super()._use_gains(bandwidth_radps)
        settings = self._settings
        self._quadratic = HorizonQuadratic(self, settings.planned)
        self._plant = plant_of(
            self,
            speed_limit_mps=settings.speed_limit_mps or math.inf,
            clearance_m=settings.reach_m,
        )

    def decide(self, situation: Situation) -> Decision:
        task, exact = self._prepare(situation)
        own, others = self._own_plan(situation.time_s), self._other_plans(exact)
        seed_cost = _lowest_cost([own, *others])
        rivals = sorted((plan for plan in others if plan.cost < own.cost), key=COST)
        found = self._polished([own, *rivals], situation.remaining_s)
        if found is None:
            found = self._searched([own, *rivals[:RIVALS]], situation.remaining_s)
        self.previous = (situation.time_s, found.plan)
        chosen, lower, upper = found.plan.inputs[0], self.evaluate.lower[0], self.evaluate.upper[0]
        certificate = Certificate(
            cost=found.plan.cost,
            spread=found.spread,
            iterations=found.iterations,
            cut_short=found.cut_short,
            at_bound=bool(((chosen <= lower) | (chosen >= upper)).any()),
            seed_cost=seed_cost,
        )
        return decision(task.problem.clip(task.inputs(chosen)), certificate)

    def _prepare(self, situation: Situation) -> tuple[Task, Array]:
        """Make `evaluate` ready for this situation. Returns its task, and the exact plan of the
        linear problem without volumes, (N, 3)."""
        task, settings = self.task(situation), self._settings
        ahead = look_ahead(self, situation, settings.planned)
        within = bounds(ahead, task, self)
        delay_s = situation.state.time_s - situation.time_s
        volumes = placed_at(
            self._volumes,
            np.array(situation.origin_ned_m, np.float64),
            situation.track_time_s + delay_s,
        )
        floor_down_m = situation.origin_ned_m[2] - settings.clearance_m
        self.evaluate.prepare(self._plant, Scene(ahead, within, volumes, floor_down_m), task)
        exact = self._exact.minimise(self._quadratic.problem(task, within))
        return task, self._quadratic.plan(exact)

    def _own_plan(self, time_s: float) -> Plan:
        """The cheaper of the plan of the closed form and what remains of the previous plan."""
        steps = self._settings.planned
        inputs, states = np.zeros((steps, INPUTS)), np.zeros((steps + 1, STATE_SIZE))
        plan = self.evaluate.follow(inputs, states)
        if self.previous is not None:
            decided_s, before = self.previous
            gone = round((time_s - decided_s) / self.period_s)
            if 0 <= gone < steps:
                inputs[: steps - gone] = before.inputs[gone:]
                states[: steps - gone + 1] = before.states[gone:]
                plan = min(plan, self.evaluate.follow(inputs, states), key=COST)
        return plan

    def _other_plans(self, exact: Array) -> list[Plan]:
        """The exact plan of the linear problem, and a way past each side of each volume nearby."""
        evaluate, plans = self.evaluate, []
        if np.isfinite(exact).all():
            plans.append(evaluate.open_loop(exact))
        inputs = np.zeros_like(exact)
        ways = detours(evaluate.scene, self._settings.reach_m)
        plans.extend(evaluate.follow(inputs, way) for way in ways)
        return plans

    def _polished(self, seeds: list[Plan], remaining_s: Remaining) -> Found | None:
        """The best seed, polished, if that leaves nothing to search for: no volume is near, and
        the convex problem that remains is solved."""
        if any(self.evaluate.is_near(plan, MET_M) for plan in seeds):
            return None
        best, ended = polish(self.evaluate, min(seeds, key=COST), remaining_s)
        return Found(best, math.nan, 0, False) if ended is Ended.CONVERGED else None

    def _searched(self, bases: list[Plan], remaining_s: Remaining) -> Found:
        """The best plan about any of the bases, which share the iterations. Searching only about
        the cheapest of all ends in worse valleys than searching about our own too."""
        settings, evaluate = self._settings, self.evaluate
        share = max(1, settings.swarm.iterations // len(bases))
        shared = settings.swarm.model_copy(update={"iterations": share})
        answers = []
        for base in bases:
            found = swarm(evaluate, base, self._reach, shared, self._rng, remaining_s)
            better, ended = polish(evaluate, found.plan, remaining_s)
            late = found.cut_short or ended is Ended.LATE
            answers.append(replace(found, plan=better, cut_short=late))
        return min(answers, key=attrgetter("plan.cost"))


def _lowest_cost(plans: Sequence[Plan]) -> float:
    """The lowest cost of these plans. Raises DecisionError where it is not finite."""
    lowest = min(plan.cost for plan in plans)
    if not math.isfinite(lowest):
        raise DecisionError("no plan over the horizon has a finite cost")
    return lowest
