"""The simulated vehicle below the autopilot: airframe, air, attitude loop and estimator as one.

`Plant` takes a `Demand` and a duration, and shows the `Truth` and the `Estimate`. Fixed steps,
one compiled call per `advance`. It knows no modes, no arming and no MAVLink.
"""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

from offboard.model.rigid_body import RK4_SCRATCH_ROWS
from offboard.model.state import QUATERNION
from offboard.model.vehicle import Triple, Vehicle
from simulator.airframe import (
    ACCELERATION,
    CHARGE,
    CONTACT,
    ROTOR_SIZE,
    THRUST,
    BatteryState,
    advance_airframe,
    build_airframe,
)
from simulator.attitude import (
    ROW_WIDTH,
    Demand,
    angular_acceleration,
    build_loop,
    delayed_thrust,
    encode,
)
from simulator.conditions import Conditions
from simulator.noise import advance_block, fill_normals, seed_word
from simulator.sensors import (
    ATTITUDE,
    EAST,
    ERROR_BLOCKS,
    ERROR_COUNT,
    NORTH,
    POSITION,
    RATES,
    REPORT_WIDTH,
    STANDING_NOISE,
    VELOCITY,
    YAW,
    error_model,
    error_process,
    report,
    turn_estimate,
    white_sds,
)
from simulator.wind import dryden, wind_axes

__all__ = ["STEP_S", "Conditions", "Demand", "Estimate", "Plant", "Truth"]

Array = NDArray[np.float64]

STEP_S = 0.004
"""Length of an integration step, s; `advance` moves in whole steps."""

# As typed numbers: compiled code is made once more for each plain constant that is handed on
_ERROR_LANE, _GUST_LANE, _WHITE_LANE = np.uint64(0), np.uint64(1), np.uint64(2)
_GUST_BLOCKS = ((0, 5),)

# The state vector: rigid body, rotors, wind, estimator errors, gusts.
_STATE_ENDS = np.cumsum([QUATERNION.size, ROTOR_SIZE, 3, ERROR_COUNT, 5])


# Places in the packed constants: body_constants[0] and rotor_constants[0] of `advance_steps`.
_MASS, _THRUST_MAX = 0, 12

# Places in the state vector, for compiled callers.
CONTACT_PLACE = QUATERNION.size + CONTACT
ACCELERATION_PLACE = QUATERNION.size + 3  # and the next two

Compiled = tuple[int, bool, int, np.uint64, Array, Array, NDArray[np.int64], Array, Array, Array]


@dataclass(frozen=True, slots=True)
class Truth:
    """Where the vehicle really is. Arrays (3,) NED or FRD, SI; quaternion (4,) wxyz FRD -> NED."""

    position_ned_m: Array
    velocity_ned_mps: Array
    acceleration_ned_mps2: Array
    attitude: Array
    rates_frd_radps: Array
    on_ground: bool
    thrust: float  # actual normalised collective thrust, behind the rotor lag
    wind_ned_mps: Array  # steady wind and gust
    battery: BatteryState


@dataclass(frozen=True, slots=True)
class Estimate:
    """Where the autopilot believes the vehicle is, as it would report it now. As in `Truth`."""

    position_ned_m: Array
    velocity_ned_mps: Array
    attitude: Array
    rates_frd_radps: Array
    reset_counter: int


