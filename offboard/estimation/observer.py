"""The observer: a Kalman filter that estimates the vehicle's state now and predicts it for the time
when a command sent now acts.

    predict   x(t + h) = f(x(t), commands sent)      `motion`, with the delay of each axis
              P <- F P F' + Q                        F = exp(A h), f linearised about hover
    update    S = H P H' + R,  K = P H' / S          with each attitude and position that arrives
              x <- x + K (z - H x),  P <- P - K S K'
    reset     on the ground, after a long gap, and after a jump of the vehicle's own estimate

The state x (indices in `motion`, NED, SI) is position, velocity, thrust direction b and its rate,
disturbance acceleration d, bias of the reported velocity, thrust, heading and its rate. d contains
wind and errors of thrust and mass, so that the hover thrust follows from it. R of position and
velocity, and the drift of d in Q, are estimated as well (`noise`).

The velocity that an autopilot reports need not be the derivative of the position that it reports
(PX4: wrong by 0.2 to 0.3 m/s for seconds). The observer therefore estimates velocity from the
position and the commands *sent*, and models the reported velocity with a bias that changes slowly.
All times are vehicle time.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from offboard.compiled import array, entry, kernel
from offboard.estimation.motion import (
    BIAS,
    BIAS_TIME_CONSTANT_S,
    COMMAND_SIZE,
    DISTURBANCE,
    HEADING,
    HEADING_RATE,
    POSITION,
    SENT_AT,
    SENT_THRUST,
    STATE_SIZE,
    THRUST,
    TILT,
    TILT_RATE,
    VELOCITY,
    plant_of,
    propagate,
)
from offboard.estimation.noise import Noise, NoiseEstimate
from offboard.model.axes import acceleration, b_z_of, lateral_model
from offboard.model.command import Command, PredictedState, PredictedVertical
from offboard.model.frames import (
    heading_from_quaternion,
    thrust_direction_from_quaternion,
    wrap_pi,
)
from offboard.model.vehicle import Vehicle

Array = NDArray[np.float64]
Triple = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]

LATEST_S = 0.1  # telemetry that is this much older than the newest is dropped
LONGEST_GAP_S = 1.0  # a longer gap or step back in time restarts the filter
# A measurement counts as a jump of the vehicle's estimate if its innovation exceeds GATE_SDS
# standard deviations plus a distance: position (m), velocity (m/s)
GATE_SDS, GATES = 3.0, (0.3, 0.5)
DISTURBANCE_LIMIT_MPS2 = 8.0
COMMANDS_REPLAYED = 128  # at most
FARTHEST_S = 5.0  # longest prediction; the limits on link and vehicle allow no longer delay

# H of position and reported velocity (6, 19), and of attitude (3, 19): thrust direction, heading
H_POSITION, H_ATTITUDE = np.zeros((6, STATE_SIZE)), np.zeros((3, STATE_SIZE))
H_POSITION[:, POSITION : VELOCITY + 3] = np.eye(6)
H_POSITION[3:, BIAS : BIAS + 3] = np.eye(3)
H_ATTITUDE[range(3), (TILT, TILT + 1, HEADING)] = 1.0
# Rows of H_POSITION that are reset together: position north and east, down; the same of velocity
TOGETHER = ((0, 2), (2, 3), (3, 5), (5, 6))

# Standard deviations at the first telemetry, which sets position, velocity and attitude;
# disturbance and bias start at zero
START_SDS = np.array([0.1] * 3 + [0.3] * 3 + [0.02] * 2 + [0.3] * 2 + [1.0, 1.0, 1.5] + [0.3] * 3
                     + [0.0, 0.05, 0.3])  # fmt: skip


def dynamics_of(vehicle: Vehicle) -> Array:
    """Return A (19, 19) of x' = A x: f linearised about hover, where an error of the thrust
    direction accelerates by g times that error, without the lag of the thrust."""
    dynamics = np.zeros((STATE_SIZE, STATE_SIZE))
    for i in range(3):
        dynamics[POSITION + i, VELOCITY + i] = dynamics[VELOCITY + i, DISTURBANCE + i] = 1.0
        dynamics[VELOCITY + i, VELOCITY + i] = -vehicle.drag_per_mass_ps
        dynamics[BIAS + i, BIAS + i] = -1.0 / BIAS_TIME_CONSTANT_S
    for i in range(2):
        axis = POSITION + i, VELOCITY + i, TILT + i, TILT_RATE + i
        dynamics[np.ix_(axis, axis)] = lateral_model(vehicle).dynamics
    frequency = vehicle.yaw.natural_frequency_radps
    dynamics[HEADING, HEADING_RATE] = 1.0
    dynamics[HEADING_RATE, HEADING:] = -(frequency**2), -2.0 * vehicle.yaw.damping * frequency
    return dynamics


def densities_of(noise: Noise) -> Array:
    """Return the process noise (19,) per root second."""
    densities = np.zeros(STATE_SIZE)
    densities[VELOCITY : VELOCITY + 3] = noise.acceleration_mps
    densities[TILT_RATE : TILT_RATE + 2] = noise.tilt_radps
    densities[DISTURBANCE : DISTURBANCE + 3] = noise.disturbance_mps2
    densities[BIAS : BIAS + 3] = noise.bias_mps
    densities[HEADING_RATE] = noise.heading_radps
    return densities


@entry(array(2), array(2), array(1), float, float)
def predict_covariance(
    covariance: Array, dynamics: Array, densities: Array, interval_s: float, longest_s: float
) -> None:
    """Do P <- F P F' + Q over `interval_s`, in place, in steps of at most `longest_s`."""
    steps = math.ceil(interval_s / longest_s - 1e-6)
    if steps <= 0:
        return
    h, size = interval_s / steps, covariance.shape[0]
    half, moved = np.eye(size), np.empty((size, size))
    transition, noise = np.empty((size, size)), np.zeros((size, size))
    # F = exp(A h / 2)^2, with the exponential to fourth order by Horner's rule
    for order in (4, 3, 2, 1):
        _multiply(dynamics, half, moved)
        for i in range(size):
            for j in range(size):
                half[i, j] = 0.5 * h / order * moved[i, j]
            half[i, i] += 1.0
    _multiply(half, half, transition)
    # Q by Simpson's rule, exact for a chain of two integrators
    for k in range(size):
        weight = densities[k] ** 2 * h / 6.0
        noise[k, k] += weight
        for i in range(size):
            middle, end = 4.0 * weight * half[i, k], weight * transition[i, k]
            if end != 0.0:
                for j in range(size):
                    noise[i, j] += middle * half[j, k] + end * transition[j, k]
    for _ in range(steps):
        _multiply(transition, covariance, moved)
        for i in range(size):
            for j in range(size):
                half[i, j] = moved[j, i]
        _multiply(transition, half, covariance)  # F (F P)' = F P F'
        for i in range(size):
            for j in range(size):
                covariance[i, j] += noise[i, j]


