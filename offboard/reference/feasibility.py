"""Checks, before anything is sent, whether a vehicle can fly a reference."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from offboard.model.vehicle import Vehicle
from offboard.reference.base import FlatSample, Reference
from offboard.reference.flatness import FlatState, body_rates, flat_state
from offboard.reference.track import Track

Array = NDArray[np.float64]

HEIGHT_MIN_M, DISTANCE_MAX_M, SPEED_MAX_MPS = 0.3, 2000.0, 12.0
# Of roll and pitch. The shipped references need 2; more than 50 is noise of dense, rounded rows
TILTING_MAX_RADPS2 = 50.0
# Shares of the vehicle's limits that a reference may use; the rest is reserved for feedback
THRUST_SHARE_MIN, THRUST_SHARE_MAX, TILT_SHARE_MAX = 0.05, 0.95, 0.9
_STEP_S = 0.01
_CHUNK = 20_000


class Envelope(NamedTuple):
    """The greatest tilt, height above, and horizontal distance from the takeoff point."""

    tilt_rad: float
    height_m: float
    radius_m: float


@dataclass(frozen=True, slots=True)
class _Demand:
    """One quantity over time and its limit; `sign` is -1 if that is a lower limit."""

    what: str
    unit: str
    values: Array
    limit: float
    sign: float = 1.0
    of_path: bool = False  # depends on the path alone, not on the vehicle


def check(reference: Reference, vehicle: Vehicle, slower: str = "") -> Envelope:
    """Check that a vehicle can fly a reference without wind, and return its envelope. `slower` says
    how the reference becomes slower; it ends the error for a limit of the vehicle.

    The reference, relative to the takeoff point, is sampled every 10 ms. Raises ValueError for a
    path that is too low or too far away, otherwise for the limit that is exceeded first. Times in
    the error are those of the path if the reference is a `Track`, as in the rows of a table.
    """
    count = int(np.ceil(reference.duration_s / _STEP_S)) + 1
    times = np.linspace(0.0, reference.duration_s, count)
    # a part ends with the first sample of the next one, so that no step between two is left out
    parts = [times[first : first + _CHUNK + 1] for first in range(0, count, _CHUNK)]
    reached = np.max([_envelope(reference, vehicle, slower, part) for part in parts], axis=0)
    return Envelope(*reached.tolist())


def _envelope(reference: Reference, vehicle: Vehicle, slower: str, times: Array) -> Envelope:
    sample = reference.sample(times)
    state = flat_state(sample, vehicle.gravity_mps2, vehicle.drag_per_mass_ps)
    tilt = np.arccos(np.clip(state.thrust_direction_ned[:, 2], -1.0, 1.0))
    broken: list[tuple[int, _Demand]] = []
    for demand in _demands(sample, state, tilt, vehicle):
        # written so that NaN exceeds the limit
        within = demand.sign * demand.values <= demand.sign * demand.limit
        if not within.all():
            broken.append((int(np.argmin(within)), demand))
    if broken:
        first, demand = min(broken, key=lambda item: (not item[1].of_path, item[0]))
        worst = int(np.argmax(demand.sign * demand.values))  # argmax returns the first NaN, if any
        worst_s, first_s = float(times[worst]), float(times[first])
        if isinstance(reference, Track):
            worst_s, first_s = map(reference.path_time_s, (worst_s, first_s))
        side = "below" if demand.sign < 0.0 else "beyond"
        fix = f"; {slower}" if slower and not demand.of_path else ""
        fix += " or turn less (course)" if fix and demand.what == "a yaw rate of" else ""
        raise ValueError(
            f"the reference requires {demand.what} {demand.values[worst]:.3g} {demand.unit} at "
            f"{worst_s:.2f} s, {side} the limit of {demand.limit:.3g} {demand.unit} "
            f"(first at {first_s:.2f} s){fix}"
        )
    north, east, down = sample.position_ned_m.T
    return Envelope(float(tilt.max()), float(-down.min()), float(np.hypot(north, east).max()))


def _demands(
    sample: FlatSample, state: FlatState, tilt: Array, vehicle: Vehicle
) -> tuple[_Demand, ...]:
    thrust_max = vehicle.thrust_max_mps2
    rates, most = body_rates(sample, state), vehicle.angular_rate_limit_radps
    tilting = np.abs(np.diff(rates[:, :2], axis=0, prepend=rates[:1, :2])).max(axis=1) / _STEP_S
    rates = np.abs(rates)
    speed = np.linalg.norm(sample.velocity_ned_mps, axis=-1)
    height = 0.0 - sample.position_ned_m[:, 2]  # no -0
    distance = np.linalg.norm(sample.position_ned_m, axis=-1)
    thrust = state.thrust_mps2
    thrust_min = max(THRUST_SHARE_MIN * thrust_max, vehicle.thrust_min_mps2)
    return (
        _Demand("a thrust of", "m/s^2", thrust, thrust_min, -1.0),
        _Demand("a thrust of", "m/s^2", thrust, THRUST_SHARE_MAX * thrust_max),
        _Demand("a tilt of", "rad", tilt, TILT_SHARE_MAX * vehicle.tilt_max_rad),
        _Demand("a roll rate of", "rad/s", rates[:, 0], most[0]),
        _Demand("a pitch rate of", "rad/s", rates[:, 1], most[1]),
        _Demand("a yaw rate of", "rad/s", rates[:, 2], most[2]),
        _Demand("a roll or pitch acceleration of", "rad/s^2", tilting, TILTING_MAX_RADPS2),
        _Demand("a speed of", "m/s", speed, SPEED_MAX_MPS),
        _Demand("a height of", "m", height, HEIGHT_MIN_M, -1.0, of_path=True),
        _Demand("a distance of", "m", distance, DISTANCE_MAX_M, of_path=True),
    )
