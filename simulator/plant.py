"""The simulated vehicle below the autopilot: airframe, air, attitude loop and estimator as one.

`Plant` takes a `Demand` and a duration, and shows the `Truth` and the `Estimate`. Fixed steps,
one compiled call per `advance`. It knows no modes, no arming and no MAVLink.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from offboard.model.kernel import address, entry, kernel
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
from simulator.noise import LinearProcess, advance_block, fill_normals, seed_word
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
    WHITE_COUNT,
    YAW,
    error_model,
    error_process,
    report,
    turn_estimate,
    white_sds,
)
from simulator.steps import STEP_S
from simulator.wind import GUST_COUNT, dryden, wind_axes

Array = NDArray[np.float64]

_MASS, _THRUST_MAX = 0, 0  # places in the constants of body and rotors

# As typed numbers: compiled code is made once more for each plain constant that is handed on
_ERROR_LANE, _GUST_LANE, _WHITE_LANE, _RECEIVER_LANE = (np.uint64(lane) for lane in range(4))
_GUST_BLOCKS = ((0, GUST_COUNT),)

# Rows of the demand history, a power of two: more steps than any vehicle's longest delay
_HISTORY_ROWS = 128

RECORD = np.dtype(
    [
        ("step", "i8"),
        ("seed", "u8"),
        ("motors_on", "i8"),
        ("substeps", "i8"),
        ("gusty", "i8"),
        ("noisy", "i8"),
        # the truth
        ("body", "f8", QUATERNION.size),
        ("rotor", "f8", ROTOR_SIZE),
        ("wind", "f8", 3),
        ("gust", "f8", GUST_COUNT),
        # the estimator
        ("error", "f8", ERROR_COUNT),
        ("offset", "f8", 3),
        ("lag_s", "f8"),
        ("white_sds", "f8", WHITE_COUNT),
        # the satellite receiver: position NED and velocity NE
        ("fix_sds", "f8", 5),
        ("fix_offset", "f8", 3),
        # the attitude loop
        ("row", "f8", ROW_WIDTH),
        ("history", "f8", (_HISTORY_ROWS, ROW_WIDTH)),
        ("delays", "i8", 5),
        ("gains", "f8", (3, 3)),
        # constants
        ("body_constants", "f8", 12),
        ("rotor_constants", "f8", 6),
        ("air", "f8", 7),
        ("error_transition", "f8", (ERROR_COUNT, ERROR_COUNT)),
        ("error_scale", "f8", (ERROR_COUNT, ERROR_COUNT)),
        ("gust_transition", "f8", (GUST_COUNT, GUST_COUNT)),
        ("gust_scale", "f8", (GUST_COUNT, GUST_COUNT)),
        # scratch
        ("normals", "f8", WHITE_COUNT),
        ("gust_normals", "f8", GUST_COUNT),
        ("work", "f8", ERROR_COUNT),
        ("estimated", "f8", 4),
        ("turn", "f8", 3),
        ("turn_error", "f8", 3),
        ("inputs", "f8", 4),
        ("slopes", "f8", (RK4_SCRATCH_ROWS, QUATERNION.size)),
        # what `report_state` says
        ("report", "f8", REPORT_WIDTH),
        # what `receive_fix` says
        ("fix", "f8", 5),
    ],
    align=True,
)
"""All that compiled code knows of one vehicle below its autopilot."""


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


@dataclass(frozen=True, slots=True)
class Fix:
    """What the satellite receiver says, NED: position (3,) and velocity (2,)."""

    position_ned_m: Array
    velocity_ne_mps: Array


class Plant:
    """One vehicle standing at the origin, level, nose north, motors off.

    The estimator's errors start at zero and are driven by a tenth of the noise until the motors
    first run: as on real vehicles, they reach their full size in the first tens of seconds of a
    flight. The same seed gives the same bytes, however the time is cut into calls.
    """

    def __init__(self, vehicle: Vehicle, conditions: Conditions, seed: int) -> None:
        self.record = np.zeros(1, RECORD)
        self.address = address(self.record)
        self._step = 0
        self._due_s = 0.0
        self._airframe = build_airframe(
            vehicle,
            STEP_S,
            thrust_scale=conditions.thrust_scale,
            mass_scale=conditions.mass_scale,
            ground_effect=conditions.ground_effect,
            battery=conditions.battery,
        )
        model = error_model(conditions.estimator, conditions.white_noise)
        errors = error_process(model, STEP_S)
        gusts = dryden(conditions.gusts, STEP_S)
        loop = build_loop(vehicle, STEP_S)
        weakening = conditions.weakening
        air = (
            *conditions.wind_ned_mps,
            *wind_axes(conditions.wind_ned_mps),
            weakening.at_s if weakening else np.inf,
            weakening.thrust_scale if weakening else 1.0,
        )
        constants = {
            "seed": seed_word(seed),
            "substeps": self._airframe.substeps,
            "noisy": np.any(errors.scale != 0.0),
            "lag_s": model.lag_s,
            "white_sds": white_sds(model),
            "fix_sds": (*model.receiver.position_m, *model.receiver.velocity_mps),
            "delays": loop.delays,
            "gains": loop.gains,
            "body_constants": self._airframe.body,
            "rotor_constants": self._airframe.rotor,
            "air": air,
            "error_transition": errors.transition,
            "error_scale": errors.scale,
            "gust_transition": gusts.transition,
            "gust_scale": gusts.scale,
        }
        for name, value in constants.items():
            self.record[name] = value
        *_, current_a, hover_thrust = self.battery_constants
        self._drain_max_a = current_a * hover_thrust**-1.5
        self._start(conditions.wind_ned_mps, gusts)

    def _start(self, wind_ned_mps: Triple, gusts: LinearProcess) -> None:
        record = self.record
        self._demand: Demand | None = None
        self._body, self._rotor, self._wind = (
            record[name][0] for name in ("body", "rotor", "wind")
        )
        self._row, self._report = record["row"][0], record["report"][0]
        self._offset_ned_m = record["offset"][0]
        self._reset_counter = 0
        self._body[0] = 1.0
        self._rotor[CONTACT] = 1.0
        self._wind[:] = wind_ned_mps
        _draw_gusts.call(self.address)
        record["gust"][0] = gusts.stationary_scale @ record["gust_normals"][0]
        record["gusty"] = np.any(record["gust"] != 0.0)

    @property
    def time_s(self) -> float:
        """Virtual time since boot."""
        return self._step * STEP_S

    def advance(self, duration_s: float, demand: Demand) -> None:
        """Hold the demand for `duration_s`; what is left of a step is owed to the next call."""
        self.obey(demand)
        self._due_s += duration_s
        count = int(self._due_s / STEP_S + 1e-6)
        self._due_s -= count * STEP_S
        self._step += count
        while count > 0:
            count -= advance_steps.call(count, self.address)

    def obey(self, demand: Demand) -> None:
        """From the next step on this is the demand."""
        if demand is not self._demand:
            encode(demand, self._row)
            self.record["motors_on"] = demand.motors_on
            self._demand = demand

    def flown(self, count: int) -> None:
        """Compiled code took the record so many steps further."""
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
        self.record["body_constants"][0, _MASS] *= factor

    def scale_thrust(self, factor: float) -> None:
        """From now on the rotors give this much more."""
        self.record["rotor_constants"][0, _THRUST_MAX] *= factor

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
            battery=self._battery(0.0, float(self._rotor[THRUST])),
        )

    @property
    def battery_constants(self) -> tuple[float, ...]:
        """Cells, capacity A s, share at boot, resistance ohm; current A and thrust in hover."""
        battery = self._airframe.battery
        return (
            battery.cells,
            3600.0 * battery.capacity_ah,
            battery.remaining,
            battery.resistance_ohm,
            battery.hover_current_a,
            self._airframe.hover_thrust,
        )

    def battery_at_worst(self, after_s: float) -> BatteryState:
        """What the battery may be by then: at full thrust from now on."""
        return self._battery(self._drain_max_a * after_s, 1.0)

    def _battery(self, more_as: float, thrust: float) -> BatteryState:
        return self._airframe.battery_state(float(self._rotor[CHARGE]) + more_as, thrust)

    @property
    def fix(self) -> Fix:
        """A satellite fix of now; the same however often it is asked within a step."""
        receive_fix.call(self.address)
        fix = self.record["fix"][0].copy()
        return Fix(fix[:3], fix[3:])

    def shift_fixes(self, offset_ned_m: Triple) -> None:
        """Fixes are off by this much more from now on."""
        self.record["fix_offset"][0] += offset_ned_m

    def motion(self) -> list[float]:
        """The truth as plain numbers: attitude wxyz, rates FRD, then NED velocity, position,
        acceleration."""
        return [*self._body.tolist(), *self._rotor[ACCELERATION].tolist()]

    @property
    def height_m(self) -> float:
        """True, above the ground."""
        return -float(self._body[12])

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
        out = self.report().copy()
        return Estimate(
            out[POSITION], out[VELOCITY], out[ATTITUDE], out[RATES], self._reset_counter
        )

    def report(self) -> Array:
        """The estimate in one array (REPORT_WIDTH,), laid out as `simulator.sensors` says; it
        changes with the next call."""
        report_state.call(self.address)
        seen: Array = self._report
        return seen


@entry(RECORD)
def _draw_gusts(plant: Any) -> int:
    fill_normals(plant.seed, _GUST_LANE, np.int64(-1), plant.gust_normals[:])
    return 0


@entry(RECORD)
def report_state(plant: Any) -> int:
    """Fill in the report of this state."""
    report(
        plant.body,
        plant.rotor,
        plant.error,
        plant.offset,
        plant.lag_s,
        plant.white_sds,
        1.0 if plant.motors_on else STANDING_NOISE,
        plant.seed,
        _WHITE_LANE,
        plant.step,
        plant.normals,
        plant.report,
    )
    return 0


@entry(RECORD)
def receive_fix(plant: Any) -> int:
    """Fill in the satellite fix of this state."""
    fill_normals(plant.seed, _RECEIVER_LANE, plant.step, plant.fix[:])
    for i in range(5):
        plant.fix[i] *= plant.fix_sds[i]
    for i in range(3):
        plant.fix[i] += plant.body[10 + i] + plant.fix_offset[i]
    for i in range(2):
        plant.fix[3 + i] += plant.body[7 + i]
    return 0


@entry(int, RECORD)
def advance_steps(count: int, plant: Any) -> int:
    """`count` steps in place; the steps done, which are fewer if the ground is touched or left.

    Per step: demand into history, air, loop on the estimate, airframe, estimator errors.
    """
    contact = plant.rotor[CONTACT]
    noise_gain = 1.0 if plant.motors_on else STANDING_NOISE
    error, turn_error = plant.error, plant.turn_error
    first = plant.step
    for step in range(first, first + count):
        for i in range(ROW_WIDTH):
            plant.history[step % _HISTORY_ROWS, i] = plant.row[i]
        _move_air(plant, step)
        turn_error[0], turn_error[1] = -error[EAST + 2], error[NORTH + 2]
        turn_error[2] = error[YAW]
        turn_estimate(plant.body, turn_error[:], plant.estimated[:])
        angular_acceleration(
            plant.estimated,
            plant.body,
            plant.history,
            step,
            plant.delays,
            plant.gains,
            turn_error,
            plant.turn,
        )
        advance_airframe(
            plant.body,
            plant.rotor,
            delayed_thrust(plant.history, step, plant.delays) if plant.motors_on else 0.0,
            plant.turn,
            plant.wind,
            plant.body_constants,
            plant.rotor_constants,
            plant.air[6] if step * STEP_S >= plant.air[5] else 1.0,
            STEP_S,
            plant.substeps,
            plant.inputs,
            plant.slopes,
        )
        if plant.noisy:
            fill_normals(plant.seed, _ERROR_LANE, step, plant.normals[:])
            for start, end in ERROR_BLOCKS:
                advance_block(
                    plant.error_transition[:],
                    plant.error_scale[:],
                    start,
                    end,
                    noise_gain,
                    plant.normals[:],
                    error[:],
                    plant.work[:],
                )
        plant.step = step + 1
        if plant.rotor[CONTACT] != contact:
            done: int = step + 1 - first
            return done
    return count


@kernel
def _move_air(plant: Any, step: int) -> None:
    """Steady wind and gusts, along and across it."""
    gust, air, wind = plant.gust, plant.air, plant.wind
    if plant.gusty:
        fill_normals(plant.seed, _GUST_LANE, step, plant.gust_normals[:])
        for start, end in _GUST_BLOCKS:
            advance_block(
                plant.gust_transition[:],
                plant.gust_scale[:],
                start,
                end,
                1.0,
                plant.gust_normals[:],
                gust[:],
                plant.work[:],
            )
    wind[0] = air[0] + air[3] * gust[0] - air[4] * gust[1]
    wind[1] = air[1] + air[4] * gust[0] + air[3] * gust[1]
    wind[2] = air[2] + gust[3]
