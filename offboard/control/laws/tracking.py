"""The tracking law behind `pso` and `lqr`: one held input, then the optimal cost-to-go.

Each decision is a convex quadratic in u = [T, b_cx, b_cy, course] in a box: the stage cost over the
hold plus the Riccati solution of the state it leads to, in deviations from what flatness asks of
the vehicle and inverted through the attitude loop. `pso` searches it with the swarm, `lqr` takes
its closed form: the axes decouple, so that is clip(-f / h). Knows no autopilot and reads no clock.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import BeforeValidator, Field

from offboard.control.base import Certificate, Decision, DecisionError, Situation
from offboard.control.certificate import ExactMinimum, at_bound, certify
from offboard.control.cost import BoxQuadratic
from offboard.control.riccati import (
    held_lead,
    lateral_cost_to_go,
    thrust_ripple,
    tilt_ripple,
    vertical_cost_to_go,
)
from offboard.control.swarm import QuadraticSwarm, RandomLanes, SwarmSettings
from offboard.documents.parameters import Parameters
from offboard.model.axes import lead
from offboard.model.command import Command
from offboard.model.frames import wrap_pi
from offboard.model.predicted_state import PredictedHeave, PredictedState
from offboard.model.vehicle import Vehicle
from offboard.reference.base import FlatSample, Reference
from offboard.reference.flatness import flat_state

Array = NDArray[np.float64]

COURSE_BOX_RAD = 0.5  # about its feed-forward: the autopilot closes the yaw loop, we only lead it
COURSE_CURVATURE = 1.0


class Search(StrEnum):
    """How the quadratic of one decision is minimised."""

    SWARM = "pso"
    CLOSED_FORM = "lqr"


class TrackingSettings(Parameters):
    """One number, the bandwidth, sets the law: weights 1 on position, g^2 / wc^4 on b_c and
    1 / wc^4 on the vertical thrust. 5 rad/s is the knee between error and agitation on PX4 and
    ArduCopter; 7 wants the delay known, to which `delay_margin` holds it in flight.

    `feedback_limit` bounds each lateral component of b_c about its feed-forward (a swing between
    the tilt limits runs into the attitude loop's acceleration limit and cycles), `tilt_limit`
    each component itself. `thrust_floor` is the least thrust as a fraction of g.
    """

    bandwidth_radps: float = Field(default=5.0, ge=0.5, le=20)
    feedback_limit: float = Field(default=0.3, gt=0, le=1)
    tilt_limit: float = Field(default=0.7, gt=0, le=0.7)
    thrust_floor: float = Field(default=0.2, ge=0, lt=1)
    swarm: SwarmSettings = SwarmSettings()


def _share(value: object) -> object:
    return float(value) if isinstance(value, bool) else value


class OneDecisionSettings(TrackingSettings):
    """Of laws that see the reference at one moment only. `feedforward`, a share or false and true,
    is how much of the reference's own motion (acceleration, drag and what follows) is asked of
    attitude and thrust before any error shows; the disturbance is answered in full either way.
    """

    feedforward: Annotated[float, BeforeValidator(_share), Field(ge=0, le=1)] = 1.0


@dataclass(frozen=True, slots=True)
class Target:
    """What the reference asks when the command acts, NED, SI, the ripple of held commands included.

    Lateral at the predicted time: position_ne_m, velocity_ne_mps, direction_ne and
    direction_rate_ne_ps, each (2,). Vertical when the thrust acts: position_down_m,
    velocity_down_mps, thrust_down_mps2 (the part T b_z). Feed-forward: tilt (2,), vertical thrust
    and course, each half a decision after its own delay and led through its own response.
    """

    position_ne_m: Array
    velocity_ne_mps: Array
    direction_ne: Array
    direction_rate_ne_ps: Array
    position_down_m: float
    velocity_down_mps: float
    thrust_down_mps2: float
    tilt_feedforward: Array
    thrust_down_feedforward_mps2: float
    course_feedforward_rad: float


class TrackingLaw:
    """The controllers `pso` and `lqr`, deciding every `period_s`. `stopwatch` () -> s lets the
    swarm keep a deadline and report its time; without one it takes all its iterations.
    `feedforward`: see `OneDecisionSettings`."""

    def __init__(
        self,
        vehicle: Vehicle,
        settings: TrackingSettings | None = None,
        search: Search = Search.SWARM,
        stopwatch: Callable[[], float] | None = None,
        feedforward: float = 1.0,
        *,
        period_s: float = 0.1,
        seed: int = 0,
    ) -> None:
        self._settings = settings or TrackingSettings()
        self._period_s = period_s
        self._feedforward = feedforward
        self._search = search
        self._stopwatch = stopwatch
        self._file = vehicle
        self.adopt(vehicle)
        self._swarm = QuadraticSwarm(self._settings.swarm, 4)
        self._lanes = RandomLanes(seed)
        self._exact = ExactMinimum(4)

    def decide(self, situation: Situation) -> Decision:
        """The command for one tick. Raises DecisionError where anything is not finite."""
        started = self._stopwatch() if self._stopwatch else math.nan
        state = situation.state
        target = self.target(situation.reference, situation.time_s, state)
        problem = self.problem(state, target)
        if not _finite(problem):
            raise DecisionError("the cost of this decision is not finite")
        remaining = self._remaining(situation.deadline_s, started)
        inputs, certificate = self.answer(situation, target, problem, remaining)
        if self._stopwatch:
            certificate = replace(certificate, solve_time_s=self._stopwatch() - started)
        return Decision(_command(inputs), certificate)

    def answer(
        self,
        situation: Situation,
        target: Target,
        problem: BoxQuadratic,
        remaining_s: Callable[[], float] | None,
    ) -> tuple[Array, Certificate]:
        """The input (4,) in the problem's box and what it is worth. Laws that share target, box
        and course, but not the search, replace this."""
        if self._search is Search.CLOSED_FORM:
            inputs = closed_form(problem)
            return inputs, _exact_certificate(problem, inputs)
        result = self._swarm.minimise(problem, self._lanes, (), remaining_s)
        return result.best, certify(problem, result, self._exact)

    def reset(self) -> None:
        """Forget everything of the previous flight, the random stream included."""
        self._lanes.reset()
        if self._vehicle is not self._file:
            self.adopt(self._file)

    @property
    def bandwidth_radps(self) -> float:
        """The bandwidth that was asked for."""
        return self._settings.bandwidth_radps

    def adopt(
        self, vehicle: Vehicle, bandwidth_limit_radps: float = math.inf, *, gains: bool = True
    ) -> None:
        """Go on with a newly identified vehicle, at most this bandwidth; without `gains` only the
        feed-forward changes, which costs nothing."""
        self._vehicle = vehicle
        self._tilt_ripple = tilt_ripple(vehicle, self._period_s)
        self._thrust_ripple = thrust_ripple(vehicle, self._period_s)
        if gains:
            bandwidth = min(self._settings.bandwidth_radps, bandwidth_limit_radps)
            self.lateral = lateral_cost_to_go(vehicle, bandwidth, self._period_s)
            self.vertical = vertical_cost_to_go(vehicle, bandwidth, self._period_s)

    def target(self, reference: Reference, time_s: float, state: PredictedState) -> Target:
        """What to be and what to ask, for a decision at `time_s` with the state predicted to
        `state.time_s`, when its tilt begins to act. The disturbance is part of both."""
        vehicle, period_s = self._vehicle, self._period_s
        half_s = 0.5 * period_s
        heave_s = heave_of(state).time_s
        course_s = time_s + vehicle.yaw.delay_s + half_s
        times = [state.time_s, state.time_s + half_s, heave_s, heave_s + half_s, course_s]
        sample = reference.sample(np.array(times))
        flat = flat_state(
            _eased(sample, self._feedforward),
            vehicle.gravity_mps2,
            vehicle.drag_per_mass_ps,
            state.disturbance_ned_mps2,
        )
        b, b1 = flat.thrust_direction_ned, flat.thrust_direction_rate_ned_ps
        b2 = flat.thrust_direction_acceleration_ned_ps2
        tilt_slope = lead(b1[0, :2], b2[0, :2], np.zeros(2), vehicle.tilt)
        thrust_slope = flat.thrust_rate_mps3[2] * b[2, 2] + flat.thrust_mps2[2] * b1[2, 2]
        thrust_down = flat.thrust_mps2[2] * b[2, 2] + self._thrust_ripple * thrust_slope
        led_thrust = flat.thrust_mps2[3] + vehicle.thrust_lag_s * flat.thrust_rate_mps3[3]
        course = lead(
            sample.course_rad[4],
            sample.course_rate_radps[4],
            sample.course_acceleration_radps2[4],
            vehicle.yaw,
        )
        return Target(
            position_ne_m=sample.position_ned_m[0, :2],
            velocity_ne_mps=sample.velocity_ned_mps[0, :2],
            direction_ne=b[0, :2] + self._tilt_ripple[0] * tilt_slope,
            direction_rate_ne_ps=b1[0, :2] + self._tilt_ripple[1] * tilt_slope,
            position_down_m=float(sample.position_ned_m[2, 2]),
            velocity_down_mps=float(sample.velocity_ned_mps[2, 2]),
            thrust_down_mps2=float(thrust_down),
            tilt_feedforward=held_lead(b[1, :2], b1[1, :2], b2[1, :2], vehicle.tilt, period_s),
            thrust_down_feedforward_mps2=float(led_thrust * b[3, 2]),  # T lags, not T b_z
            course_feedforward_rad=float(course),
        )

    def problem(self, state: PredictedState, target: Target) -> BoxQuadratic:
        """J(u) of u = [T (m/s^2), b_cx, b_cy, course (rad)] and its box."""
        lateral, vertical = errors(state, target)
        upright = float(state.thrust_direction_ned[2])
        nominal = np.empty(4)
        nominal[0] = target.thrust_down_feedforward_mps2 / upright
        nominal[1:3] = target.tilt_feedforward
        nominal[3] = target.course_feedforward_rad
        curvature = np.empty(4)
        curvature[0] = self.vertical.curvature * upright**2
        curvature[1:3] = self.lateral.curvature
        curvature[3] = COURSE_CURVATURE
        slope = np.zeros(4)  # of J at the nominal input
        slope[0] = upright * (self.vertical.coupling @ vertical)
        slope[1:3] = self.lateral.coupling @ lateral
        rest = vertical @ self.vertical.state_cost @ vertical
        rest += np.sum(lateral * (self.lateral.state_cost @ lateral))
        gradient = slope - curvature * nominal
        constant = 0.5 * rest + nominal @ (0.5 * curvature * nominal - slope)
        lower, upper = self._box(nominal)
        return BoxQuadratic(np.diag(curvature), gradient, float(constant), lower, upper)

    def warm_up(self) -> None:
        """Call every code path once, compiled and daqp's, and forget it again."""
        gravity = self._vehicle.gravity_mps2
        down = np.array([0.0, 0.0, 1.0])
        state = PredictedState(
            0.0, np.zeros(3), np.zeros(3), down, np.zeros(3), 0.0, 0.0, gravity, np.zeros(3),
            np.zeros(3),
        )  # fmt: skip
        level = Command(gravity, (0.0, 0.0, 1.0), 0.0)
        self.decide(Situation(0.0, state, _Rest(), level, math.inf))
        self.reset()

    def _box(self, nominal: Array) -> tuple[Array, Array]:
        """Lower and upper (4,): thrust, |b_c| and |b_c - b_ff| per axis, course about its
        feed-forward. A feed-forward beyond the tilt limit counts as on it."""
        settings, vehicle = self._settings, self._vehicle
        limit = min(settings.tilt_limit, math.sin(vehicle.tilt_max_rad))
        centre = np.clip(nominal[1:3], -limit, limit)
        lower, upper = np.empty(4), np.empty(4)
        lower[0], upper[0] = settings.thrust_floor * vehicle.gravity_mps2, vehicle.thrust_max_mps2
        lower[1:3] = np.maximum(centre - settings.feedback_limit, -limit)
        upper[1:3] = np.minimum(centre + settings.feedback_limit, limit)
        lower[3], upper[3] = nominal[3] - COURSE_BOX_RAD, nominal[3] + COURSE_BOX_RAD
        return lower, upper

    def _remaining(self, deadline_s: float | None, started: float) -> Callable[[], float] | None:
        stopwatch = self._stopwatch
        if stopwatch is None or deadline_s is None:
            return None
        return lambda: deadline_s - (stopwatch() - started)


def _eased(sample: FlatSample, share: float) -> FlatSample:
    """The sample as if it moved by this share of its motion."""
    if share == 1.0:
        return sample
    return replace(
        sample,
        velocity_ned_mps=share * sample.velocity_ned_mps,
        acceleration_ned_mps2=share * sample.acceleration_ned_mps2,
        jerk_ned_mps3=share * sample.jerk_ned_mps3,
        snap_ned_mps4=share * sample.snap_ned_mps4,
    )


class _Rest:
    """A reference at rest in the origin, for warming up."""

    duration_s = 0.0

    def sample(self, time_s: float | Array) -> FlatSample:
        scalars = np.zeros(np.shape(time_s))
        vectors = np.zeros((*scalars.shape, 3))
        return FlatSample(vectors, vectors, vectors, vectors, vectors, scalars, scalars, scalars)


def errors(state: PredictedState, target: Target) -> tuple[Array, Array]:
    """Deviations from the target: lateral [p, v, b, b'] x [north, east] (4, 2) and vertical
    [z, v_z, T b_z] (3,)."""
    lateral = np.empty((4, 2))
    lateral[0] = state.position_ned_m[:2] - target.position_ne_m
    lateral[1] = state.velocity_ned_mps[:2] - target.velocity_ne_mps
    lateral[2] = state.thrust_direction_ned[:2] - target.direction_ne
    lateral[3] = state.thrust_direction_rate_ned_ps[:2] - target.direction_rate_ne_ps
    heave = heave_of(state)
    vertical = np.array(
        [
            heave.position_down_m - target.position_down_m,
            heave.velocity_down_mps - target.velocity_down_mps,
            heave.thrust_down_mps2 - target.thrust_down_mps2,
        ]
    )
    return lateral, vertical


def heave_of(state: PredictedState) -> PredictedHeave:
    """The vertical motion when the thrust acts; with the tilt, where nothing else was predicted."""
    return state.heave or PredictedHeave(
        time_s=state.time_s,
        position_down_m=float(state.position_ned_m[2]),
        velocity_down_mps=float(state.velocity_ned_mps[2]),
        thrust_down_mps2=float(state.thrust_mps2 * state.thrust_direction_ned[2]),
    )


def closed_form(problem: BoxQuadratic) -> Array:
    """The exact minimiser (n,) of a quadratic whose Hessian is diagonal: clip(-f / h)."""
    free = -problem.gradient / np.diag(problem.hessian)
    clipped: Array = np.clip(free, problem.lower, problem.upper)
    return clipped


def _exact_certificate(problem: BoxQuadratic, inputs: Array) -> Certificate:
    cost = float(problem(inputs))
    return Certificate(cost=cost, optimal_cost=cost, gap=0.0, at_bound=at_bound(problem, inputs))


def _command(inputs: Array) -> Command:
    thrust, north, east, course = (float(value) for value in inputs)
    down = math.sqrt(1.0 - north * north - east * east)
    return Command(thrust, (north, east, down), wrap_pi(course))


def _finite(problem: BoxQuadratic) -> bool:
    return bool(
        math.isfinite(problem.constant)
        and np.isfinite(problem.gradient).all()
        and np.isfinite(problem.lower).all()
        and np.isfinite(np.diag(problem.hessian)).all()
    )
