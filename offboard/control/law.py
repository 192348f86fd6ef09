"""The tracking law. Every law of this package decides

    u = clip(u_ff - K (x_predicted - x_ref))

or, where the bounds or a horizon couple the inputs, the u that minimises the same cost J.

    u            [T, b_cx, b_cy, heading]: thrust per unit of mass, north and east of the commanded
                 thrust direction (third body axis, NED), commanded heading
    x_predicted  the state at the time when this command will begin to act: the observer's, carried
                 there by replaying the commands already sent (`offboard.estimation`)
    x_ref        what the reference asks for at that time, by differential flatness from its
                 position and derivatives, drag and the estimated disturbance (`Tracking.target`)
    u_ff         what follows the reference without an error: half a period later, because a command
                 is held for one period and acts on average in its middle, and led through the
                 response of attitude and thrust, so that these arrive in time
    K            gain of the linear-quadratic regulator of each axis for one bandwidth (`gains`)
    clip         thrust, tilt, and the feedback about u_ff (`Tracking._box`)

In NED, acceleration = g e3 - T b - c v + d: written in b, the lateral axes [p, v, b, b'], the
vertical [z, v_z, T b_z] and the heading decouple, and no heading frame is needed.

    J(u) = x'Qx + u'Ru + x(k+1)'P x(k+1) = 1/2 u'Hu + f'u + c,  lower <= u <= upper

H is diagonal, so that u = clip(-f / H) is its exact minimum. `lqr` computes just that; `pso` lets
the swarm search, which needs neither a diagonal nor a quadratic; `mpc` and `horizon` minimise the
sum over N decisions; `pid` replaces K by the gains of two cascades. Knows no autopilot, no clock.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from offboard.control.bandwidth import supported_bandwidth
from offboard.control.base import (
    Certificate,
    ControllerSettings,
    Decision,
    DecisionError,
    Situation,
)
from offboard.control.gains import (
    held_lead,
    lateral_gain,
    thrust_ripple,
    tilt_ripple,
    vertical_gain,
)
from offboard.control.quadratic import BoxQuadratic
from offboard.model.axes import lead
from offboard.model.command import Command, PredictedHeave, PredictedState
from offboard.model.frames import wrap_pi
from offboard.model.vehicle import DelayUncertainty, Vehicle
from offboard.reference.base import Reference
from offboard.reference.flatness import flat_state

Array = NDArray[np.float64]

HEADING_BOX_RAD = 0.5  # about the feed-forward: the autopilot closes the yaw loop
HEADING_CURVATURE = 1.0


class TrackingSettings(ControllerSettings):
    """One number, the bandwidth wc, sets the law: weights 1 on position, g^2 / wc^4 on b_c and
    1 / wc^4 on the vertical thrust.

    On PX4 and ArduCopter the error falls quickly up to 5 rad/s and slowly beyond. More than 5 rad/s
    needs a known delay: until it is identified in flight, `supported_bandwidth` is lower.

    `feedback_limit` bounds each lateral component of b_c about its feed-forward: a swing from one
    tilt limit to the other would run into the acceleration limit of the attitude loop and end in a
    limit cycle. `tilt_limit` bounds each lateral component of b_c itself. `thrust_floor` is the
    least thrust as a fraction of g.
    """

    bandwidth_radps: float = Field(default=7.0, ge=0.5, le=20)
    feedback_limit: float = Field(default=0.3, gt=0, le=1)
    tilt_limit: float = Field(default=0.7, gt=0, le=0.7)
    thrust_floor: float = Field(default=0.2, ge=0, lt=1)


@dataclass(frozen=True, slots=True)
class Target:
    """State and input that the reference asks for when the command acts. NED, SI; the ripple of
    held commands (`gains.hold_ripple`) is included.

    Lateral, each (2,), north and east, at the time of the predicted state: position_ne_m,
    velocity_ne_mps, thrust direction direction_ne and its rate direction_rate_ne_ps. Vertical, at
    the time when the thrust acts: position_down_m, velocity_down_mps and T b_z, thrust_down_mps2.
    Feed-forward of tilt (2,), vertical thrust and heading, each taken half a period after its own
    delay and led through its own response.
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
    heading_feedforward_rad: float