@kernel
def _multiply(left: Array, right: Array, out: Array) -> None:
    """Do out = left @ right for a sparse `left`; compiles in a tenth of the time of `@`."""
    for i in range(out.shape[0]):
        for j in range(out.shape[1]):
            out[i, j] = 0.0
        for k in range(out.shape[0]):
            if left[i, k] != 0.0:
                for j in range(out.shape[1]):
                    out[i, j] += left[i, k] * right[k, j]


@entry(array(1), array(2), array(2), array(1), float, float)
def update(
    state: Array, covariance: Array, h: Array, measured: Array, variance: float, gate: float
) -> bool:
    """Update state (19,) and covariance with `measured` (m,), H = `h` (m, 19) and R = `variance`
    times the identity, one measurement after the other, so that S is a scalar. Return False, and
    change nothing, if an innovation exceeds `gate` plus GATE_SDS standard deviations."""
    size, projected = state.shape[0], np.empty_like(state)
    for row in range(h.shape[0]):
        innovation, total = _innovation(state, covariance, h[row], measured[row], projected)
        if abs(innovation) > gate + GATE_SDS * math.sqrt(total + variance):
            return False
    for row in range(h.shape[0]):
        innovation, total = _innovation(state, covariance, h[row], measured[row], projected)
        total += variance
        for i in range(size):
            gain = projected[i] / total
            state[i] += gain * innovation
            for j in range(i + 1):
                covariance[i, j] = covariance[j, i] = covariance[i, j] - gain * projected[j]
    for i in range(DISTURBANCE, DISTURBANCE + 3):
        state[i] = min(max(state[i], -DISTURBANCE_LIMIT_MPS2), DISTURBANCE_LIMIT_MPS2)
    return True


