"""The observer: the state of the vehicle, now and when a command sent now takes effect.

    predict   x(t + h) = f(x(t), commands sent)      `propagation`, with the delay of each axis
              P <- F P F' + Q                        `kalman.predict`, F linearised about hover
    update    x <- x + K (z - H x)                   by each attitude and position that arrives
    reset     on the ground, after a long gap, and after a jump of the vehicle's own estimate

The state x (indices in `propagation`, NED, SI) is position, velocity, thrust direction b and its
rate, disturbance acceleration d, bias of the reported velocity, thrust, heading and its rate. d
stands for wind and for errors of thrust and mass, so that it contains the hover thrust. Three
filters share x, since their axes decouple: north and east (one covariance), down, heading.

The velocity that an autopilot reports need not be the derivative of the position that it reports
(PX4: wrong by 0.2 to 0.3 m/s for seconds), so velocity comes from the position and from the
commands *sent*; the reported velocity is used with a bias that changes slowly. All times are
vehicle time.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from offboard.compiled import entry, kernel
from offboard.estimation import kalman
from offboard.estimation.kalman import (
    ADAPTATION,
    AT_ATTITUDE,
    AT_POSITION,
    AT_VELOCITY,
    FILTER,
    LATERAL,
    VERTICAL,
    adapt,
    innovation_variance,
    interrupt,
    measurement_variance,
    reset_bias,
    reset_position,
    update,
)
from offboard.estimation.propagation import (
    BIAS,
    BIAS_TIME_CONSTANT_S,
    COMMANDS_KEPT,
    DISTURBANCE,
    HEADING,
    HEADING_RATE,
    LATER,
    MOTION,
    NOW,
    POSITION,
    SENT_AT,
    SENT_THRUST,
    THRUST,
    TILT,
    TILT_RATE,
    VELOCITY,
    plant_of,
    replay,
    wrapped,
)
from offboard.model.axes import acceleration, b_z_of, lateral_model
from offboard.model.command import Command, PredictedHeave, PredictedState
from offboard.model.frames import (
    heading_from_quaternion,
    thrust_direction_from_quaternion,
    wrap_pi,
)
from offboard.model.vehicle import Vehicle

Array = NDArray[np.float64]
Triple = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]

LATEST_S = 0.1  # telemetry that is older than this when newer has arrived is dropped
LONGEST_GAP_S = 1.0  # a longer gap or a step back in time restarts; a gap keeps the disturbance
# A measurement is a jump of the vehicle's estimate if it is further off than so many standard
# deviations of its innovation and a distance: position (m), velocity (m/s)
GATE_SDS, GATES = 3.0, (0.3, 0.5)
DISTURBANCE_LIMIT_MPS2 = 8.0


@dataclass(frozen=True, slots=True)
class Noise:
    """Q by densities per root second, R by standard deviations. These were flown on PX4 and
    ArduCopter; half or twice the values made no visible difference. Noise of position and velocity
    and drift of the disturbance are estimated in flight too, and never less than these; the drift
    at most `disturbance_limit_mps2`."""

    acceleration_mps: float = 0.2
    disturbance_mps2: float = 0.15
    disturbance_limit_mps2: float = 1.0
    tilt_radps: float = 0.6
    heading_radps: float = 0.6
    bias_mps: float = 0.08
    position_sd_m: float = 0.002
    velocity_sd_mps: float = 0.005
    attitude_sd_rad: float = 0.001


# ---------------------------------------------------------------------- filters

YAW = 2  # after LATERAL and VERTICAL
# Their states: indices in x for each axis
PLACES: tuple[list[tuple[int, ...]], ...] = (
    [
        (POSITION + i, VELOCITY + i, TILT + i, TILT_RATE + i, DISTURBANCE + i, BIAS + i)
        for i in (0, 1)
    ],
    [(POSITION + 2, VELOCITY + 2, DISTURBANCE + 2, BIAS + 2)],
    [(HEADING, HEADING_RATE)],
)
LATERAL_DISTURBANCE, VERTICAL_DISTURBANCE = 4, 2
# H: the states of which each measurement is the sum, by row
MEASURED: tuple[dict[int, tuple[int, ...]], ...] = (
    {AT_POSITION: (0,), AT_VELOCITY: (1, 5), AT_ATTITUDE: (2,)},
    {AT_POSITION: (0,), AT_VELOCITY: (1, 3)},
    {AT_ATTITUDE: (0,)},
)
# Standard deviations at the first telemetry, which sets position, velocity and attitude;
# disturbance and bias start at zero
START_SDS = ((0.1, 0.3, 0.02, 0.3, 1.0, 0.3), (0.1, 0.3, 1.5, 0.3), (0.05, 0.3))

OBSERVER = np.dtype(
    [
        ("time_s", "f8"),  # vehicle time of the state
        ("motion", MOTION),
        ("filters", FILTER, 3),
        ("adaptation", ADAPTATION),
        ("attitude_variance", "f8"),
        ("measured", "f8", 6),  # position and velocity, with the indices of the state
        ("residual", "f8", 6),  # scratch
    ],
    align=True,
)
"""Record of one observer."""


def models(vehicle: Vehicle, noise: Noise) -> tuple[tuple[Array, Array], ...]:
    """Dynamics (n, n) of x' = A x, so that F = exp(A h), and noise densities (n,), Q per second, of
    the lateral, vertical and heading filters: linearised about hover, where the acceleration per
    error of the thrust direction is g."""
    motion, drift, bias = noise.acceleration_mps, noise.disturbance_mps2, noise.bias_mps
    forgetting = -1.0 / BIAS_TIME_CONSTANT_S
    lateral = np.zeros((6, 6))
    lateral[:4, :4] = lateral_model(vehicle).dynamics
    lateral[1, 4], lateral[5, 5] = 1.0, forgetting
    vertical = np.zeros((4, 4))
    vertical[0, 1] = vertical[1, 2] = 1.0
    vertical[1, 1], vertical[3, 3] = -vehicle.drag_per_mass_ps, forgetting
    heading = np.zeros((2, 2))
    frequency = vehicle.yaw.natural_frequency_radps
    heading[0, 1] = 1.0
    heading[1] = -(frequency**2), -2.0 * vehicle.yaw.damping * frequency
    return (
        (lateral, np.array([0.0, motion, 0.0, noise.tilt_radps, drift, bias])),
        (vertical, np.array([0.0, motion, drift, bias])),
        (heading, np.array([0.0, noise.heading_radps])),
    )


@entry(OBSERVER, float, float, float, float)
def update_by_attitude(
    observers: Any, time_s: float, north: float, east: float, heading: float
) -> None:
    """Update by an attitude measured at `time_s`, not later than the state: thrust direction (north
    and east components) and heading (rad). `observers` is one OBSERVER (1,)."""
    observer = observers[0]
    state, late_s = observer.motion.states[NOW], observer.time_s - time_s
    lateral, yaw = observer.filters[LATERAL], observer.filters[YAW]
    lateral.innovation[0] = north - state[TILT] + late_s * state[TILT_RATE]
    lateral.innovation[1] = east - state[TILT + 1] + late_s * state[TILT_RATE + 1]
    yaw.innovation[0] = wrapped(heading - state[HEADING] + late_s * state[HEADING_RATE])
    update(state, lateral, AT_ATTITUDE, observer.attitude_variance)
    update(state, yaw, AT_ATTITUDE, observer.attitude_variance)
    bound_disturbance(state)


@entry(OBSERVER, float)
def update_by_position(observers: Any, time_s: float) -> None:
    """Update by the position and velocity in `measured`, which are of `time_s`, not later than the
    state. One that jumped resets position or bias and leaves the rest."""
    observer = observers[0]
    noted, measured = observer.adaptation, observer.measured
    state = observer.motion.states[NOW]
    _bring_forward(measured, state, observer.motion.plant, observer.time_s - time_s)
    _missed(state, measured, noted.innovation)
    jumped = False
    for kind in range(2):
        variance = measurement_variance(noted, kind)
        for i in range(2):
            one = observer.filters[i]
            furthest = 0.0
            for axis in range(one.axes):
                innovation = measured[one.places[axis, kind]]
                for j in range(one.order):
                    innovation -= one.measures[kind, j] * state[one.places[axis, j]]
                one.innovation[axis] = innovation
                furthest = max(furthest, abs(innovation))
            sd = math.sqrt(innovation_variance(one, kind, variance))
            if furthest <= GATES[kind] + GATE_SDS * sd:
                update(state, one, kind, variance)
                continue
            jumped = True
            if kind == AT_POSITION:
                reset_position(state, one, measured, variance)
            else:
                reset_bias(state, one, variance)
    bound_disturbance(state)
    if jumped:
        interrupt(noted)
        return
    _missed(state, measured, observer.residual)
    adapt(noted, observer.time_s, observer.residual[:])
    observer.filters[LATERAL].densities[LATERAL_DISTURBANCE] = noted.density[LATERAL]
    observer.filters[VERTICAL].densities[VERTICAL_DISTURBANCE] = noted.density[VERTICAL]


@kernel
def _missed(state: Array, measured: Array, missed: Array) -> None:
    """Fill `missed` (6,) with measured less estimated position and reported velocity."""
    for i in range(3):
        missed[i] = measured[POSITION + i] - state[POSITION + i]
        missed[3 + i] = measured[VELOCITY + i] - state[VELOCITY + i] - state[BIAS + i]


@kernel
def _bring_forward(measured: Array, state: Array, plant: Any, late_s: float) -> None:
    """Propagate position and velocity `measured` (6,) by `late_s`, to the time of the state."""
    if late_s <= 0.0:
        return
    direction = (state[TILT], state[TILT + 1], b_z_of(state[TILT], state[TILT + 1]))
    gravity = (0.0, 0.0, plant.gravity)
    for i in range(3):
        speed = state[VELOCITY + i]
        measured[POSITION + i] += late_s * speed
        measured[VELOCITY + i] += late_s * acceleration(
            gravity[i], state[THRUST] * direction[i], plant.drag_ps, speed, state[DISTURBANCE + i]
        )


@kernel
def bound_disturbance(state: Array) -> None:
    """Limit each axis of the disturbance, in place."""
    for i in range(DISTURBANCE, DISTURBANCE + 3):
        state[i] = min(max(state[i], -DISTURBANCE_LIMIT_MPS2), DISTURBANCE_LIMIT_MPS2)


# ---------------------------------------------------------------------- observer


class Observer:
    """State estimate of one vehicle.

    Give it every attitude and position that arrives (`on_attitude`, `on_position`) and every
    command that is sent (`on_command`); `predict` gives the state that a decision needs.

    Args:
        vehicle: constants of the vehicle.
        noise: of telemetry and disturbance.
    """

    def __init__(self, vehicle: Vehicle, noise: Noise | None = None) -> None:
        self._noise = noise = noise or Noise()
        self._record = record = np.zeros(1, OBSERVER)
        record["attitude_variance"] = noise.attitude_sd_rad**2
        self._motion = record["motion"]
        self._filters = record["filters"][0]
        self._adaptation = record["adaptation"]
        self._time = record["time_s"]
        self._measured: Array = record["measured"][0]
        self._states: Array = self._motion["states"][0]
        self._state: Array = self._states[NOW]
        self._history: Array = self._motion["history"][0]
        self._position_at: float | None
        self._attitude_at: float | None
        self._sent: int
        for one, places, measured in zip(self._filters, PLACES, MEASURED, strict=True):
            one["order"], one["axes"] = len(places[0]), len(places)
            one["places"][: len(places), : len(places[0])] = places
            for row, summed in measured.items():
                one["measures"][row, list(summed)] = 1.0
        self._set_vehicle(vehicle)
        self.reset()

    def reset(self) -> None:
        """Forget the previous flight."""
        noise, noted = self._noise, self._adaptation
        self._frozen = False
        self._forget_commands()
        self._state[:] = 0.0
        self._rates = np.zeros(3)
        noted[:] = np.zeros_like(noted)
        noted["least"] = np.square((noise.position_sd_m, noise.velocity_sd_mps))
        noted["bounds"] = noted["density"] = noise.disturbance_mps2
        self._permit_drift(LATERAL)
        self._restart()

    def set_vehicle(self, vehicle: Vehicle) -> None:
        """Continue with another vehicle model, as identified in flight: thrust and disturbance
        change to what they mean with it, the motion does not. From now on the vertical drift is
        estimated too: before the thrust is identified, an error of its delay looks like drift, and
        a faster correction would make the vehicle oscillate."""
        scale = self._vehicle.hover_thrust / vehicle.hover_thrust
        self._history[:, SENT_THRUST] *= scale
        self._state[THRUST] *= scale
        down = (self._gravity + self._state[DISTURBANCE + 2]) * scale - vehicle.gravity_mps2
        slowed = vehicle.drag_per_mass_ps - self._vehicle.drag_per_mass_ps
        self._set_vehicle(vehicle)
        self._permit_drift(VERTICAL)
        self._state[DISTURBANCE + 2] = down
        self._state[DISTURBANCE : DISTURBANCE + 3] += slowed * self._state[VELOCITY : VELOCITY + 3]
        bound_disturbance(self._state)

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

    @property
    def noise_sds(self) -> tuple[float, float]:
        """Noise of position (m) and reported velocity (m/s), as estimated."""
        noted = self._adaptation[0]
        position, velocity = np.sqrt(np.maximum(noted["variance"], noted["least"]))
        return float(position), float(velocity)

    @property
    def drift_densities_mps2(self) -> tuple[float, float]:
        """Drift of the disturbance per root second, lateral and vertical, as estimated."""
        lateral, vertical = self._adaptation["density"][0]
        return float(lateral), float(vertical)

    def freeze(self, grounded: bool) -> None:
        """Stop estimating while the vehicle is on the ground or does not fly our commands: velocity
        as reported, thrust direction as measured, no disturbance. After that the filters start
        from there."""
        if grounded != self._frozen:
            self._reset_filters()
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
        history[sent] = time_s, north, east, command.thrust_mps2, command.heading_rad
        self._motion["sent"] = self._sent = sent + 1

    def on_attitude(self, time_s: float, q: Quaternion, rates: Triple) -> None:
        """Attitude quaternion (FRD to NED, w first) and body rates (rad/s, FRD) at `time_s`."""
        if not self._is_new(time_s, self._attitude_at):
            return
        north, east, _ = thrust_direction_from_quaternion(q).tolist()
        heading = float(heading_from_quaternion(q))
        self._rates = np.array(rates, dtype=np.float64)
        if self._attitude_at is None or self._frozen:
            state = self._state
            state[TILT : TILT + 2] = north, east
            state[TILT_RATE : TILT_RATE + 2] = 0.0
            state[HEADING], state[HEADING_RATE] = heading, 0.0
            state[THRUST] = self._gravity / b_z_of(north, east)
            self._time_s = max(self._time_s, time_s)
        else:
            self._go_to(time_s, complete=self._position_at is not None)
            update_by_attitude(self._record, time_s, north, east, heading)
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
            update_by_position(self._record, time_s)
        self._position_at = time_s

    def predict(self, time_s: float) -> PredictedState:
        """The state when the tilt of a command sent at `time_s` begins to act, after the tilt's
        delay, with the commands sent replayed; `heave` is the vertical after the thrust's delay.
        Valid once `ready`."""
        tilt_s = time_s + self._vehicle.tilt.delay_s
        thrust_s = time_s + self._vehicle.thrust_delay_s
        numbers = self._propagated(thrust_s).tolist()
        heave = PredictedHeave(
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
            heave=heave,
        )

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
        """Propagate state and covariances to `time_s`, or leave them if they are newer. `complete`:
        position and attitude have arrived, so that the commands can be replayed."""
        start_s = self._time_s
        if time_s <= start_s:
            return
        if complete:
            replay(self._motion, NOW, start_s, time_s)
            kalman.predict(self._filters, time_s - start_s, self._longest_s)
        self._time_s = time_s

    def _set_vehicle(self, vehicle: Vehicle) -> None:
        self._vehicle = vehicle
        self._gravity = vehicle.gravity_mps2
        self._motion["plant"] = plant_of(vehicle)
        frequency = max(vehicle.tilt.natural_frequency_radps, vehicle.yaw.natural_frequency_radps)
        damping = max(vehicle.tilt.damping, vehicle.yaw.damping, 0.5)
        self._longest_s = min(0.02, 0.25 / (2.0 * damping * frequency))
        for one, (dynamics, densities) in zip(
            self._filters, models(vehicle, self._noise), strict=True
        ):
            one["dynamics"][: len(densities), : len(densities)] = dynamics
            one["densities"][: len(densities)] = densities

    def _permit_drift(self, group: int) -> None:
        """Let the drift density of this group grow up to the limit."""
        noise = self._noise
        limit_mps2 = max(noise.disturbance_mps2, noise.disturbance_limit_mps2)
        self._adaptation["bounds"][0, group, 1] = limit_mps2

    def _forget_commands(self) -> None:
        self._motion["sent"] = self._sent = 0

    def _restart(self) -> None:
        """Take the next attitude and position as they are."""
        self._time_s = -math.inf
        self._position_at = None
        self._attitude_at = None
        self._state[THRUST] = self._gravity
        self._reset_filters()

    def _reset_filters(self) -> None:
        """Covariances, disturbance and bias as at the first message."""
        for one, sds in zip(self._filters, START_SDS, strict=True):
            one["covariance"][: len(sds), : len(sds)] = np.diag(np.square(sds))
        self._state[DISTURBANCE : BIAS + 3] = 0.0
        interrupt(self._adaptation.view(np.recarray)[0])

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
