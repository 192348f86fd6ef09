"""The tracking law. Every law of this package, except `autopilot`, commands

    u = clip(u_ff - K (x_predicted - x_ref))

or, where bounds or a horizon couple the inputs, the u that minimises the same cost J.

    u            [T, b_cx, b_cy, heading]: thrust per unit of mass, north and east component of the
                 commanded thrust direction (third body axis, NED), commanded heading
    x_predicted  the state at the time when this command begins to act, predicted by the observer,
                 which replays the commands already sent (`offboard.estimation`)
    x_ref        the state of a vehicle that follows the reference at that time, by differential
                 flatness from the derivatives of the reference's position, from drag and from the
                 estimated disturbance (`TrackingLaw.target`)
    u_ff         the feed-forward: the input of a vehicle that follows the reference half a period
                 later, because a command is held for one period and acts on average in its middle.
                 It compensates the response of attitude and thrust, so that both are in time
    K            gain of the linear-quadratic regulator of each axis for one bandwidth (`gains`)
    clip         limits thrust, tilt, and the feedback about u_ff (`TrackingLaw._problem_of`)

In NED, acceleration = g e3 - T b - c v + d, with drag c and disturbance d. Written in the thrust
direction b, the lateral axes [p, v, b, b'], the vertical axis [z, v_z, T b_z] and the heading
decouple, and no heading frame is needed. K is designed for hover, where a change db of b changes
the acceleration by -g db. At thrust T and a tilted b, with T b_z kept, db changes the acceleration
by -T (1 + b b^T/b_z^2) db. Position and velocity errors are therefore scaled to those that need the
same db in hover (`Target.to_hover`). Without this scaling, the loop gain at 45 degrees of tilt is
2.8 times that of hover, which ends in a limit cycle.

    J(u) = x'Qx + u'Ru + x(k+1)'P x(k+1) = 1/2 (u - u*)'H(u - u*) + x'P x,  lower <= u <= upper

with the deviation x = x_predicted - x_ref, and u* = u_ff - K x; u'Ru counts u from u_ff. H is
diagonal, so that u = clip(u*) is the exact minimum. `lqr` computes this formula; `pso` searches for
the minimum with the swarm, which needs neither a diagonal H nor a quadratic cost; `mpc` and
`horizon` minimise the sum over N decisions; `pid` replaces K by the gains of two cascades. This
module knows no autopilot and no clock.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from offboard.control.bandwidth import FEEDBACK_LIMIT, supported_bandwidth
from offboard.control.base import (
    Bandwidth,
    Certificate,
    ControllerSettings,
    Decision,
    DecisionError,
    Situation,
)
from offboard.control.gains import hold_ripple, lateral_gain, vertical_gain
from offboard.control.quadratic import BoxQuadratic, ExactMinimum, at_bound
from offboard.control.swarm import SwarmSettings, certify, minimise
from offboard.model.axes import lateral_model, lead, vertical_model
from offboard.model.command import Command, PredictedState, PredictedVertical
from offboard.model.frames import wrap_pi
from offboard.model.vehicle import DelayUncertainty, Vehicle
from offboard.reference.base import Reference
from offboard.reference.flatness import FlatState, flat_state

Array = NDArray[np.float64]

HEADING_BOX_RAD = 0.5  # bounds about the feed-forward; the autopilot closes the yaw loop
HEADING_CURVATURE = 1.0  # any positive value gives the same minimum, the feed-forward
# Limits of the reference's heading acceleration in the feed-forward. Noisy rows of a table demand
# more, which saturates the motors: the thrust then exceeds the command
HEADING_ACCELERATION_RADPS2 = -5.0, 5.0
# Indices of the times at which `TrackingLaw.target` samples the reference: when the command begins
# to act on tilt or thrust, and half a period later, in the middle of its hold (heading: the latter)
TILT_BEGINS, TILT_HELD, THRUST_BEGINS, THRUST_HELD, HEADING_HELD = range(5)


class TrackingSettings(ControllerSettings):
    """Settings of the tracking laws. One number, the bandwidth wc, sets all gains: the weights are
    1 on position, g^2 / wc^4 on b_c and 1 / wc^4 on the vertical thrust.

    On PX4 and ArduCopter the tracking error falls quickly with wc up to 5 rad/s and slowly above.
    More than 5 rad/s needs a known delay: until the delay is identified in flight, the bandwidth
    in use is lower (`supported_bandwidth`).

    `feedback_limit` bounds the distance of each lateral component of b_c from its feed-forward: a
    swing from one tilt limit to the other would reach the angular acceleration limit of the
    attitude loop and end in a limit cycle.
    """

    bandwidth_radps: float = Field(default=7.0, ge=0.5, le=20)
    feedback_limit: float = Field(default=FEEDBACK_LIMIT, ge=0.02, le=1)


@dataclass(frozen=True, slots=True)
class Target:
    """x_ref and u_ff: state and input that follow the reference when the command acts. NED, SI.

    `lateral` (4, 2) is [p, v, b, b'] x [north, east] at the time of the predicted state, `vertical`
    (3,) is [z, v_z, T b_z] when the thrust acts; both include the ripple of held commands
    (`gains.hold_ripple`). `feedforward` (3,), b_c north, b_c east and T b_z, and `heading_rad` are
    taken half a period after the delay of their own axis and compensate its response. `to_hover`
    (2, 2), (T_hover / T) (1 - b b^T), turns lateral deviations into those that need the same
    change of b in hover.
    """

    lateral: Array
    vertical: Array
    feedforward: Array
    heading_rad: float
    to_hover: Array


@dataclass(frozen=True, slots=True)
class TrackingProblem:
    """The problem of one decision: `lateral` (4, 2) and `vertical` (3,) are the deviations of the
    predicted state from the target, `at_hover` (4, 2) is `lateral` scaled by `Target.to_hover`,
    `b_z` is the down component of the predicted thrust direction, and `quadratic` is the cost of
    u (4,) with its bounds."""

    target: Target
    lateral: Array
    at_hover: Array
    vertical: Array
    b_z: float
    quadratic: BoxQuadratic

    def inputs(self, deviation: Array) -> Array:
        """Return u (4,), not clipped, for a `deviation` (3,) from the feed-forward."""
        north, east, down_mps2 = self.target.feedforward + deviation
        return np.array([down_mps2 / self.b_z, north, east, self.target.heading_rad])


class TrackingLaw:
    """Base class of the laws: makes the `TrackingProblem` of each decision, for the vehicle and the
    bandwidth in use, which `set_vehicle` sets.

    `vehicle` is the vehicle model in use; `lateral` and `vertical` are its sampled axes with their
    gains and costs (`gains.CostToGo`).
    """

    def __init__(self, vehicle: Vehicle, settings: TrackingSettings, period_s: float = 0.1) -> None:
        self.period_s = period_s
        self.configured_radps = settings.bandwidth_radps
        self.settings, self._vehicle_file = settings, vehicle
        self._bandwidth_found_for: object = None  # delays, uncertainty and limits of `bandwidth`
        self.set_vehicle(vehicle)

    def reset(self) -> None:
        """Return to the vehicle file and the configured bandwidth."""
        self.set_vehicle(self._vehicle_file)

    def set_vehicle(self, vehicle: Vehicle, uncertainty: DelayUncertainty | None = None) -> None:
        """See `base.Adaptive`. Without an `uncertainty`, the configured bandwidth is used."""
        self.vehicle = vehicle
        self._tilt_ripple = hold_ripple(lateral_model(vehicle), self.period_s)
        (self._thrust_ripple,) = hold_ripple(vertical_model(vehicle), self.period_s)
        delays = vehicle.tilt, vehicle.thrust_delay_s, vehicle.thrust_lag_s, uncertainty
        limits = (
            *delays, vehicle.angular_acceleration_limit_radps2, vehicle.angular_rate_limit_radps,
        )  # fmt: skip
        configured = self.configured_radps
        if uncertainty is None:
            self.bandwidth = Bandwidth(configured, configured)
        elif limits != self._bandwidth_found_for:  # drag alone changes no bandwidth
            self.bandwidth = supported_bandwidth(vehicle, uncertainty, self.period_s, configured)
        self._bandwidth_found_for = limits
        self._use_gains()

    def _use_gains(self) -> None:
        lateral_radps, vertical_radps = self.bandwidth
        self.lateral = lateral_gain(self.vehicle, lateral_radps, self.period_s)
        self.vertical = vertical_gain(self.vehicle, vertical_radps, self.period_s)

    def problem(self, situation: Situation) -> TrackingProblem:
        """Return the problem of this tick. Raises DecisionError if its cost is not finite."""
        state = situation.state
        target = self.target(situation.reference, situation.time_s, state)
        motion = (
            state.position_ned_m,
            state.velocity_ned_mps,
            state.thrust_direction_ned,
            state.thrust_direction_rate_ned_ps,
        )
        lateral = np.array(motion)[:, :2] - target.lateral
        down = vertical_of(state)
        vertical = (down.position_down_m, down.velocity_down_mps, down.thrust_down_mps2)
        problem = self._problem_of(
            target, lateral, vertical - target.vertical, float(state.thrust_direction_ned[2])
        )
        cost = problem.quadratic
        parts = (cost.hessian.ravel(), cost.gradient, cost.lower, [cost.constant])
        if not np.isfinite(np.concatenate(parts)).all():
            raise DecisionError("the cost of this decision is not finite")
        return problem

    def target(self, reference: Reference, time_s: float, state: PredictedState) -> Target:
        """Return the target of a decision at `time_s`. `state` is predicted to the time when the
        commanded tilt begins to act; the target compensates the disturbance estimated in it."""
        vehicle, half_s = self.vehicle, 0.5 * self.period_s
        vertical_s = vertical_of(state).time_s
        heading_s = time_s + vehicle.yaw.delay_s + half_s
        times = [state.time_s, state.time_s + half_s, vertical_s, vertical_s + half_s, heading_s]
        sample = reference.sample(np.array(times))
        flat = flat_state(
            sample,
            vehicle.gravity_mps2,
            vehicle.drag_per_mass_ps,
            state.disturbance_ned_mps2,
        )
        b, b1 = flat.thrust_direction_ned, flat.thrust_direction_rate_ned_ps
        b2 = flat.thrust_direction_acceleration_ned_ps2
        at = TILT_BEGINS
        lateral = np.array((sample.position_ned_m[at], sample.velocity_ned_mps[at], b[at], b1[at]))
        tilt_slope = lead(b1[at], b2[at], np.zeros(3), vehicle.tilt)
        lateral[2:] += np.outer(self._tilt_ripple, tilt_slope)
        thrust, thrust_rate = flat.thrust_mps2, flat.thrust_rate_mps3
        at = THRUST_BEGINS
        thrust_slope = thrust_rate[at] * b[at, 2] + thrust[at] * b1[at, 2]
        vertical = (
            sample.position_ned_m[at, 2],
            sample.velocity_ned_mps[at, 2],
            thrust[at] * b[at, 2] + self._thrust_ripple * thrust_slope,
        )
        heading_rad = lead(
            sample.heading_rad[HEADING_HELD],
            sample.heading_rate_radps[HEADING_HELD],
            np.clip(sample.heading_acceleration_radps2[HEADING_HELD], *HEADING_ACCELERATION_RADPS2),
            vehicle.yaw,
        )
        return Target(
            lateral=lateral[:, :2],
            vertical=np.array(vertical),
            feedforward=self.feedforward(flat, TILT_HELD, THRUST_HELD),
            heading_rad=float(heading_rad),
            to_hover=to_hover(b[TILT_BEGINS], thrust[TILT_BEGINS], state, vehicle),
        )

    def feedforward(self, flat: FlatState, tilt: Any, thrust: Any) -> Array:
        """Return b_c north, b_c east and T b_z (..., 3) that follow the reference. `tilt` and
        `thrust` index the samples of `flat` in the middle of a hold. The response of the vehicle is
        compensated (`model.axes.lead`), and for the tilt also, to second order, the attenuation by
        the hold (README.md)."""
        b, rate = flat.thrust_direction_ned[tilt, :2], flat.thrust_direction_rate_ned_ps[tilt, :2]
        bend = flat.thrust_direction_acceleration_ned_ps2[tilt, :2]
        led_tilt = lead(b, rate, bend, self.vehicle.tilt) - self.period_s**2 / 24.0 * bend
        # Only T has this lag, not b_z
        led_thrust = flat.thrust_mps2 + self.vehicle.thrust_lag_s * flat.thrust_rate_mps3
        down = (led_thrust * flat.thrust_direction_ned[:, 2])[thrust]
        return np.concatenate((led_tilt, down[..., np.newaxis]), axis=-1)

    def _problem_of(
        self, target: Target, lateral: Array, vertical: Array, b_z: float
    ) -> TrackingProblem:
        """Return the problem of these deviations: the cost J, whose minimum without bounds is x'P x
        at u_ff - K x, and the bounds of u."""
        vehicle = self.vehicle
        curvature = np.array(
            [
                self.vertical.curvature * b_z**2,
                self.lateral.curvature,
                self.lateral.curvature,
                HEADING_CURVATURE,
            ]
        )
        at_hover = np.vstack((lateral[:2] @ target.to_hover, lateral[2:]))
        feedback = np.append(self.lateral.gain @ at_hover, self.vertical.gain @ vertical)
        north, east, down_mps2 = target.feedforward - feedback
        least = np.array([down_mps2 / b_z, north, east, target.heading_rad])
        rest = vertical @ self.vertical.terminal @ vertical
        rest += np.sum(at_hover * (self.lateral.terminal @ at_hover))
        gradient, constant = -curvature * least, rest + 0.5 * (curvature * least) @ least
        low, high = self.tilt_bounds(target.feedforward[:2])
        heading = target.heading_rad
        lower = np.array([vehicle.thrust_min_mps2, *low, heading - HEADING_BOX_RAD])
        upper = np.array([vehicle.thrust_max_mps2, *high, heading + HEADING_BOX_RAD])
        quadratic = BoxQuadratic(np.diag(curvature), gradient, float(constant), lower, upper)
        return TrackingProblem(target, lateral, at_hover, vertical, b_z, quadratic)

    def tilt_bounds(self, nominal: Array) -> tuple[Array, Array]:
        """Return the lower and upper bounds of b_c (..., 2) for feed-forwards `nominal` (..., 2):
        per axis, the tilt limits |b_c| and `feedback_limit` limits |b_c - b_ff|. A feed-forward
        beyond the tilt limit is taken as that limit."""
        limit = math.sin(self.vehicle.tilt_max_rad)
        centre, reach = np.clip(nominal, -limit, limit), self.settings.feedback_limit
        return np.maximum(centre - reach, -limit), np.minimum(centre + reach, limit)


def vertical_of(state: PredictedState) -> PredictedVertical:
    """Return the predicted vertical motion when the thrust acts, or that at `state.time_s` if it
    was not predicted separately."""
    return state.vertical or PredictedVertical(
        time_s=state.time_s,
        position_down_m=float(state.position_ned_m[2]),
        velocity_down_mps=float(state.velocity_ned_mps[2]),
        thrust_down_mps2=float(state.thrust_mps2 * state.thrust_direction_ned[2]),
    )


def to_hover(b: Array, thrust_mps2: Array, state: PredictedState, vehicle: Vehicle) -> Array:
    """Return `Target.to_hover` (..., 2, 2) at directions b (..., 3) and thrusts (...). T_hover
    includes the estimated vertical disturbance, because the cause of that is nearly always a wrong
    hover thrust or mass."""
    hovering_mps2 = vehicle.gravity_mps2 + state.disturbance_ned_mps2[2]
    share = hovering_mps2 / np.maximum(thrust_mps2, vehicle.thrust_min_mps2)
    lateral = b[..., :2]
    across = np.eye(2) - lateral[..., :, None] * lateral[..., None, :]
    scaled: Array = share[..., None, None] * across
    return scaled


def decision(inputs: Array, certificate: Certificate) -> Decision:
    """Return the decision for u (4,). With both lateral components of b_c at their bounds the tilt
    exceeds its limit; `flight.outbox.clamp` then reduces it to the limit."""
    thrust, north, east, heading = (float(value) for value in inputs)
    lateral = max(1.0, math.hypot(north, east))
    north, east = north / lateral, east / lateral
    down = math.sqrt(max(0.0, 1.0 - north * north - east * east))
    return Decision(Command(thrust, (north, east, down), wrap_pi(heading)), certificate)


class LqrSettings(TrackingSettings):
    """Settings of the law `lqr`."""

    law: Literal["lqr"] = "lqr"

    def build(self, vehicle: Vehicle, *, period_s: float, seed: int) -> LqrLaw:
        return LqrLaw(vehicle, self, period_s)


class LqrLaw(TrackingLaw):
    """Commands clip(-f / H), the exact minimum of a cost whose H is diagonal."""

    def decide(self, situation: Situation) -> Decision:
        problem = self.problem(situation).quadratic
        inputs = problem.clip(-problem.gradient / np.diag(problem.hessian))
        cost = float(problem(inputs))
        on_bound = at_bound(problem, inputs)
        return decision(inputs, Certificate(cost, optimal_cost=cost, gap=0.0, at_bound=on_bound))


class PsoSettings(TrackingSettings):
    """Settings of the law `pso`."""

    law: Literal["pso"] = "pso"
    swarm: SwarmSettings = SwarmSettings()

    def build(self, vehicle: Vehicle, *, period_s: float, seed: int) -> PsoLaw:
        return PsoLaw(vehicle, self, period_s, seed)


class PsoLaw(TrackingLaw):
    """Commands the minimum that the swarm finds, and certifies it against the exact one."""

    def __init__(
        self, vehicle: Vehicle, settings: PsoSettings, period_s: float = 0.1, seed: int = 0
    ) -> None:
        super().__init__(vehicle, settings, period_s)
        self._swarm, self._seed = settings.swarm, seed
        self._rng = np.random.default_rng(seed)
        self._exact = ExactMinimum(4)

    def decide(self, situation: Situation) -> Decision:
        problem = self.problem(situation).quadratic
        result = minimise(self._swarm, problem, self._rng, situation.remaining_s)
        return decision(result.best, certify(problem, result, self._exact))

    def reset(self) -> None:
        super().reset()
        self._rng = np.random.default_rng(self._seed)
