"""Where the vehicle is, what pushes it, and where it will be when a command sent now takes effect.

The autopilot's reported velocity need not be the derivative of the position it reports (PX4: wrong
by 0.2-0.3 m/s for seconds, with the position not following), so velocity comes from position and
from the commands *sent*, replayed through the attitude response; the reported velocity is used
with a bias of its own or not at all. A disturbance acceleration absorbs wrong thrust, mass, wind.
Vehicle time everywhere; no clock, no MAVLink, no reference.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from offboard.control.base import Command, PredictedHeave, PredictedState
from offboard.control.filtering import correct, correct_position, correct_velocity, spread
from offboard.control.observer_adaptation import DOWN, NORTH_EAST, Adaptation
from offboard.control.observer_model import (
    HEADING,
    HEADING_START_SD,
    LATERAL,
    LATERAL_DRIFT,
    LATERAL_START_SD,
    MEASURES_COURSE,
    MEASURES_TILT,
    VERTICAL,
    VERTICAL_DRIFT,
    VERTICAL_START_SD,
    ObserverSettings,
    VelocitySource,
    filter_models,
    plant_vector,
)
from offboard.control.propagation import (
    BIAS,
    COMMAND_SIZE,
    COURSE,
    COURSE_RATE,
    DISTURBANCE,
    POSITION,
    SENT_AT,
    SENT_THRUST,
    STATE_SIZE,
    THRUST,
    TILT,
    TILT_RATE,
    VELOCITY,
    advance,
    missed,
    upright,
)
from offboard.model.frames import (
    course_from_quaternion,
    thrust_direction_from_quaternion,
    wrap_pi,
)
from offboard.model.vehicle import Vehicle

__all__ = ["Observer", "ObserverSettings", "VelocitySource"]

Array = NDArray[np.float64]
Triple = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]

COMMANDS_KEPT = 128
# Telemetry that arrives later than this after newer telemetry says nothing worth having.
LATEST_S = 0.1
# A longer silence, or step back in time, is a new start (a silence keeps the disturbance).
LONGEST_GAP_S = 1.0


class Observer:
    """One vehicle's observer. Feed it every message and every command; ask it before deciding."""

    def __init__(self, vehicle: Vehicle, settings: ObserverSettings) -> None:
        self._settings = settings
        self._adaptation = Adaptation(
            settings.position_sd_m,
            settings.velocity_sd_mps,
            settings.disturbance_density_mps2,
            settings.disturbance_density_limit_mps2,
        )
        self._position_at: float | None = None
        self._attitude_at: float | None = None
        self._adopt(vehicle)
        self.reset()

    def reset(self) -> None:
        """Forget everything of the previous flight."""
        self.position_jumps = 0
        self.velocity_jumps = 0
        self.stale_messages = 0
        self._frozen = False
        self._history = np.zeros((COMMANDS_KEPT, COMMAND_SIZE))
        self._sent = 0
        self._state = np.zeros(STATE_SIZE)
        self._rates: Array = np.zeros(3)
        self._adaptation.reset()
        self._restart()

    def adopt(self, vehicle: Vehicle) -> None:
        """Go on with a newly identified vehicle. The thrust that crosses the wire is a ratio to
        the hover thrust, so what was commanded is read on the new scale and the disturbance gives
        up what the new hover thrust and the new drag explain."""
        ratio = self._vehicle.hover_thrust / vehicle.hover_thrust
        self._history[:, SENT_THRUST] *= ratio
        self._state[THRUST] *= ratio
        down = (self._gravity + self._state[DISTURBANCE + 2]) * ratio - vehicle.gravity_mps2
        slowed = vehicle.drag_per_mass_ps - self._vehicle.drag_per_mass_ps
        self._adopt(vehicle)
        self._adaptation.trust_thrust()
        self._state[DISTURBANCE + 2] = down
        self._state[DISTURBANCE : DISTURBANCE + 3] += slowed * self._state[VELOCITY : VELOCITY + 3]
        self._bound_disturbance()

    @property
    def ready(self) -> bool:
        """Whether position and attitude have both been heard since the start or a long silence."""
        return self._position_at is not None and self._attitude_at is not None

    @property
    def hover_thrust_estimate(self) -> float:
        """Normalised thrust that hovers: u_h (1 + d_z / g); within 2-3 % five seconds after
        take-off."""
        down = float(self._state[DISTURBANCE + 2])
        return self._vehicle.hover_thrust * (1.0 + down / self._gravity)

    @property
    def velocity_bias_ned_mps(self) -> Array:
        """Reported minus believed velocity (3,), zero unless the source is `bias`."""
        return self._state[BIAS : BIAS + 3].copy()

    def freeze(self, grounded: bool) -> None:
        """While the vehicle does not fly our commands nothing integrates: velocity as reported,
        no disturbance, thrust direction as measured. Released, the filters start from there."""
        if grounded != self._frozen:
            self._start_filters()
        self._frozen = grounded

    def on_command(self, time_s: float, command: Command) -> None:
        """A command sent when the newest telemetry had vehicle time `time_s`."""
        north, east, _ = command.thrust_direction_ned
        if self._sent == COMMANDS_KEPT:
            self._history[:-1] = self._history[1:]
            self._sent -= 1
        if self._sent and time_s < self._history[self._sent - 1, SENT_AT]:
            time_s = self._history[self._sent - 1, SENT_AT]
        self._history[self._sent] = time_s, north, east, command.thrust_mps2, command.course_rad
        self._sent += 1

    def on_attitude(self, time_s: float, q: Quaternion, rates: Triple) -> None:
        """Attitude quaternion (FRD -> NED) and body rates (rad/s, FRD) of vehicle time `time_s`."""
        if not self._admit(time_s, self._attitude_at):
            return
        direction = thrust_direction_from_quaternion(q)
        course = float(course_from_quaternion(q))
        first = self._attitude_at is None or self._frozen
        self._advance(time_s)
        self._attitude_at = time_s
        self._rates = np.array(rates, dtype=np.float64)
        state = self._state
        if first:  # taken as it is
            state[TILT : TILT + 2] = direction[:2]
            state[TILT_RATE : TILT_RATE + 2] = 0.0
            state[COURSE], state[COURSE_RATE] = course, 0.0
            state[THRUST] = self._gravity / upright(direction[0], direction[1])
            return
        late_s = self._time_s - time_s
        innovation = (
            direction[:2] - state[TILT : TILT + 2] + late_s * state[TILT_RATE : TILT_RATE + 2]
        )
        turn = np.array([wrap_pi(course - state[COURSE] + late_s * state[COURSE_RATE])])
        sd = self._settings.attitude_sd_rad
        correct(state, LATERAL, self._lateral, MEASURES_TILT, innovation, sd)
        correct(state, HEADING, self._heading, MEASURES_COURSE, turn, sd)
        self._bound_disturbance()

    def on_position(self, time_s: float, position_ned_m: Triple, velocity_ned_mps: Triple) -> None:
        """Reported position and velocity of vehicle time `time_s`."""
        if not self._admit(time_s, self._position_at):
            return
        first = self._position_at is None or self._frozen
        self._advance(time_s)
        self._position_at = time_s
        state = self._state
        position = np.array(position_ned_m, dtype=np.float64)
        velocity = np.array(velocity_ned_mps, dtype=np.float64)
        if first or self._settings.velocity is VelocitySource.REPORTED:
            state[POSITION : POSITION + 3] = position
            state[VELOCITY : VELOCITY + 3] = velocity
            return
        late_s = self._time_s - time_s
        if late_s > 0.0:
            position += late_s * state[VELOCITY : VELOCITY + 3]
            velocity += late_s * self._acceleration()
        self._correct(position, velocity)
        self._bound_disturbance()

    def predict(self, time_s: float) -> PredictedState:
        """The state at `time_s` + tilt delay, when the tilt of a command sent at `time_s` begins
        to act, replaying the commands sent. Meaningful once `ready`."""
        until_s = time_s + self._vehicle.tilt.delay_s
        state = self._state_at(until_s)
        north, east = state[TILT], state[TILT + 1]
        down = upright(north, east)
        rate_n, rate_e = state[TILT_RATE], state[TILT_RATE + 1]
        return PredictedState(
            time_s=until_s,
            position_ned_m=state[POSITION : POSITION + 3],
            velocity_ned_mps=state[VELOCITY : VELOCITY + 3],
            thrust_direction_ned=np.array([north, east, down]),
            thrust_direction_rate_ned_ps=np.array(
                [rate_n, rate_e, -(north * rate_n + east * rate_e) / down]
            ),
            course_rad=wrap_pi(float(state[COURSE])),
            course_rate_radps=float(state[COURSE_RATE]),
            thrust_mps2=float(state[THRUST]),
            disturbance_ned_mps2=state[DISTURBANCE : DISTURBANCE + 3],
            rates_frd_radps=self._rates.copy(),
            heave=self._heave(time_s + self._vehicle.thrust_delay_s),
        )

    def _state_at(self, time_s: float) -> Array:
        """A copy of the state, replayed forward to `time_s`."""
        state = self._state.copy()
        ahead_s = min(max(time_s - self._time_s, 0.0), LONGEST_GAP_S)
        if self._frozen:
            state[POSITION : POSITION + 3] += ahead_s * state[VELOCITY : VELOCITY + 3]
        else:
            start_s = self._time_s
            advance(state, start_s, start_s + ahead_s, self._history, self._sent, self._plant)
        return state

    def _heave(self, time_s: float) -> PredictedHeave:
        state = self._state_at(time_s)
        return PredictedHeave(
            time_s=time_s,
            position_down_m=float(state[POSITION + 2]),
            velocity_down_mps=float(state[VELOCITY + 2]),
            thrust_down_mps2=float(state[THRUST] * upright(state[TILT], state[TILT + 1])),
        )

    @staticmethod
    def warm_up(vehicle: Vehicle, settings: ObserverSettings) -> None:
        """Call every code path once, so that none compiles in flight."""
        observer = Observer(vehicle, settings)
        level = Command(vehicle.gravity_mps2, (0.0, 0.0, 1.0), 0.0)
        for time_s in (0.0, 0.01, 0.02):
            observer.on_command(time_s, level)
            observer.on_attitude(time_s, (1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
            observer.on_position(time_s, (time_s * 100.0, 0.0, 0.0), (time_s * 100.0, 0.0, 0.0))
        observer.predict(0.02)

    def _adopt(self, vehicle: Vehicle) -> None:
        self._vehicle = vehicle
        self._gravity = vehicle.gravity_mps2
        self._plant = plant_vector(vehicle, self._settings)
        self._filters = filter_models(vehicle, self._settings)
        frequency = max(vehicle.tilt.natural_frequency_radps, vehicle.yaw.natural_frequency_radps)
        damping = max(vehicle.tilt.damping, vehicle.yaw.damping, 0.5)
        self._longest_spread_s = min(0.02, 0.25 / (2.0 * damping * frequency))

    def _restart(self) -> None:
        """The next message of each stream is taken as it is."""
        self._time_s = -math.inf
        self._position_at = None
        self._attitude_at = None
        self._state[THRUST] = self._gravity
        self._start_filters()

    def _start_filters(self) -> None:
        self._lateral = np.diag(LATERAL_START_SD**2)
        self._vertical = np.diag(VERTICAL_START_SD**2)
        self._heading = np.diag(HEADING_START_SD**2)
        if self._settings.velocity is VelocitySource.REPORTED:
            self._lateral[4, 4] = 0.0
        self._state[DISTURBANCE : DISTURBANCE + 3] = 0.0
        self._state[BIAS : BIAS + 3] = 0.0
        self._adaptation.interrupt()

    def _admit(self, time_s: float, last_s: float | None) -> bool:
        """Whether a message of a stream last heard at `last_s` says something new."""
        if abs(time_s - self._time_s) > LONGEST_GAP_S:
            if time_s < self._time_s:
                self._sent = 0
            disturbance = self._state[DISTURBANCE : DISTURBANCE + 3].copy()
            self._restart()
            self._state[DISTURBANCE : DISTURBANCE + 3] = disturbance
            return True
        if time_s < self._time_s - LATEST_S or (last_s is not None and time_s <= last_s):
            self.stale_messages += 1
            return False
        return True

    def _advance(self, time_s: float) -> None:
        """Replay to `time_s`, or stay if newer telemetry came first."""
        if time_s <= self._time_s:
            return
        if self.ready and not self._frozen:
            start_s, interval_s = self._time_s, time_s - self._time_s
            advance(self._state, start_s, time_s, self._history, self._sent, self._plant)
            covariances = self._lateral, self._vertical, self._heading
            for covariance, (dynamics, densities) in zip(covariances, self._filters, strict=True):
                spread(covariance, dynamics, densities, interval_s, self._longest_spread_s)
        self._time_s = time_s

    def _correct(self, position: Array, velocity: Array) -> None:
        settings, adaptation = self._settings, self._adaptation
        if not settings.adaptive:
            self._correct_by(position, velocity, settings.position_sd_m, settings.velocity_sd_mps)
            return
        innovation = missed(self._state, position, velocity)
        sds = adaptation.position_sd_m, adaptation.velocity_sd_mps
        if self._correct_by(position, velocity, *sds):
            adaptation.interrupt()
            return
        residual = missed(self._state, position, velocity)
        adaptation.note(self._time_s, innovation, residual)
        self._filters[0][1][LATERAL_DRIFT] = adaptation.densities_mps2[NORTH_EAST]
        self._filters[1][1][VERTICAL_DRIFT] = adaptation.densities_mps2[DOWN]

    def _correct_by(
        self, position: Array, velocity: Array, position_sd_m: float, velocity_sd_mps: float
    ) -> bool:
        """Whether either of them jumped."""
        settings, state = self._settings, self._state
        sd, gate = position_sd_m, settings.position_jump_m
        moved = max(
            correct_position(state, LATERAL, self._lateral, position[:2], sd, gate),
            correct_position(state, VERTICAL, self._vertical, position[2:], sd, gate),
        )
        self.position_jumps += moved
        if settings.velocity is VelocitySource.POSITION:
            return moved > 0
        sd, gate = velocity_sd_mps, settings.velocity_jump_mps
        leapt = max(
            correct_velocity(state, LATERAL, self._lateral, velocity[:2], sd, gate),
            correct_velocity(state, VERTICAL, self._vertical, velocity[2:], sd, gate),
        )
        self.velocity_jumps += leapt
        return moved + leapt > 0

    def _acceleration(self) -> Array:
        north, east = self._state[TILT : TILT + 2]
        velocity = self._state[VELOCITY : VELOCITY + 3]
        acceleration: Array = np.array([north, east, upright(north, east)]) * -self._state[THRUST]
        acceleration += self._state[DISTURBANCE : DISTURBANCE + 3]
        acceleration -= self._vehicle.drag_per_mass_ps * velocity
        acceleration[2] += self._gravity
        return acceleration

    def _bound_disturbance(self) -> None:
        limit = self._settings.disturbance_limit_mps2
        for i in range(DISTURBANCE, DISTURBANCE + 3):
            self._state[i] = min(max(self._state[i], -limit), limit)
