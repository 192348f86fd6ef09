"""Position, velocity and disturbance of the vehicle, now and when a command sent now takes effect.

The velocity that an autopilot reports need not be the derivative of the position that it reports
(PX4: wrong by 0.2 to 0.3 m/s for seconds), so velocity is estimated from the position and from the
commands *sent*, replayed through the attitude response; the reported velocity is used with a bias
or not at all. A disturbance acceleration stands for wind and for errors of thrust and mass. All
times are vehicle time.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from offboard.estimation.filtering import spread
from offboard.estimation.observer_adaptation import Adaptation
from offboard.estimation.observer_filter import (
    bound_disturbance,
    bring_forward,
    correct_by_attitude,
    correct_by_position,
    learn,
)
from offboard.estimation.observer_model import (
    ObserverSettings,
    VelocitySource,
    new_record,
    predicted_heave,
    predicted_state,
    set_vehicle,
    start_filters,
)
from offboard.estimation.propagation import (
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
from offboard.model.frames import course_from_quaternion, thrust_direction_from_quaternion
from offboard.model.predicted_state import PredictedState
from offboard.model.vehicle import Vehicle

__all__ = ["Observer", "ObserverSettings", "VelocitySource"]

Array = NDArray[np.float64]
Triple = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]

LATEST_S = 0.1  # telemetry that is older than this when newer has arrived is dropped
LONGEST_GAP_S = 1.0  # a longer gap or a step back in time restarts; a gap keeps the disturbance


class Observer:
    """State estimate of one vehicle.

    Give it every attitude and position that arrives (`on_attitude`, `on_position`) and every
    command that is sent (`on_command`); `predict` gives the state that a decision needs.

    Args:
        vehicle: constants of the vehicle.
        settings: noise of telemetry and disturbance.
    """

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
        """Forget the previous flight."""
        self._frozen = False
        self._forget_commands()
        self._state[:] = 0.0
        self._rates = np.zeros(3)
        self._adaptation.reset()
        self._restart()

    def adopt(self, vehicle: Vehicle) -> None:
        """Continue with newly identified constants. Thrust is sent as a ratio to the hover thrust,
        so commands sent are rescaled, and the disturbance loses what the new hover thrust and drag
        explain."""
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
        """Whether position and attitude have both arrived since the start or a long gap."""
        return self._position_at is not None and self._attitude_at is not None

    @property
    def hover_thrust_estimate(self) -> float:
        """Normalised hover thrust, u_h (1 + d_z / g); right within 3 % five seconds after
        take-off."""
        down = float(self._state[DISTURBANCE + 2])
        return self._vehicle.hover_thrust * (1.0 + down / self._gravity)

    def freeze(self, grounded: bool) -> None:
        """Stop estimating while the vehicle is on the ground or does not fly our commands: velocity
        as reported, thrust direction as measured, no disturbance. After that the filters start
        from there."""
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
        """Attitude quaternion (FRD to NED, w first) and body rates (rad/s, FRD) at `time_s`."""
        if not self._is_new(time_s, self._attitude_at):
            return
        north, east, _ = thrust_direction_from_quaternion(q).tolist()
        course = float(course_from_quaternion(q))
        self._rates = np.array(rates, dtype=np.float64)
        if self._attitude_at is None or self._frozen:
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
        """Reported position and velocity at `time_s`."""
        if not self._is_new(time_s, self._position_at):
            return
        if self._position_at is None or self._frozen:
            self._state[POSITION : POSITION + 3] = position_ned_m
            self._state[VELOCITY : VELOCITY + 3] = velocity_ned_mps
            self._time_s = max(self._time_s, time_s)
        else:
            self._go_to(time_s, complete=self._attitude_at is not None)
            self._measured[:] = *position_ned_m, *velocity_ned_mps
            self._correct_by_position(time_s)
        self._position_at = time_s

    def predict(self, time_s: float) -> PredictedState:
        """The state when the tilt of a command sent at `time_s` begins to act, after the tilt's
        delay, with the commands sent replayed; `heave` is the vertical after the thrust's delay.
        Valid once `ready`."""
        tilt_s = time_s + self._vehicle.tilt.delay_s
        thrust_s = time_s + self._vehicle.thrust_delay_s
        heave = predicted_heave(thrust_s, self._propagated(thrust_s))
        return predicted_state(tilt_s, self._propagated(tilt_s), self._rates.copy(), heave)

    def _propagated(self, time_s: float) -> Array:
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
        """Propagate the state to `time_s`, or leave it if it is newer. `complete`: position and
        attitude have arrived, so that the commands can be replayed."""
        start_s = self._time_s
        if time_s <= start_s:
            return
        if complete:
            replay(self._motion, NOW, start_s, time_s)
            spread(self._filters, time_s - start_s)
        self._time_s = time_s

    def _correct_by_position(self, time_s: float) -> None:
        """Correct by the position and velocity in `_measured`, which are of `time_s`."""
        if self._settings.velocity is VelocitySource.REPORTED:
            self._state[: VELOCITY + 3] = self._measured
            return
        if time_s < self._time_s:
            bring_forward(self._measured, self._state, self._plant, self._time_s - time_s)
        if correct_by_position(self._record):
            self._adaptation.interrupt()
        elif self._settings.adaptive:
            learn(self._record)

    def _adopt(self, vehicle: Vehicle) -> None:
        self._vehicle = vehicle
        self._gravity = vehicle.gravity_mps2
        set_vehicle(self._record, vehicle, self._settings)

    def _forget_commands(self) -> None:
        self._sent = 0
        self._motion["sent"] = 0

    def _restart(self) -> None:
        """Take the next attitude and position as they are."""
        self._time_s = -math.inf
        self._position_at = None
        self._attitude_at = None
        self._state[THRUST] = self._gravity
        self._start_filters()

    def _start_filters(self) -> None:
        start_filters(self._record, self._settings)
        self._adaptation.interrupt()

    def _is_new(self, time_s: float, last_s: float | None) -> bool:
        """Whether to use a message of `time_s`, the last of its kind having been of `last_s`;
        restarts after a long gap."""
        now_s = self._time_s
        if abs(time_s - now_s) > LONGEST_GAP_S:
            if time_s < now_s:
                self._forget_commands()
            disturbance = self._state[DISTURBANCE : DISTURBANCE + 3].copy()
            self._restart()
            self._state[DISTURBANCE : DISTURBANCE + 3] = disturbance
            return True
        return time_s >= now_s - LATEST_S and (last_s is None or time_s > last_s)

    @property
    def _time_s(self) -> float:
        """Vehicle time of the state."""
        time_s: float = self._time.item()
        return time_s

    @_time_s.setter
    def _time_s(self, time_s: float) -> None:
        self._time[0] = time_s
