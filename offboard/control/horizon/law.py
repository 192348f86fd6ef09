"""The law `horizon`: the swarm over N decisions of nonlinear roll-outs, around keep-out volumes.

A search starts from plans: the better of the closed form's and the previous one, and, where they
are cheaper than that, the exact plan of the linear problem and the ways past each side of each
volume. The answer is never worse than any of them.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Literal

import numpy as np
from pydantic import Field

from offboard.control.base import Decision, Situation
from offboard.control.horizon.detour import detours
from offboard.control.horizon.planner import Planner, RollOutSettings, cost_of, lowest_cost
from offboard.control.horizon.plant import INPUTS
from offboard.control.horizon.polish import Ended, polish
from offboard.control.horizon.search import Found, Plan, Remaining, swarm
from offboard.control.quadratic import BoxQuadratic
from offboard.control.swarm import SwarmSettings
from offboard.model.vehicle import Vehicle

RIVALS = 2  # plans of other origin that are searched about too
MET_M = 0.3  # a plan that stays further than this outside every clearance needs no search


class HorizonSettings(RollOutSettings):
    """Settings of the law `horizon`.

    `seed_with_qp`: whether the exact plan of the linear problem is one that the search starts
    from. `polish_steps`: most steps from each answer of the swarm to its local minimum.
    """

    law: Literal["horizon"] = "horizon"
    seed_with_qp: bool = True
    polish_steps: int = Field(default=8, ge=0, le=50)
    swarm: SwarmSettings = SwarmSettings(particles=20, iterations=40, damping=0.8)

    def build(self, vehicle: Vehicle, *, period_s: float, seed: int) -> HorizonLaw:
        return HorizonLaw(vehicle, self, period_s=period_s, seed=seed)


class HorizonLaw:
    """Particle swarm over the knots of a plan, then a local polish."""

    def __init__(
        self, vehicle: Vehicle, settings: HorizonSettings, *, period_s: float = 0.1, seed: int = 0
    ) -> None:
        self.bandwidth_radps = settings.bandwidth_radps
        self.planner = Planner(vehicle, settings, period_s)
        self._vehicle = vehicle
        self._settings = settings
        self._seed = seed
        self._rng = np.random.default_rng(seed)

    def decide(self, situation: Situation) -> Decision:
        task, linear = self.planner.prepare(situation)
        own, others = self.planner.own_plan(situation.time_s), self._other_plans(linear)
        seed_cost = lowest_cost([own, *others])
        rivals = sorted((plan for plan in others if plan.cost < own.cost), key=cost_of)
        found = self._polished([own, *rivals], situation.remaining_s)
        if found is None:
            found = self._searched([own, *rivals[:RIVALS]], situation.remaining_s)
        return self.planner.conclude(situation, task, linear, found, seed_cost)

    def reset(self) -> None:
        self.planner.previous = None
        self._rng = np.random.default_rng(self._seed)
        self.adopt(self._vehicle)

    def adopt(
        self, vehicle: Vehicle, bandwidth_limit_radps: float = math.inf, *, gains: bool = True
    ) -> None:
        self.planner.adopt(vehicle, bandwidth_limit_radps, gains=gains)

    def _other_plans(self, linear: BoxQuadratic) -> list[Plan]:
        """The exact plan of the linear problem, and a way past each side of each volume nearby."""
        settings, evaluate, plans = self._settings, self.planner.evaluate, []
        if settings.seed_with_qp:
            exact = self.planner.exact.minimise(linear)
            if np.isfinite(exact).all():
                plans.append(evaluate.open_loop(self.planner.quadratic.plan(exact)))
        if settings.keep_out:
            inputs = np.zeros((settings.planned, INPUTS))
            ways = detours(evaluate.scene, settings.reach_m)
            plans.extend(evaluate.follow(inputs, way) for way in ways)
        return plans

    def _polished(self, seeds: list[Plan], remaining_s: Remaining) -> Found | None:
        """The best seed, polished, if that leaves nothing to search for: no volume is near, and
        the convex problem that remains is solved."""
        settings, evaluate = self._settings, self.planner.evaluate
        if not settings.seed_with_qp or any(evaluate.is_near(plan, MET_M) for plan in seeds):
            return None
        best, ended = polish(evaluate, min(seeds, key=cost_of), settings.polish_steps, remaining_s)
        return Found(best, math.nan, 0, False) if ended is Ended.CONVERGED else None

    def _searched(self, bases: list[Plan], remaining_s: Remaining) -> Found:
        """The best plan about any of the bases, which share the iterations. Searching only about
        the cheapest of all ends in worse valleys than searching about our own too."""
        settings, evaluate, reach = self._settings, self.planner.evaluate, self.planner.reach
        share = max(1, settings.swarm.iterations // len(bases))
        shared = settings.swarm.model_copy(update={"iterations": share})
        answers = []
        for base in bases:
            found = swarm(evaluate, base, reach, shared, self._rng, remaining_s)
            better, ended = polish(evaluate, found.plan, settings.polish_steps, remaining_s)
            late = found.cut_short or ended is Ended.LATE
            answers.append(replace(found, plan=better, cut_short=late))
        return min(answers, key=lambda found: found.plan.cost)
