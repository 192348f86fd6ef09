"""Plant: the simulated vehicle below the autopilot, with air, attitude loop and estimator.

`Plant` takes a `Demand` and a duration and gives the `Truth` and the `Estimate`. Fixed steps, one
compiled call per `advance`. Knows no modes, no arming and no MAVLink.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from offboard.model.rigid_body import QUATERNION
from offboard.model.vehicle import Triple, Vehicle
from simulator.steps import STEP_S
from simulator.vehicle.airframe import (
    ACCELERATION,
    CHARGE,
    CONTACT,
    THRUST,
    Airframe,
    build_airframe,
)
from simulator.vehicle.attitude import Demand, build_loop, encode
from simulator.vehicle.battery import BatteryState
from simulator.vehicle.conditions import Conditions
from simulator.vehicle.dynamics import RECORD, advance_steps, draw_gusts, receive_fix, report_state
from simulator.vehicle.noise import LinearProcess, seed_word
from simulator.vehicle.sensors import (
    ATTITUDE,
    POSITION,
    RATES,
    VELOCITY,
    error_model,
    error_process,
    white_sds,
)
from simulator.vehicle.wind import dryden, wind_axes

Array = NDArray[np.float64]

_MASS, _THRUST_MAX = 0, 0  # places in the constants of body and rotors


@dataclass(frozen=True, slots=True)
class Truth:
    """True state. Arrays (3,) NED or FRD, SI; quaternion (4,) wxyz FRD -> NED."""

    position_ned_m: Array
    velocity_ned_mps: Array
    acceleration_ned_mps2: Array
    attitude: Array
    rates_frd_radps: Array
    on_ground: bool
    thrust: float  # normalised collective thrust after the rotor lag
    wind_ned_mps: Array  # steady wind and gust
    battery: BatteryState


@dataclass(frozen=True, slots=True)
class Estimate:
    """Estimated state, as the autopilot reports it. Frames and units as in `Truth`."""

    position_ned_m: Array
    velocity_ned_mps: Array
    attitude: Array
    rates_frd_radps: Array
    reset_counter: int


@dataclass(frozen=True, slots=True)
class Fix:
    """GPS fix, NED: position (3,) and velocity (2,)."""

    position_ned_m: Array
    velocity_ne_mps: Array


class Plant:
    """One vehicle, at first on the ground at the origin, level, heading north, motors off.

    The estimator's errors start at zero and have a tenth of their noise while the motors are off:
    as on real vehicles, they reach their full size in the first tens of seconds of a flight. The
    same seed gives the same bytes, whatever the durations of the calls.
    """

    def __init__(self, vehicle: Vehicle, conditions: Conditions, seed: int) -> None:
        self.record = np.zeros(1, RECORD)
        self._step = 0
        self._due_s = 0.0
        airframe = build_airframe(
            vehicle,
            STEP_S,
            thrust_scale=conditions.thrust_scale,
            mass_scale=conditions.mass_scale,
            ground_effect=conditions.ground_effect,
            battery=conditions.battery,
        )
        self.pack = airframe.pack
        gusts = dryden(conditions.gusts, STEP_S)
        constants = {
            "seed": seed_word(seed),
            **_of_vehicle(vehicle, airframe),
            **_of_estimator(conditions),
            **_of_air(conditions, gusts),
        }
        for name, value in constants.items():
            self.record[name] = value
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
        draw_gusts(self.record)
        record["gust"][0] = gusts.stationary_scale @ record["gust_normals"][0]
        record["gusty"] = np.any(record["gust"] != 0.0)

    @property
    def time_s(self) -> float:
        """Simulated time since the plant was made."""
        return self._step * STEP_S

    def advance(self, duration_s: float, demand: Demand) -> None:
        """Hold the demand for `duration_s`; a remainder of a step is added to the next call."""
        if demand is not self._demand:
            encode(demand, self._row)
            self.record["motors_on"] = demand.motors_on
            self._demand = demand
        self._due_s += duration_s
        count = int(self._due_s / STEP_S + 1e-6)
        self._due_s -= count * STEP_S
        self._step += count
        advance_steps(count, self.record)

    def reset_estimate(self, offset_ned_m: Triple) -> None:
        """Offset the estimate, and count an estimator reset."""
        self._offset_ned_m += offset_ned_m
        self._reset_counter = (self._reset_counter + 1) % 256

    def drift_estimate(self, offset_ned_m: Triple) -> None:
        """Offset the estimate without an estimator reset."""
        self._offset_ned_m += offset_ned_m

    def scale_mass(self, factor: float) -> None:
        """Multiply the mass."""
        self.record["body_constants"][0, _MASS] *= factor

    def scale_thrust(self, factor: float) -> None:
        """Multiply the thrust."""
        self.record["rotor_constants"][0, _THRUST_MAX] *= factor

    def set_battery(self, remaining: float) -> None:
        """Set the remaining share of the battery's capacity, 0 .. 1."""
        self._rotor[CHARGE] = self.pack.drawn_as(remaining)

    @property
    def truth(self) -> Truth:
        """The true state; a copy."""
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
            battery=self.pack.state(float(self._rotor[CHARGE]), float(self._rotor[THRUST])),
        )

    @property
    def fix(self) -> Fix:
        """GPS fix of the present step; repeated calls give the same one."""
        receive_fix(self.record)
        fix = self.record["fix"][0].copy()
        return Fix(fix[:3], fix[3:])

    def motion(self) -> list[float]:
        """The true motion as floats: attitude wxyz, rates FRD, then NED velocity, position and
        acceleration."""
        return [*self._body.tolist(), *self._rotor[ACCELERATION].tolist()]

    @property
    def height_m(self) -> float:
        """True height above the ground."""
        return -float(self._body[12])

    @property
    def on_ground(self) -> bool:
        """Whether the ground carries the vehicle."""
        return bool(self._rotor[CONTACT])

    @property
    def reset_counter(self) -> int:
        """Estimator resets, modulo 256."""
        return self._reset_counter

    @property
    def estimate(self) -> Estimate:
        """Estimate of the present step; repeated calls give the same one."""
        out = self.report().copy()
        return Estimate(
            out[POSITION], out[VELOCITY], out[ATTITUDE], out[RATES], self._reset_counter
        )

    def report(self) -> Array:
        """Estimate as one array (REPORT_WIDTH,), with the layout of `simulator.vehicle.sensors`;
        the next call overwrites it."""
        report_state(self.record)
        seen: Array = self._report
        return seen


