"""Where the vehicle is, what pushes it, and where it will be when a command sent now takes effect.

The autopilot's reported velocity need not be the derivative of the position it reports (PX4: wrong
by 0.2-0.3 m/s for seconds, with the position not following), so velocity comes from position and
from the commands *sent*, replayed through the attitude response; the reported velocity is used
with a bias of its own or not at all. A disturbance acceleration absorbs wrong thrust, mass, wind.
Which message counts and when to begin anew is settled here. Vehicle time everywhere; no clock, no
MAVLink, no reference.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from offboard.estimation.filtering import spread
from offboard.estimation.observer_adaptation import Adaptation
from offboard.estimation.observer_filter import (
    POSITION_JUMPED,
    VELOCITY_JUMPED,
    bound_disturbance,
    bring_forward,
    correct_by_attitude,
    correct_by_position,
    learn,
)
from offboard.estimation.observer_model import (
    ObserverSettings,
    VelocitySource,
    believe,
    new_record,
    start_filters,
)
from offboard.estimation.propagation import (
    BIAS,
    COMMANDS_KEPT,
    COURSE,
    COURSE_RATE,
    DISTURBANCE,
    LATER,
    NOW,
    POSITION,
    SENT_AT,
    SENT_THRUST,
    THRUST,
    TILT,
    TILT_RATE,
    VELOCITY,
    replay,
)
from offboard.model.axes import upright
from offboard.model.command import Command
from offboard.model.frames import (
    course_from_quaternion,
    thrust_direction_from_quaternion,
    wrap_pi,
)
from offboard.model.predicted_state import PredictedHeave, PredictedState
from offboard.model.vehicle import Vehicle

__all__ = ["Observer", "ObserverSettings", "VelocitySource"]

Array = NDArray[np.float64]
Triple = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]

# Telemetry that arrives later than this after newer telemetry says nothing worth having.
LATEST_S = 0.1
# A longer silence, or step back in time, is a new start (a silence keeps the disturbance).
LONGEST_GAP_S = 1.0


class Observer:
    """One vehicle's observer. Feed it every message and every command; ask it before deciding."""

    def __init__(self, vehicle: Vehicle, settings: ObserverSettings) -> None:
        self._settings = settings
        self._record = new_record(settings)
        self._time = self._record["time_s"]
        self._motion = self._record["motion"]
        self._filters = self._record["filters"][0]
        self._measured: Array = self._record["measured"][0]
        self._plant: Array = self._motion["plant"][0]
        self._states: Array = self._motion["states"][0]
        self._state: Array = self._states[NOW]
        self._history: Array = self._motion["history"][0]
        self._position_at: float | None
        self._attitude_at: float | None
        self._sent: int
        self._adaptation = Adaptation(
            self._record["adaptation"],
            settings.position_sd_m,
            settings.velocity_sd_mps,
            settings.disturbance_density_mps2,
            settings.disturbance_density_limit_mps2,
        )
        self._adopt(vehicle)
        self.reset()

    def reset(self) -> None:
        """Forget everything of the previous flight."""
        self.position_jumps = 0
        self.velocity_jumps = 0
        self.stale_messages = 0
        self._frozen = False
        self._forget_commands()
        self._state[:] = 0.0
        self._rates = np.zeros(3)
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
        bound_disturbance(self._state, self._settings.disturbance_limit_mps2)

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
        history, sent = self._history, self._sent
        if sent == COMMANDS_KEPT:
            history[:-1] = history[1:]
            sent -= 1
        if sent and time_s < history[sent - 1, SENT_AT]:
            time_s = history[sent - 1, SENT_AT]
        history[sent] = time_s, north, east, command.thrust_mps2, command.course_rad
        self._sent = sent + 1
        self._motion["sent"] = self._sent

    def on_attitude(self, time_s: float, q: Quaternion, rates: Triple) -> None:
        """Attitude quaternion (FRD -> NED) and body rates (rad/s, FRD) of vehicle time `time_s`."""
        if not self._admit(time_s, self._attitude_at):
            return
        north, east, _ = thrust_direction_from_quaternion(q).tolist()
        course = float(course_from_quaternion(q))
        self._rates = np.array(rates, dtype=np.float64)
        if self._attitude_at is None or self._frozen:  # taken as it is
            state = self._state
            state[TILT : TILT + 2] = north, east
            state[TILT_RATE : TILT_RATE + 2] = 0.0
            state[COURSE], state[COURSE_RATE] = course, 0.0
            state[THRUST] = self._gravity / upright(north, east)
            self._time_s = max(self._time_s, time_s)
        else:
            self._go_to(time_s, complete=self._position_at is not None)
            correct_by_attitude(self._record, time_s, north, east, course)
        self._attitude_at = time_s

    def on_position(self, time_s: float, position_ned_m: Triple, velocity_ned_mps: Triple) -> None:
        """Reported position and velocity of vehicle time `time_s`."""
        if not self._admit(time_s, self._position_at):
            return
        if self._position_at is None or self._frozen:  # taken as it is
            self._state[POSITION : POSITION + 3] = position_ned_m
            self._state[VELOCITY : VELOCITY + 3] = velocity_ned_mps
            self._time_s = max(self._time_s, time_s)
        else:
            self._go_to(time_s, complete=self._attitude_at is not None)
            self._measured[:] = *position_ned_m, *velocity_ned_mps
            self._correct_by_position(time_s)
        self._position_at = time_s

    def predict(self, time_s: float) -> PredictedState:
        """The state at `time_s` + tilt delay, when the tilt of a command sent at `time_s` begins
        to act, replaying the commands sent. Meaningful once `ready`."""
        until_s = time_s + self._vehicle.tilt.delay_s
        state = self._foreseen(until_s)
        north, east, rate_n, rate_e = state[TILT : TILT_RATE + 2].tolist()
        down = upright(north, east)
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

    def _foreseen(self, time_s: float) -> Array:
        """A copy of the state, replayed forward to `time_s`."""
        start_s = self._time_s
        ahead_s = min(max(time_s - start_s, 0.0), LONGEST_GAP_S)
        if self._frozen:
            state = self._state.copy()
            state[POSITION : POSITION + 3] += ahead_s * state[VELOCITY : VELOCITY + 3]
            return state
        replay(self._motion, LATER, start_s, start_s + ahead_s)
        later: Array = self._states[LATER].copy()
        return later

    def _go_to(self, time_s: float, *, complete: bool) -> None:
        """Advance the state to `time_s`, or leave it if it is newer. `complete`: both streams have
        been heard, so that the commands can be replayed."""
        start_s = self._time_s
        if time_s <= start_s:
            return
        if complete:
            replay(self._motion, NOW, start_s, time_s)
            spread(self._filters, time_s - start_s)
        self._time_s = time_s

    def _correct_by_position(self, time_s: float) -> None:
        """By what is measured, of `time_s`."""
        if self._settings.velocity is VelocitySource.REPORTED:
            self._state[: VELOCITY + 3] = self._measured
            return
        if time_s < self._time_s:
            bring_forward(self._measured, self._state, self._plant, self._time_s - time_s)
        jumped = correct_by_position(self._record)
        self.position_jumps += bool(jumped & POSITION_JUMPED)
        self.velocity_jumps += bool(jumped & VELOCITY_JUMPED)
        if jumped:
            self._adaptation.interrupt()
        elif self._settings.adaptive:
            learn(self._record)

    def _heave(self, time_s: float) -> PredictedHeave:
        state = self._foreseen(time_s).tolist()
        return PredictedHeave(
            time_s=time_s,
            position_down_m=state[POSITION + 2],
            velocity_down_mps=state[VELOCITY + 2],
            thrust_down_mps2=state[THRUST] * upright(state[TILT], state[TILT + 1]),
        )

    def _adopt(self, vehicle: Vehicle) -> None:
        self._vehicle = vehicle
        self._gravity = vehicle.gravity_mps2
        believe(self._record, vehicle, self._settings)

    def _forget_commands(self) -> None:
        self._sent = 0
        self._motion["sent"] = 0

    def _restart(self) -> None:
        """The next message of each stream is taken as it is."""
        self._time_s = -math.inf
        self._position_at = None
        self._attitude_at = None
        self._state[THRUST] = self._gravity
        self._start_filters()

    def _start_filters(self) -> None:
        start_filters(self._record, self._settings)
        self._adaptation.interrupt()

    def _admit(self, time_s: float, last_s: float | None) -> bool:
        """Whether a message of a stream last heard at `last_s` says something new."""
        now_s = self._time_s
        if abs(time_s - now_s) > LONGEST_GAP_S:
            if time_s < now_s:
                self._forget_commands()
            disturbance = self._state[DISTURBANCE : DISTURBANCE + 3].copy()
            self._restart()
            self._state[DISTURBANCE : DISTURBANCE + 3] = disturbance
            return True
        if time_s < now_s - LATEST_S or (last_s is not None and time_s <= last_s):
            self.stale_messages += 1
            return False
        return True

    @property
    def _time_s(self) -> float:
        """Vehicle time of the state."""
        time_s: float = self._time.item()
        return time_s

    @_time_s.setter
    def _time_s(self, time_s: float) -> None:
        self._time[0] = time_s
