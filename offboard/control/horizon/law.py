"""The predictive law over nonlinear roll-outs: `horizon` searches with the swarm, `mppi` and `cem`
with theirs.

A search begins on a seed: the better of the closed form flown to the end of the horizon and the
previous plan's tail; and where they are better than it, the best of the linear problem's exact plan
and of the ways past each side of a keep-out volume. The swarm's answer is never
worse than any of them. Knows no autopilot and reads no clock.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from offboard.control.base import Certificate, DecisionError, Situation
from offboard.control.certificate import ExactMinimum, certify
from offboard.control.cost import BoxQuadratic
from offboard.control.horizon.detour import detours
from offboard.control.horizon.keep_out import pack, placed_at
from offboard.control.horizon.outlook import bounds, look_ahead
from offboard.control.horizon.plant import (
    INPUTS,
    STATE_SIZE,
    plant_of,
    scene_of,
    start_state,
)
from offboard.control.horizon.polish import Ended, polish
from offboard.control.horizon.quadratic import HorizonQuadratic
from offboard.control.horizon.sampling import cem, mppi
from offboard.control.horizon.search import Evaluator, Found, Plan, swarm
from offboard.control.horizon.settings import Dynamics, HorizonSettings, Method
from offboard.control.laws.mpc import one_decision
from offboard.control.laws.tracking import Search, Target, TrackingLaw, errors
from offboard.control.riccati import lateral_cost_to_go
from offboard.control.swarm import RandomLanes, SwarmResult
from offboard.model.vehicle import Vehicle

Array = NDArray[np.float64]

HEAVE_REACH_MPS2 = 3.0  # of the knots of the vertical thrust
RIVALS = 2  # of the best plan of our own, that are searched about as well
MET_M = 0.3  # from the clearance of a volume: further outside, a plan does not meet it
PLANNED_MARGIN_M = 0.05  # beyond the clearance: for tracking, and for a limit that is bought softly


class HorizonLaw(TrackingLaw):
    """The controllers `horizon`, `mppi` and `cem`."""

    def __init__(
        self,
        vehicle: Vehicle,
        settings: HorizonSettings | None = None,
        method: Method = Method.SWARM,
        stopwatch: Callable[[], float] | None = None,
        *,
        period_s: float = 0.1,
        seed: int = 0,
    ) -> None:
        self._plans = settings or HorizonSettings()
        self._seed = seed
        self._method = method
        self._volumes = pack(self._plans.keep_out)
        self._evaluate = Evaluator(self._plans.planned, len(self._volumes))
        self._planner = ExactMinimum(INPUTS * self._plans.planned)
        super().__init__(
            vehicle, self._plans, Search.SWARM, stopwatch, period_s=period_s, seed=seed
        )
        self.previous: tuple[float, Plan] | None = None
        self._start_over()

    def adopt(
        self, vehicle: Vehicle, bandwidth_limit_radps: float = math.inf, *, gains: bool = True
    ) -> None:
        super().adopt(vehicle, bandwidth_limit_radps, gains=gains)
        if not gains:
            return
        plans = self._plans
        bandwidth = min(plans.bandwidth_radps, bandwidth_limit_radps)
        self._quadratic = HorizonQuadratic(self.lateral, self.vertical, plans.planned)
        self._plant = plant_of(
            vehicle,
            self.lateral,
            self.vertical,
            self._period_s,
            half=lateral_cost_to_go(vehicle, bandwidth, 0.5 * self._period_s),
            nonlinear=plans.dynamics is Dynamics.NONLINEAR,
            thrust_mps2=(plans.thrust_floor * vehicle.gravity_mps2, vehicle.thrust_max_mps2),
            speed_limit_mps=plans.speed_limit_mps or math.inf,
            clearance_m=plans.clearance_m + PLANNED_MARGIN_M,
        )

    def reset(self) -> None:
        """Forget everything of the previous flight, the plan and the random streams included."""
        super().reset()
        self._start_over()

    def answer(
        self,
        situation: Situation,
        target: Target,
        problem: BoxQuadratic,
        remaining_s: Callable[[], float] | None,
    ) -> tuple[Array, Certificate]:
        """The first input of the best plan found."""
        linear = self._settle(situation, target, problem)
        own, others = self._seeds(situation.time_s, linear)
        base = min(own, key=_cost)
        seed_cost = min(plan.cost for plan in (base, *others))
        if not math.isfinite(seed_cost):
            raise DecisionError("no plan of the horizon has a finite cost")
        rivals = sorted((plan for plan in others if plan.cost < base.cost), key=_cost)
        found = self._settled([base, *rivals], remaining_s)
        if found is None:
            found = self._find([base, *rivals[:RIVALS]], remaining_s)
        self.previous = (situation.time_s, found.plan)
        certificate = replace(self._certificate(found, linear), seed_cost=seed_cost)
        upright = float(situation.state.thrust_direction_ned[2])
        return one_decision(found.plan.inputs[0], upright, target, problem), certificate

    def _start_over(self) -> None:
        self.previous = None
        self._generator = np.random.default_rng(self._seed)
        self._lanes = RandomLanes(self._seed)

    def _settle(self, situation: Situation, target: Target, problem: BoxQuadratic) -> BoxQuadratic:
        """Prepare the roll-outs of this situation; the linear problem that comes with it."""
        state, plans = situation.state, self._plans
        ahead = look_ahead(self._vehicle, situation.reference, state, self._period_s, plans.planned)
        limit = min(plans.tilt_limit, math.sin(self._vehicle.tilt_max_rad))
        thrusts = (float(problem.lower[0]), float(problem.upper[0]))
        upright = float(state.thrust_direction_ned[2])
        within = bounds(ahead, upright, limit, plans.feedback_limit, thrusts)
        delay_s = state.time_s - situation.time_s
        volumes = placed_at(
            self._volumes,
            np.array(situation.origin_ned_m, np.float64),
            situation.track_time_s + delay_s,
        )
        floor_down_m = situation.origin_ned_m[2] - plans.clearance_m
        scene = scene_of(ahead, within, volumes, floor_down_m)
        lateral, vertical = errors(state, target)
        self._evaluate.settle(self._plant, scene, start_state(lateral, vertical, scene))
        return self._quadratic.problem(lateral, vertical, within)

    def _seeds(self, time_s: float, linear: BoxQuadratic) -> tuple[list[Plan], list[Plan]]:
        """Our own plans (the closed form and the previous plan's tail), and others: the linear
        problem's exact plan, and a way past each side of each volume that is near."""
        steps, evaluate = self._plans.planned, self._evaluate
        inputs, states = np.zeros((steps, INPUTS)), np.zeros((steps + 1, STATE_SIZE))
        own, others = [evaluate.held(inputs, states)], []
        if self._method is Method.SWARM and self._plans.seed_with_qp:
            exact = self._planner.minimise(linear)
            if np.isfinite(exact).all():
                others.append(evaluate.flown(self._quadratic.plan(exact)))
        if self._method is Method.SWARM and len(self._volumes):
            reach = self._plans.clearance_m + PLANNED_MARGIN_M
            others.extend(evaluate.held(inputs, way) for way in detours(evaluate.scene, reach))
        if self.previous is not None:
            gone = round((time_s - self.previous[0]) / self._period_s)
            if 0 <= gone < steps:
                before = self.previous[1]
                inputs[: steps - gone] = before.inputs[gone:]
                states[: steps - gone + 1] = before.states[gone:]
                own.append(evaluate.held(inputs, states))
        return own, others

    def _settled(self, seeds: list[Plan], remaining_s: Callable[[], float] | None) -> Found | None:
        """The best seed, polished, where that leaves nothing to search for: no volume is near,
        and the convex problem that remains is as good as solved."""
        plans, evaluate = self._plans, self._evaluate
        alone = self._method is Method.SWARM and plans.seed_with_qp
        if not alone or any(evaluate.meets(plan, MET_M) for plan in seeds):
            return None
        best, ended = polish(evaluate, min(seeds, key=_cost), plans.polish_steps, remaining_s)
        return Found(best, math.nan, 0, False) if ended is Ended.SETTLED else None

    def _find(self, bases: list[Plan], remaining_s: Callable[[], float] | None) -> Found:
        """The best plan about any of the bases, which share the budget. Searching only about the
        best of all seeds ends in worse valleys than searching about our own."""
        plans, evaluate = self._plans, self._evaluate
        reach = np.full((evaluate.knots.shape[1], INPUTS), plans.feedback_limit)
        reach[:, 2] = HEAVE_REACH_MPS2
        if self._method is not Method.SWARM:
            sample = mppi if self._method is Method.MPPI else cem
            return sample(evaluate, bases[0], reach, plans.sampling, self._generator, remaining_s)
        share = max(1, plans.swarm.iterations // len(bases))
        settings = plans.swarm.model_copy(update={"iterations": share})
        answers = []
        for base in bases:
            found = swarm(evaluate, base, reach, settings, self._lanes, remaining_s)
            better, ended = polish(evaluate, found.plan, plans.polish_steps, remaining_s)
            late = found.cut_short or ended is Ended.LATE
            answers.append(replace(found, plan=better, cut_short=late))
        return min(answers, key=lambda found: found.plan.cost)

    def _certificate(self, found: Found, linear: BoxQuadratic) -> Certificate:
        """Against the exact plan where the problem is a quadratic: nothing nonlinear in it."""
        plan, plans = found.plan, self._plans
        if plans.dynamics is Dynamics.LINEAR and not plans.keep_out and not plans.speed_limit_mps:
            stacked = plan.inputs.T.ravel()
            result = SwarmResult(
                stacked, plan.cost, found.spread, found.iterations, found.cut_short
            )
            return certify(linear, result, self._planner)
        lower, upper = self._evaluate.lower[0], self._evaluate.upper[0]
        return Certificate(
            cost=plan.cost,
            spread=found.spread,
            iterations=found.iterations,
            cut_short=found.cut_short,
            at_bound=bool(((plan.inputs[0] <= lower) | (plan.inputs[0] >= upper)).any()),
        )


def _cost(plan: Plan) -> float:
    return plan.cost if math.isfinite(plan.cost) else math.inf