class Plant:
    """One vehicle standing at the origin, level, nose north, motors off.

    The estimator's errors start at zero and are driven by a tenth of the noise until the motors
    first run: as on real vehicles, they reach their full size in the first tens of seconds of a
    flight. The same seed gives the same bytes, however the time is cut into calls.
    """

    def __init__(self, vehicle: Vehicle, conditions: Conditions, seed: int) -> None:
        self._seed = seed_word(seed)
        self._step = 0
        self._due_s = 0.0
        self._loop = build_loop(vehicle, STEP_S)
        self._airframe = build_airframe(
            vehicle,
            STEP_S,
            thrust_scale=conditions.thrust_scale,
            mass_scale=conditions.mass_scale,
            ground_effect=conditions.ground_effect,
            battery=conditions.battery,
        )
        model = error_model(conditions.estimator, conditions.white_noise)
        self._lag_s = model.lag_s
        self._white_sds = white_sds(model)
        errors = error_process(model, STEP_S)
        self._gusts = dryden(conditions.gusts, STEP_S)
        weakening = conditions.weakening
        air = [
            *conditions.wind_ned_mps,
            *wind_axes(conditions.wind_ned_mps),
            weakening.at_s if weakening else np.inf,
            weakening.thrust_scale if weakening else 1.0,
        ]
        blocks = (
            self._airframe.body,
            self._airframe.rotor,
            self._loop.gains,
            air,
            errors.transition,
            errors.scale,
            self._gusts.transition,
            self._gusts.scale,
        )
        self._constants = np.concatenate([np.ravel(block) for block in blocks])
        self._start_state(conditions.wind_ned_mps)

    def _start_state(self, wind_ned_mps: Triple) -> None:
        self._history = self._loop.history
        self._row = np.zeros(ROW_WIDTH)
        self._demand: Demand | None = None
        self._motors_on = False
        self._state = np.zeros(_STATE_ENDS[-1])
        self._body, self._rotor, self._wind, self._error, gust = np.split(
            self._state, _STATE_ENDS[:-1]
        )
        self._body[0] = 1.0
        self._rotor[CONTACT] = 1.0
        self._wind[:] = wind_ned_mps
        fill_normals(self._seed, _GUST_LANE, -1, gust)
        gust[:] = self._gusts.stationary_scale @ gust
        self._believed = np.concatenate([np.zeros(3), [self._lag_s], self._white_sds])
        self._offset_ned_m = self._believed[:3]
        self._reset_counter = 0

    @property
    def time_s(self) -> float:
        """Virtual time since boot."""
        return self._step * STEP_S

    def advance(self, duration_s: float, demand: Demand) -> None:
        """Hold the demand for `duration_s`; what is left of a step is owed to the next call."""
        if demand is not self._demand:
            encode(demand, self._row)
            self._motors_on = demand.motors_on
            self._demand = demand
        self._due_s += duration_s
        count = int(self._due_s / STEP_S + 1e-6)
        self._due_s -= count * STEP_S
        while count > 0:
            done = advance_steps(
                count,
                self._step,
                self._motors_on,
                self._airframe.substeps,
                self._seed,
                self._row,
                self._history,
                self._loop.delays,
                self._constants,
                self._state,
            )
            self._step += done
            count -= done

    def compiled(self) -> Compiled:
        """What `advance_steps` and `report_state` want, in the order of the former: for a caller
        that is compiled itself, and tells `flown` afterwards. The demand is the last one."""
        return (
            self._step,
            self._motors_on,
            self._airframe.substeps,
            self._seed,
            self._row,
            self._history,
            self._loop.delays,
            self._constants,
            self._state,
            self._believed,
        )

    def flown(self, count: int) -> None:
        """A compiled caller took the state so many steps further."""
        self._step += count

    def reset_estimate(self, offset_ned_m: Triple) -> None:
        """The estimator jumps by this much from now on, and says so by its reset counter."""
        self._offset_ned_m += offset_ned_m
        self._reset_counter = (self._reset_counter + 1) % 256

    def drift_estimate(self, offset_ned_m: Triple) -> None:
        """The estimate moves off by this much, and the estimator does not notice."""
        self._offset_ned_m += offset_ned_m

    def scale_mass(self, factor: float) -> None:
        """From now on the vehicle is this much heavier."""
        self._constants[_MASS] *= factor

    def scale_thrust(self, factor: float) -> None:
        """From now on the rotors give this much more."""
        self._constants[_THRUST_MAX] *= factor

    def set_battery(self, remaining: float) -> None:
        """From now on the battery has this share of its capacity, 0 .. 1."""
        battery = self._airframe.battery
        drawn = battery.remaining - remaining
        self._rotor[CHARGE] = 3600.0 * battery.capacity_ah * drawn

    @property
    def truth(self) -> Truth:
        """A copy of the true state now."""
        body = self._body.copy()
        return Truth(
            position_ned_m=body[QUATERNION.position],
            velocity_ned_mps=body[QUATERNION.velocity],
            acceleration_ned_mps2=self._rotor[ACCELERATION].copy(),
            attitude=body[QUATERNION.attitude],
            rates_frd_radps=body[QUATERNION.rates],
            on_ground=bool(self._rotor[CONTACT]),
            thrust=float(self._rotor[THRUST]),
            wind_ned_mps=self._wind.copy(),
            battery=self._airframe.battery_state(self._rotor),
        )

    def motion(self) -> list[float]:
        """The truth as plain numbers: attitude wxyz, rates FRD, then NED velocity, position,
        acceleration."""
        return [*self._body.tolist(), *self._rotor[ACCELERATION].tolist()]

    @property
    def on_ground(self) -> bool:
        """Whether the ground carries the vehicle."""
        return bool(self._rotor[CONTACT])

    @property
    def reset_counter(self) -> int:
        """How often the estimate was reset, 0 .. 255."""
        return self._reset_counter

    @property
    def estimate(self) -> Estimate:
        """What the autopilot reports now; the same however often it is asked within a step."""
        out = self.report()
        return Estimate(
            out[POSITION], out[VELOCITY], out[ATTITUDE], out[RATES], self._reset_counter
        )

    def report(self) -> Array:
        """The estimate in one array (REPORT_WIDTH,), laid out as `simulator.sensors` says."""
        out = np.empty(REPORT_WIDTH)
        report_state(self._state, self._believed, self._motors_on, self._seed, self._step, out)
        return out