@kernel
def _innovation(
    state: Array, covariance: Array, row: Array, measured: float, projected: Array
) -> tuple[float, float]:
    """Return z - H x and H P H' of one `row` of H; `projected` becomes P H'."""
    innovation, total = measured, 0.0
    for i in range(len(state)):
        projected[i] = 0.0
    for j in range(len(state)):
        if row[j] != 0.0:
            innovation -= row[j] * state[j]
            for i in range(len(state)):
                projected[i] += row[j] * covariance[j, i]
    for j in range(len(state)):
        total += row[j] * projected[j]
    return innovation, total


class Observer:
    """State estimate of one vehicle.

    It needs every attitude and position that arrives (`on_attitude`, `on_position`) and every
    command that is sent (`on_command`); `predict` returns the state that a decision needs.

    Args:
        vehicle: constants of the vehicle.
        noise: noise of telemetry and of the disturbance.
    """

    def __init__(self, vehicle: Vehicle, noise: Noise | None = None) -> None:
        self._noise = noise or Noise()
        self._time_s = -math.inf  # vehicle time of the state
        self._position_at: float | None = None  # vehicle time of the newest one
        self._attitude_at: float | None = None
        self._set_vehicle(vehicle)
        self.reset()

    def reset(self) -> None:
        """Return to the state after construction, for another flight; keep the vehicle model."""
        self._frozen = False
        self._sent = np.empty((0, COMMAND_SIZE))
        self._state: Array = np.zeros(STATE_SIZE)
        self._densities = densities_of(self._noise)
        self.estimated = NoiseEstimate(self._noise)
        self._rates = np.zeros(3)
        self._restart()

    def set_vehicle(self, vehicle: Vehicle) -> None:
        """Continue with another vehicle model, as identified in flight. Thrust and disturbance are
        converted to the new model; the motion stays. From now on the vertical drift is estimated
        too: before the thrust is identified, an error of its delay looks like drift, and a faster
        correction would make the vehicle oscillate."""
        before = self._vehicle
        scale = before.hover_thrust / vehicle.hover_thrust
        self._sent[:, SENT_THRUST] *= scale
        state = self._state
        state[THRUST] *= scale
        disturbance = state[DISTURBANCE : DISTURBANCE + 3]
        down = (before.gravity_mps2 + disturbance[2]) * scale - vehicle.gravity_mps2
        slowed = vehicle.drag_per_mass_ps - before.drag_per_mass_ps
        disturbance[2] = down
        disturbance += slowed * state[VELOCITY : VELOCITY + 3]
        np.clip(disturbance, -DISTURBANCE_LIMIT_MPS2, DISTURBANCE_LIMIT_MPS2, out=disturbance)
        self._set_vehicle(vehicle)
        self.estimated.permit_vertical_drift()

    @property
    def ready(self) -> bool:
        """Whether position and attitude have both arrived since the start or a long gap."""
        return self._position_at is not None and self._attitude_at is not None

    @property
    def hover_thrust_estimate(self) -> float:
        """Normalised hover thrust, u_h (1 + d_z / g); within 3 % of the true value five seconds
        after takeoff."""
        down = float(self._state[DISTURBANCE + 2])
        return self._vehicle.hover_thrust * (1.0 + down / self._vehicle.gravity_mps2)

    def freeze(self, frozen: bool) -> None:
        """Stop or resume the filter. It is frozen on the ground and while the vehicle does not
        follow our commands. The state then consists of the reported position and velocity and the
        measured attitude, without a disturbance; the filter resumes from there."""
        if frozen != self._frozen:
            self._forget_errors()
        self._frozen = frozen

    def on_command(self, time_s: float, command: Command) -> None:
        """Store a command that was sent. The delays of the vehicle model count from `time_s`: the
        vehicle time of the newest telemetry, plus the growth of the link delay since takeoff."""
        north, east, _ = command.thrust_direction_ned
        if len(self._sent):
            time_s = max(time_s, float(self._sent[-1, SENT_AT]))
        row = time_s, north, east, command.thrust_mps2, command.heading_rad
        self._sent = np.vstack((self._sent[1 - COMMANDS_REPLAYED :], row))

    def on_attitude(self, time_s: float, q: Quaternion, rates: Triple) -> None:
        """Use an attitude: quaternion (FRD to NED, w first) and body rates (rad/s, FRD)."""
        if not self._accepts(time_s, self._attitude_at):
            return
        north, east, _ = thrust_direction_from_quaternion(q).tolist()
        heading = float(heading_from_quaternion(q))
        self._rates = np.array(rates, dtype=np.float64)
        state = self._state
        if self._attitude_at is None or self._frozen:
            state[TILT : TILT + 2] = north, east
            state[TILT_RATE : TILT_RATE + 2] = 0.0
            state[HEADING], state[HEADING_RATE] = heading, 0.0
            state[THRUST] = self._vehicle.gravity_mps2 / b_z_of(north, east)
            self._time_s = max(self._time_s, time_s)
        else:
            self._go_to(time_s, complete=self._position_at is not None)
            late_s = self._time_s - time_s
            rate_n, rate_e, now, turning = state[[TILT_RATE, TILT_RATE + 1, HEADING, HEADING_RATE]]
            turned = wrap_pi(float(heading - now + late_s * turning))
            measured = np.array([north + late_s * rate_n, east + late_s * rate_e, now + turned])
            variance = self._noise.attitude_sd_rad**2
            update(state, self._covariance, H_ATTITUDE, measured, variance, math.inf)
        self._attitude_at = time_s

    def on_position(self, time_s: float, position_ned_m: Triple, velocity_ned_mps: Triple) -> None:
        """Use the position and velocity reported for `time_s`."""
        if not self._accepts(time_s, self._position_at):
            return
        if self._position_at is None or self._frozen:
            self._state[POSITION : POSITION + 3] = position_ned_m
            self._state[VELOCITY : VELOCITY + 3] = velocity_ned_mps
            self._time_s = max(self._time_s, time_s)
        else:
            self._go_to(time_s, complete=self._attitude_at is not None)
            measured = np.array((*position_ned_m, *velocity_ned_mps), dtype=np.float64)
            if self._time_s > time_s:
                measured += (self._time_s - time_s) * self._motion()
            self._update_by_position(measured)
        self._position_at = time_s

    def _motion(self) -> Array:
        """Return the velocity and acceleration (6,) of the model at the time of the state."""
        state, gravity = self._state, np.array([0.0, 0.0, self._vehicle.gravity_mps2])
        north, east = state[TILT : TILT + 2].tolist()
        velocity, disturbance = state[VELOCITY:TILT], state[DISTURBANCE:BIAS]
        push = state[THRUST] * np.array([north, east, b_z_of(north, east)])
        drag_ps = self._vehicle.drag_per_mass_ps
        accelerated = acceleration(gravity, push, drag_ps, velocity, disturbance)
        return np.concatenate((velocity, accelerated))

    def _update_by_position(self, measured: Array) -> None:
        """Update with the present position and velocity (6,); reset those beyond their gates."""
        state, estimated = self._state, self.estimated
        innovation = measured - H_POSITION @ state
        variances, jumped = estimated.variances, False
        for first, end in TOGETHER:
            kind = first // 3  # position or velocity
            h, z = H_POSITION[first:end], measured[first:end]
            if not update(state, self._covariance, h, z, variances[kind], GATES[kind]):
                jumped = True
                for row in range(first, end):
                    self._reset(row, measured[row], variances[kind])
        if jumped:
            estimated.interrupt()
            return
        estimated.update(self._time_s, innovation, measured)
        self._densities[DISTURBANCE : DISTURBANCE + 2] = estimated.drift_mps2[0]
        self._densities[DISTURBANCE + 2] = estimated.drift_mps2[1]

    def _reset(self, row: int, measured: float, variance: float) -> None:
        """Reset one `row` of H_POSITION after a jump: set the position to the measured one, or the
        bias to the reported minus the estimated velocity. The other states stay."""
        state, covariance = self._state, self._covariance
        if row < 3:
            state[POSITION + row] = measured
            covariance[POSITION + row] = covariance[:, POSITION + row] = 0.0
            covariance[POSITION + row, POSITION + row] = variance
            return
        velocity, bias = VELOCITY + row - 3, BIAS + row - 3
        state[bias] = measured - state[velocity]
        covariance[bias] = -covariance[velocity]
        covariance[:, bias] = covariance[bias]
        covariance[bias, bias] = covariance[velocity, velocity] + variance

    def predict(self, time_s: float) -> PredictedState:
        """Return the state when the tilt of a command sent at `time_s` begins to act, after the
        delay of the tilt; the commands sent until then are replayed. `vertical` is the vertical
        motion after the delay of the thrust. Valid once `ready`."""
        tilt_s = time_s + self._vehicle.tilt.delay_s
        thrust_s = time_s + self._vehicle.thrust_delay_s
        numbers = self._propagated(thrust_s).tolist()
        vertical = PredictedVertical(
            time_s=thrust_s,
            position_down_m=numbers[POSITION + 2],
            velocity_down_mps=numbers[VELOCITY + 2],
            thrust_down_mps2=numbers[THRUST] * b_z_of(numbers[TILT], numbers[TILT + 1]),
        )
        state = self._propagated(tilt_s)
        north, east, rate_n, rate_e = state[TILT : TILT_RATE + 2].tolist()
        down = b_z_of(north, east)
        rate_d = -(north * rate_n + east * rate_e) / down
        return PredictedState(
            time_s=tilt_s,
            position_ned_m=state[POSITION : POSITION + 3],
            velocity_ned_mps=state[VELOCITY : VELOCITY + 3],
            thrust_direction_ned=np.array([north, east, down]),
            thrust_direction_rate_ned_ps=np.array([rate_n, rate_e, rate_d]),
            heading_rad=wrap_pi(float(state[HEADING])),
            heading_rate_radps=float(state[HEADING_RATE]),
            thrust_mps2=float(state[THRUST]),
            disturbance_ned_mps2=state[DISTURBANCE : DISTURBANCE + 3],
            rates_frd_radps=self._rates.copy(),
            vertical=vertical,
        )

    def _propagated(self, time_s: float) -> Array:
        """Return a copy of the state, propagated to `time_s`."""
        state = self._state.copy()
        ahead_s = min(max(time_s - self._time_s, 0.0), FARTHEST_S)
        if self._frozen:
            state[POSITION : POSITION + 3] += ahead_s * state[VELOCITY : VELOCITY + 3]
        else:
            propagate(state, self._plant, self._sent, self._time_s, self._time_s + ahead_s)
        return state

    def _go_to(self, time_s: float, *, complete: bool) -> None:
        """Propagate state and covariance to `time_s`, unless they are newer. `complete`: whether
        position and attitude have both arrived, so that commands can be replayed."""
        if time_s <= self._time_s:
            return
        if complete:
            interval_s = time_s - self._time_s
            propagate(self._state, self._plant, self._sent, self._time_s, time_s)
            predict_covariance(
                self._covariance, self._dynamics, self._densities, interval_s, self._longest_s
            )
        self._time_s = time_s

    def _set_vehicle(self, vehicle: Vehicle) -> None:
        self._vehicle, self._plant = vehicle, plant_of(vehicle)
        self._dynamics = dynamics_of(vehicle)
        frequency = max(vehicle.tilt.natural_frequency_radps, vehicle.yaw.natural_frequency_radps)
        damping = max(vehicle.tilt.damping, vehicle.yaw.damping, 0.5)
        self._longest_s = min(0.02, 0.25 / (2.0 * damping * frequency))

    def _restart(self) -> None:
        """Restart the filter: the next attitude and position set the state."""
        self._time_s = -math.inf
        self._position_at = self._attitude_at = None
        self._state[THRUST] = self._vehicle.gravity_mps2
        self._forget_errors()

    def _forget_errors(self) -> None:
        """Set covariance, disturbance and bias to their values at the first message."""
        self._covariance: Array = np.diag(START_SDS**2)
        self._state[DISTURBANCE : BIAS + 3] = 0.0
        self.estimated.interrupt()

    def _accepts(self, time_s: float, last_s: float | None) -> bool:
        """Whether to use a message of `time_s`; `last_s` is the time of the last message of its
        kind. Restarts the filter after a long gap, and keeps the disturbance."""
        now_s = self._time_s
        if abs(time_s - now_s) > LONGEST_GAP_S:
            if time_s < now_s:
                self._sent = np.empty((0, COMMAND_SIZE))
            disturbance = self._state[DISTURBANCE : DISTURBANCE + 3].copy()
            self._restart()
            self._state[DISTURBANCE : DISTURBANCE + 3] = disturbance
            return True
        return time_s >= now_s - LATEST_S and (last_s is None or time_s > last_s)
