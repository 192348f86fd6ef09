"""What the laws over roll-outs share: the roll-outs of one situation, the plans that a search can
start from, and the decision that follows from the plan it ends with.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from offboard.control.base import Certificate, Decision, DecisionError, Situation
from offboard.control.gains import lateral_gain
from offboard.control.horizon.keep_out import KeepOut, pack, placed_at, refusal
from offboard.control.horizon.outlook import bounds, look_ahead
from offboard.control.horizon.plant import (
    INPUTS,
    MOST_STEPS,
    STATE_SIZE,
    Scene,
    plant_of,
    start_state,
)
from offboard.control.horizon.quadratic import HorizonQuadratic
from offboard.control.horizon.search import Evaluator, Found, Plan
from offboard.control.law import Task, Tracking, TrackingSettings, decision
from offboard.control.quadratic import BoxQuadratic, ExactMinimum
from offboard.control.swarm import SwarmResult, certify
from offboard.model.vehicle import Vehicle
from offboard.reference.base import Reference

Array = NDArray[np.float64]

HEAVE_REACH_MPS2 = 3.0  # of the knots of the vertical thrust
STEPS, STEPS_AROUND = 10, 20
PLANNED_MARGIN_M = 0.05  # beyond the clearance: for tracking errors, and because it is a soft limit


class Dynamics(StrEnum):
    """What the roll-outs fly: thrust times direction, or its linear model about hover."""

    NONLINEAR = "nonlinear"
    LINEAR = "linear"


class RollOutSettings(TrackingSettings):
    """Settings of the laws over roll-outs.

    `steps` is the number of decisions planned (default: 10, and 20 with keep-out volumes, so that
    the way round one fits in), `keep_out` the volumes to avoid with `clearance_m` to spare,
    `speed_limit_mps` the highest speed (default: unlimited).
    """

    steps: int | None = Field(default=None, ge=2, le=MOST_STEPS)
    dynamics: Dynamics = Dynamics.NONLINEAR
    keep_out: tuple[KeepOut, ...] = ()
    clearance_m: float = Field(default=0.3, ge=0, le=50)
    speed_limit_mps: float | None = Field(default=None, gt=0, le=50)

    @property
    def planned(self) -> int:
        """The number of decisions planned, as chosen or by default."""
        return self.steps or (STEPS_AROUND if self.keep_out else STEPS)

    @property
    def reach_m(self) -> float:
        """Distance that plans keep from the surface of a volume."""
        return self.clearance_m + PLANNED_MARGIN_M

    def refusal(self, reference: Reference) -> str | None:
        return refusal(self.keep_out, self.clearance_m, reference)


class Planner:
    """Prepares the roll-outs of each situation; remembers the plan before.

    `evaluate` runs the roll-outs, `previous` is the last plan and the vehicle time of its decision.
    """

    def __init__(self, vehicle: Vehicle, settings: RollOutSettings, period_s: float) -> None:
        self.tracking = Tracking(vehicle, settings, period_s)
        self.previous: tuple[float, Plan] | None = None
        self._settings = settings
        self._volumes = pack(settings.keep_out)
        self.evaluate = Evaluator(settings.planned, len(self._volumes))
        self.exact = ExactMinimum(INPUTS * settings.planned)
        self.adopt(vehicle)

    def adopt(
        self, vehicle: Vehicle, bandwidth_limit_radps: float = math.inf, *, gains: bool = True
    ) -> None:
        """See `base.Adopting.adopt`."""
        tracking, settings = self.tracking, self._settings
        tracking.adopt(vehicle, bandwidth_limit_radps, gains=gains)
        if not gains:
            return
        bandwidth = min(settings.bandwidth_radps, bandwidth_limit_radps)
        self.quadratic = HorizonQuadratic(tracking, settings.planned)
        self._plant = plant_of(
            tracking,
            half=lateral_gain(vehicle, bandwidth, 0.5 * tracking.period_s),
            nonlinear=settings.dynamics is Dynamics.NONLINEAR,
            speed_limit_mps=settings.speed_limit_mps or math.inf,
            clearance_m=settings.reach_m,
        )

    @property
    def reach(self) -> Array:
        """How far a search may move the knots from their base, (M, 3)."""
        reach = np.full((self.evaluate.knots.shape[1], INPUTS), self._settings.feedback_limit)
        reach[:, 2] = HEAVE_REACH_MPS2
        return reach

    def prepare(self, situation: Situation) -> tuple[Task, BoxQuadratic]:
        """Make `evaluate` ready for this situation. Returns its task, and the problem over the
        horizon for the linear plant without volumes. Raises DecisionError."""
        task = self.tracking.task(situation)
        ahead = look_ahead(self.tracking, situation, self._settings.planned)
        within = bounds(ahead, task, self.tracking)
        delay_s = situation.state.time_s - situation.time_s
        volumes = placed_at(
            self._volumes,
            np.array(situation.origin_ned_m, np.float64),
            situation.track_time_s + delay_s,
        )
        floor_down_m = situation.origin_ned_m[2] - self._settings.clearance_m
        scene = Scene(ahead, within, volumes, floor_down_m)
        self.evaluate.prepare(self._plant, scene, start_state(task, ahead))
        return task, self.quadratic.problem(task, within)

    def own_plan(self, time_s: float) -> Plan:
        """The cheaper of the plan of the closed form and what remains of the previous plan."""
        steps = self._settings.planned
        inputs, states = np.zeros((steps, INPUTS)), np.zeros((steps + 1, STATE_SIZE))
        plan = self.evaluate.follow(inputs, states)
        if self.previous is not None:
            decided_s, before = self.previous
            gone = round((time_s - decided_s) / self.tracking.period_s)
            if 0 <= gone < steps:
                inputs[: steps - gone] = before.inputs[gone:]
                states[: steps - gone + 1] = before.states[gone:]
                plan = min(plan, self.evaluate.follow(inputs, states), key=cost_of)
        return plan

    def conclude(
        self, situation: Situation, task: Task, linear: BoxQuadratic, found: Found, seed_cost: float
    ) -> Decision:
        """The decision for the first input of the plan found."""
        self.previous = (situation.time_s, found.plan)
        inputs = task.problem.clip(task.inputs(found.plan.inputs[0]))
        return decision(inputs, self._certificate(found, linear, seed_cost))

    def _certificate(self, found: Found, linear: BoxQuadratic, seed_cost: float) -> Certificate:
        """Against the exact plan where nothing in the problem is nonlinear."""
        plan, settings = found.plan, self._settings
        quadratic = settings.dynamics is Dynamics.LINEAR and not settings.keep_out
        if quadratic and not settings.speed_limit_mps:
            stacked = plan.inputs.T.ravel()
            result = SwarmResult(
                stacked, plan.cost, found.spread, found.iterations, found.cut_short
            )
            return replace(certify(linear, result, self.exact), seed_cost=seed_cost)
        lower, upper = self.evaluate.lower[0], self.evaluate.upper[0]
        return Certificate(
            cost=plan.cost,
            spread=found.spread,
            iterations=found.iterations,
            cut_short=found.cut_short,
            at_bound=bool(((plan.inputs[0] <= lower) | (plan.inputs[0] >= upper)).any()),
            seed_cost=seed_cost,
        )


def lowest_cost(plans: Sequence[Plan]) -> float:
    """The lowest cost of these plans. Raises DecisionError where it is not finite."""
    lowest = min(plan.cost for plan in plans)
    if not math.isfinite(lowest):
        raise DecisionError("no plan over the horizon has a finite cost")
    return lowest


def cost_of(plan: Plan) -> float:
    """The cost, infinite where it is not finite: the order of plans."""
    return plan.cost if math.isfinite(plan.cost) else math.inf