def _of_vehicle(vehicle: Vehicle, airframe: Airframe) -> dict[str, Any]:
    """Constants of airframe and attitude loop, by their names in the record."""
    loop = build_loop(vehicle, STEP_S)
    return {
        "substeps": airframe.substeps,
        "body_constants": airframe.body,
        "rotor_constants": airframe.rotor,
        "delays": loop.delays,
        "gains": loop.gains,
    }


def _of_estimator(conditions: Conditions) -> dict[str, Any]:
    model = error_model(conditions.estimator, conditions.white_noise)
    errors = error_process(model, STEP_S)
    return {
        "noisy": np.any(errors.scale != 0.0),
        "lag_s": model.lag_s,
        "white_sds": white_sds(model),
        "fix_sds": (*model.receiver.position_m, *model.receiver.velocity_mps),
        "error_transition": errors.transition,
        "error_scale": errors.scale,
    }


def _of_air(conditions: Conditions, gusts: LinearProcess) -> dict[str, Any]:
    weakening = conditions.weakening
    return {
        "air": (
            *conditions.wind_ned_mps,
            *wind_axes(conditions.wind_ned_mps),
            weakening.at_s if weakening else np.inf,
            weakening.thrust_scale if weakening else 1.0,
        ),
        "gust_transition": gusts.transition,
        "gust_scale": gusts.scale,
    }
