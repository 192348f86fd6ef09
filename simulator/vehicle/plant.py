"""Plant: the simulated vehicle below the autopilot, with air, attitude loop and estimator.

`Plant` flies a `Demand` for a duration and returns the `Truth` and a report of the estimate. It has
fixed steps and makes one compiled call per `advance`. Knows no modes, no arming and no MAVLink.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from offboard.model.vehicle import Triple, Vehicle
from simulator.steps import STEP_S
from simulator.vehicle.airframe import CHARGE, CONTACT, THRUST, build_airframe
from simulator.vehicle.attitude import Demand, Quaternion, build_loop, encode
from simulator.vehicle.conditions import BatteryState, Conditions
from simulator.vehicle.dynamics import RECORD, advance_steps, draw_gusts, receive_fix, report_state
from simulator.vehicle.noise import seed_word
from simulator.vehicle.sensors import error_model, error_process, white_sds
from simulator.vehicle.wind import dryden, wind_axes

Array = NDArray[np.float64]

_MASS, _THRUST_MAX = 0, 0  # indices in the constants of body and rotors


@dataclass(frozen=True, slots=True)
class Truth:
    """True state as plain floats; NED or FRD, SI."""

    position_ned_m: Triple
    velocity_ned_mps: Triple
    acceleration_ned_mps2: Triple
    attitude: Quaternion
    rates_frd_radps: Triple
    thrust: float  # normalised collective thrust after the rotor lag


class Plant:
    """One vehicle. At first it is on the ground at the origin, level, heading north, motors off.

    The estimator's errors start at zero and have a tenth of their noise while the motors are off:
    as on real vehicles, they reach their full size in the first tens of seconds of a flight. The
    same seed gives the same bytes, however a duration is divided into calls of `advance`.
    """

    def __init__(self, vehicle: Vehicle, conditions: Conditions, seed: int) -> None:
        self.record = np.zeros(1, RECORD)
        body, rotor, substeps = build_airframe(vehicle, conditions)
        (gains, delays), gusts = build_loop(vehicle), dryden(conditions.gusts, STEP_S)
        model = error_model(conditions.estimator, conditions.white_noise)
        errors, wind_ned_mps = error_process(model, STEP_S), conditions.wind_ned_mps
        constants = {
            "seed": seed_word(seed),
            "substeps": substeps,
            "body_constants": body,
            "rotor_constants": rotor,
            "delays": delays,
            "gains": gains,
            "noisy": np.any(errors.scale != 0.0),
            "lag_s": model.lag_s,
            "late_gps_ps": model.late_gps_ps,
            "white_sds": white_sds(model),
            "fix_sds": model.receiver,
            "error_transition": errors.transition,
            "error_scale": errors.scale,
            "air": (*wind_ned_mps, *wind_axes(wind_ned_mps)),
            "gust_transition": gusts.transition,
            "gust_scale": gusts.scale,
        }
        record = self.record
        for name, value in constants.items():
            record[name] = value
        self._battery, self._hover_thrust = conditions.battery, vehicle.hover_thrust
        self._demand: Demand | None = None
        self._body, self._rotor = record["body"][0], record["rotor"][0]
        self._row, self._report = record["row"][0], record["report"][0]
        self._offset_ned_m = record["offset"][0]
        self.velocity_error_ned_mps = record["velocity_error"][0]  # set by a fault
        self.gps_healthy = True  # False while a fault takes the GPS fix away
        self.reset_counter = 0  # estimator resets, modulo 256
        self._body[0] = 1.0
        self._rotor[CONTACT] = 1.0
        self.wind_ned_mps = record["wind"][0]  # steady wind and gust
        self.wind_ned_mps[:] = wind_ned_mps
        draw_gusts(record)
        record["gust"][0] = gusts.stationary_scale @ record["gust_normals"][0]
        record["gusty"] = np.any(record["gust"] != 0.0)

    def advance(self, duration_s: float, demand: Demand) -> None:
        """Fly the constant demand for `duration_s`, rounded to steps."""
        if demand is not self._demand:
            encode(demand, self._row)
            self.record["motors_on"] = demand.motors_on
            self._demand = demand
        advance_steps(round(duration_s / STEP_S), self.record)

    def reset_estimate(self, offset_ned_m: Triple) -> None:
        """Offset the position estimate, and count an estimator reset."""
        self._offset_ned_m += offset_ned_m
        self.reset_counter = (self.reset_counter + 1) % 256

    def drift_estimate(self, offset_ned_m: Triple) -> None:
        """Offset the position estimate without an estimator reset."""
        self._offset_ned_m += offset_ned_m

    def scale_mass(self, factor: float) -> None:
        """Multiply the mass."""
        self.record["body_constants"][0, _MASS] *= factor

    def scale_thrust(self, factor: float) -> None:
        """Multiply the thrust."""
        self.record["rotor_constants"][0, _THRUST_MAX] *= factor

    def set_battery(self, remaining: float) -> None:
        """Set the remaining share of the battery's capacity, 0 .. 1."""
        self._rotor[CHARGE] = self._battery.drawn_as(remaining)

    @property
    def truth(self) -> Truth:
        """The true state."""
        w, x, y, z, p, q, r, v_north, v_east, v_down, north, east, down = self._body.tolist()
        thrust, _, _, a_north, a_east, a_down = self._rotor.tolist()
        return Truth(
            (north, east, down),
            (v_north, v_east, v_down),
            (a_north, a_east, a_down),
            (w, x, y, z),
            (p, q, r),
            thrust,
        )

    @property
    def battery(self) -> BatteryState:
        """State of the battery, as a battery monitor measures it."""
        hover_share = float(self._rotor[THRUST]) / self._hover_thrust
        return self._battery.state(float(self._rotor[CHARGE]), hover_share)

    def fix(self) -> list[float]:
        """Return the GPS fix of the present step: NED position, then velocity north and east.
        Repeated calls return the same values."""
        receive_fix(self.record)
        fix: list[float] = self.record["fix"][0].tolist()
        return fix

    @property
    def height_m(self) -> float:
        """True height above the ground."""
        return -float(self._body[12])

    @property
    def on_ground(self) -> bool:
        """Whether the ground carries the vehicle."""
        return bool(self._rotor[CONTACT])

    def report(self) -> Array:
        """Return the estimate of the present step as an array (REPORT_WIDTH,) with the layout in
        `simulator.vehicle.sensors`. Repeated calls return the same array with the same values; a
        call in a later step overwrites it."""
        report_state(self.record)
        seen: Array = self._report
        return seen