@dataclass(frozen=True, slots=True)
class Task:
    """What one decision is about.

    `lateral` (4, 2), [p, v, b, b'] x [north, east], and `vertical` (3,), [z, v_z, T b_z], are the
    deviations of the predicted state from the target; `b_z` is that of its thrust direction.
    `problem` is the cost of u (4,) and its bounds.
    """

    target: Target
    lateral: Array
    vertical: Array
    b_z: float
    problem: BoxQuadratic

    def inputs(self, deviation: Array) -> Array:
        """u (4,), not clipped, for a deviation (3,) from the feed-forward: b_c north, b_c east and
        vertical thrust."""
        inputs = np.empty(4)
        inputs[0] = (self.target.thrust_down_feedforward_mps2 + deviation[2]) / self.b_z
        inputs[1:3] = self.target.tilt_feedforward + deviation[:2]
        inputs[3] = self.target.heading_feedforward_rad
        return inputs


class TrackingLaw:
    """Base class of the laws: makes the `Task` of each decision, for the vehicle and the bandwidth
    in use, which `set_vehicle` sets.

    `limits` are the settings, `vehicle` is the vehicle in use; `lateral` and `vertical` are the
    models of its axes with the optimal cost that follows one held input.
    """

    def __init__(self, vehicle: Vehicle, settings: TrackingSettings, period_s: float) -> None:
        self.period_s = period_s
        self.configured_radps = self.bandwidth_radps = settings.bandwidth_radps
        self.limits, self._file = settings, vehicle
        self._delays: object = None  # and their uncertainty, that the bandwidth was found for
        self.set_vehicle(vehicle)

    def reset(self) -> None:
        """Return to the vehicle file and the configured bandwidth."""
        self.set_vehicle(self._file)

    def set_vehicle(self, vehicle: Vehicle, uncertainty: DelayUncertainty | None = None) -> None:
        """See `base.Adaptive`; without an uncertainty the bandwidth is the configured one."""
        self.vehicle = vehicle
        self._tilt_ripple = tilt_ripple(vehicle, self.period_s)
        self._thrust_ripple = thrust_ripple(vehicle, self.period_s)
        delays = vehicle.tilt, vehicle.thrust_delay_s, vehicle.thrust_lag_s, uncertainty
        bandwidth = self.bandwidth_radps
        if uncertainty is None:
            bandwidth = self.configured_radps
        elif delays != self._delays:  # another drag alone changes no bandwidth
            configured = self.configured_radps
            bandwidth = supported_bandwidth(vehicle, uncertainty, self.period_s, configured)
        self._delays = delays
        self._use_gains(bandwidth)

    def _use_gains(self, bandwidth_radps: float) -> None:
        self.bandwidth_radps = bandwidth_radps
        self.lateral = lateral_gain(self.vehicle, bandwidth_radps, self.period_s)
        self.vertical = vertical_gain(self.vehicle, bandwidth_radps, self.period_s)

    @property
    def tilt_limit(self) -> float:
        """Bound of each lateral component of b_c."""
        return min(self.limits.tilt_limit, math.sin(self.vehicle.tilt_max_rad))

    def task(self, situation: Situation) -> Task:
        """The task of this tick. Raises DecisionError where its cost is not finite."""
        state = situation.state
        target = self.target(situation.reference, situation.time_s, state)
        lateral, vertical = deviations(state, target)
        b_z = float(state.thrust_direction_ned[2])
        problem = self._problem(target, lateral, vertical, b_z)
        if not _finite(problem):
            raise DecisionError("the cost of this decision is not finite")
        return Task(target, lateral, vertical, b_z, problem)

    def target(self, reference: Reference, time_s: float, state: PredictedState) -> Target:
        """The target of a decision at `time_s`, for the state predicted to the time when its tilt
        begins to act. The estimated disturbance is compensated in it."""
        vehicle, period_s = self.vehicle, self.period_s
        half_s = 0.5 * period_s
        heave_s = heave_of(state).time_s
        heading_s = time_s + vehicle.yaw.delay_s + half_s
        times = [state.time_s, state.time_s + half_s, heave_s, heave_s + half_s, heading_s]
        sample = reference.sample(np.array(times))
        flat = flat_state(
            sample,
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
        heading = lead(
            sample.heading_rad[4],
            sample.heading_rate_radps[4],
            sample.heading_acceleration_radps2[4],
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
            thrust_down_feedforward_mps2=float(led_thrust * b[3, 2]),  # T lags, b_z does not
            heading_feedforward_rad=float(heading),
        )

    def _problem(self, target: Target, lateral: Array, vertical: Array, b_z: float) -> BoxQuadratic:
        nominal = np.empty(4)
        nominal[0] = target.thrust_down_feedforward_mps2 / b_z
        nominal[1:3] = target.tilt_feedforward
        nominal[3] = target.heading_feedforward_rad
        curvature = np.empty(4)
        curvature[0] = self.vertical.curvature * b_z**2
        curvature[1:3] = self.lateral.curvature
        curvature[3] = HEADING_CURVATURE
        slope = np.zeros(4)  # of J at the nominal input
        slope[0] = b_z * (self.vertical.coupling @ vertical)
        slope[1:3] = self.lateral.coupling @ lateral
        rest = vertical @ self.vertical.state_cost @ vertical
        rest += np.sum(lateral * (self.lateral.state_cost @ lateral))
        gradient = slope - curvature * nominal
        constant = 0.5 * rest + nominal @ (0.5 * curvature * nominal - slope)
        lower, upper = self._box(nominal)
        return BoxQuadratic(np.diag(curvature), gradient, float(constant), lower, upper)

    def _box(self, nominal: Array) -> tuple[Array, Array]:
        """Lower and upper (4,): thrust, |b_c| and |b_c - b_ff| per axis, heading about its
        feed-forward. A feed-forward beyond the tilt limit counts as being at the limit."""
        settings, vehicle, limit = self.limits, self.vehicle, self.tilt_limit
        centre = np.clip(nominal[1:3], -limit, limit)
        lower, upper = np.empty(4), np.empty(4)
        lower[0], upper[0] = settings.thrust_floor * vehicle.gravity_mps2, vehicle.thrust_max_mps2
        lower[1:3] = np.maximum(centre - settings.feedback_limit, -limit)
        upper[1:3] = np.minimum(centre + settings.feedback_limit, limit)
        lower[3], upper[3] = nominal[3] - HEADING_BOX_RAD, nominal[3] + HEADING_BOX_RAD
        return lower, upper


def deviations(state: PredictedState, target: Target) -> tuple[Array, Array]:
    """`Task.lateral` (4, 2) and `Task.vertical` (3,) of a predicted state."""
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
    """The vertical motion when the thrust acts; at `state.time_s` where it was not predicted."""
    return state.heave or PredictedHeave(
        time_s=state.time_s,
        position_down_m=float(state.position_ned_m[2]),
        velocity_down_mps=float(state.velocity_ned_mps[2]),
        thrust_down_mps2=float(state.thrust_mps2 * state.thrust_direction_ned[2]),
    )


def decision(inputs: Array, certificate: Certificate) -> Decision:
    """The decision for u (4,)."""
    thrust, north, east, heading = (float(value) for value in inputs)
    down = math.sqrt(1.0 - north * north - east * east)
    return Decision(Command(thrust, (north, east, down), wrap_pi(heading)), certificate)


def _finite(problem: BoxQuadratic) -> bool:
    return bool(
        math.isfinite(problem.constant)
        and np.isfinite(problem.gradient).all()
        and np.isfinite(problem.lower).all()
        and np.isfinite(np.diag(problem.hessian)).all()
    )