@numba.njit(cache=True)
def report_state(
    state: Array, believed: Array, motors_on: bool, seed: np.uint64, step: int, out: Array
) -> None:
    """The estimate of this state; `believed`: reset offset (3,), lag, white deviations (12,)."""
    report(
        state[:13],
        state[16:19],
        state[22:34],
        believed[:3],
        believed[3],
        believed[4:],
        1.0 if motors_on else STANDING_NOISE,
        seed,
        _WHITE_LANE,
        step,
        out,
    )


@numba.njit(cache=True)
def _stirs(values: Array) -> bool:
    for value in values:  # noqa: SIM110 (any() compiles for longer)
        if value != 0.0:
            return True
    return False


@numba.njit(cache=True)
def advance_steps(
    count: int,
    first_step: int,
    motors_on: bool,
    substeps: int,
    seed: np.uint64,
    row: Array,
    history: Array,
    delays: NDArray[np.int64],
    constants: Array,
    state: Array,
) -> int:
    """`count` steps in place; the steps done, which are fewer if the ground is touched or left.
    Per step: demand into history, air, loop on the estimate, airframe, estimator errors. Packed,
    because unpacking one argument costs a tenth of a step."""
    body, rotor, wind = state[:13], state[13:19], state[19:22]
    error, gust = state[22:34], state[34:39]
    body_constants, rotor_constants = constants[:12], constants[12:18]
    gains, air = constants[18:27].reshape(3, 3), constants[27:34]
    error_transition = constants[34:178].reshape(12, 12)
    error_scale = constants[178:322].reshape(12, 12)
    gust_transition = constants[322:347].reshape(5, 5)
    gust_scale = constants[347:372].reshape(5, 5)
    normals, work = np.empty(ERROR_COUNT), np.empty(ERROR_COUNT)
    estimated, turn, turn_error = np.empty(4), np.empty(3), np.empty(3)
    inputs, scratch = np.empty(4), np.empty((RK4_SCRATCH_ROWS, 13))
    noisy, gusty = _stirs(constants[178:322]), _stirs(gust)
    noise_gain = 1.0 if motors_on else STANDING_NOISE
    contact = rotor[CONTACT]
    for step in range(first_step, first_step + count):
        for i in range(row.shape[0]):
            history[step % history.shape[0], i] = row[i]
        if gusty:
            fill_normals(seed, _GUST_LANE, step, normals[: gust.shape[0]])
            for first, end in _GUST_BLOCKS:
                advance_block(gust_transition, gust_scale, first, end, 1.0, normals, gust, work)
        wind[0] = air[0] + air[3] * gust[0] - air[4] * gust[1]
        wind[1] = air[1] + air[4] * gust[0] + air[3] * gust[1]
        wind[2] = air[2] + gust[3]
        turn_error[0], turn_error[1] = -error[EAST + 2], error[NORTH + 2]
        turn_error[2] = error[YAW]
        turn_estimate(body[:4], turn_error, estimated)
        angular_acceleration(estimated, body[4:7], history, step, delays, gains, turn_error, turn)
        thrust = delayed_thrust(history, step, delays) if motors_on else 0.0
        strength = air[6] if step * STEP_S >= air[5] else 1.0
        advance_airframe(
            body,
            rotor,
            thrust,
            turn,
            wind,
            body_constants,
            rotor_constants,
            strength,
            STEP_S,
            substeps,
            inputs,
            scratch,
        )
        if noisy:
            fill_normals(seed, _ERROR_LANE, step, normals)
            for first, end in ERROR_BLOCKS:
                advance_block(
                    error_transition, error_scale, first, end, noise_gain, normals, error, work
                )
        if rotor[CONTACT] != contact:
            return step + 1 - first_step
    return count
