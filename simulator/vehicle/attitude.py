"""Attitude loop of the autopilot: demands, their delays, and the angular acceleration.

A cascade as in PX4: the attitude error, first of the thrust axis, then of yaw, gives a rate; the
rate error gives an angular acceleration, which is limited per axis. Linearised, each axis has the
identified response s'' = wn^2 (s_c(t - D) - s) - 2 z wn s'. The loop uses the estimated attitude,
not the true one. Knows no modes and no MAVLink.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from offboard.compiled import kernel
from offboard.model.vehicle import Vehicle
from simulator.steps import STEP_S

Array = NDArray[np.float64]
Triple = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]

# Delay of a rate demand as a share of the identified delay: it bypasses the attitude controller.
# A half reproduces PX4's measured rate steps (63 % after: roll 0.10-0.11 s, yaw 0.45 s).
_RATE_DELAY_SHARE = 0.5

# Columns of the demand history, which has one row per step; the last number is their count.
_IS_ATTITUDE, _RATES, _THRUST, ROW_WIDTH = 0, 5, 8, 9


@dataclass(frozen=True, slots=True)
class Demand:
    """Demand on the attitude loop.

    `attitude` is a quaternion (wxyz, FRD -> NED) of any length and takes precedence over
    `rates_frd_radps`; without both, zero rates are demanded. `thrust` is normalised collective
    thrust, 0 .. 1. As in PX4, a thrust of NaN is 0, and an attitude that is not finite is undefined
    (here: zero rates).
    """

    motors_on: bool = False
    thrust: float = 0.0
    attitude: Quaternion | None = None
    rates_frd_radps: Triple | None = None


def build_loop(vehicle: Vehicle) -> tuple[Array, NDArray[np.int64]]:
    """Constants of the compiled loop.

    Returns:
        Gains (4, 3), rows: attitude gain wn / 2z in 1/s, rate gain 2 z wn in 1/s, acceleration
        limit in rad/s^2, rate limit in rad/s. Delays (5,) of tilt, yaw, thrust, tilt rate and yaw
        rate in steps, less half a step, the mean delay of a demand that is held for a step.
    """
    axes = (vehicle.tilt, vehicle.tilt, vehicle.yaw)
    gains = np.array(
        [
            [axis.natural_frequency_radps / (2.0 * axis.damping) for axis in axes],
            # with a higher gain the loop would not be stable in steps of STEP_S
            [min(2.0 * axis.damping * axis.natural_frequency_radps, 1.0 / STEP_S) for axis in axes],
            vehicle.angular_acceleration_limit_radps2,
            vehicle.angular_rate_limit_radps,
        ]
    )
    delays_s = np.array(
        [
            vehicle.tilt.delay_s,
            vehicle.yaw.delay_s,
            vehicle.thrust_delay_s,
            _RATE_DELAY_SHARE * vehicle.tilt.delay_s,
            _RATE_DELAY_SHARE * vehicle.yaw.delay_s,
        ]
    )
    return gains, np.maximum(np.rint(delays_s / STEP_S - 0.5), 0.0).astype(np.int64)


def encode(demand: Demand, row: Array) -> None:
    """Write a demand into a row (ROW_WIDTH,) of the history; it has no NaN."""
    row[:] = 0.0
    thrust = demand.thrust if demand.motors_on else 0.0
    if not math.isnan(thrust):
        row[_THRUST] = min(max(thrust, 0.0), 1.0)
    if demand.attitude is not None:
        _encode_attitude(demand.attitude, row)
    elif demand.rates_frd_radps is not None:
        row[_RATES:_THRUST] = [0.0 if math.isnan(each) else each for each in demand.rates_frd_radps]


def _encode_attitude(attitude: Quaternion, row: Array) -> None:
    """Write an attitude with unit length, without overflow; an undefined one is not written."""
    w, x, y, z = attitude
    largest = max(abs(w), abs(x), abs(y), abs(z))
    if not math.isfinite(w + x + y + z) or largest == 0.0:
        return
    w, x, y, z = w / largest, x / largest, y / largest, z / largest
    norm = math.sqrt(w * w + x * x + y * y + z * z)
    row[_IS_ATTITUDE:_RATES] = (1.0, w / norm, x / norm, y / norm, z / norm)


@kernel
def _delayed_row(plant: Any, step: int, delay: int) -> Array:
    """Row of the demand history, `delay` steps ago."""
    row: Array = plant.history[(step - delay) % plant.history.shape[0]]
    return row


@kernel
def delayed_thrust(plant: Any, step: int) -> float:
    """Delayed normalised collective thrust."""
    thrust: float = _delayed_row(plant, step, plant.delays[2])[_THRUST]
    return thrust


@kernel
def _attitude_error(quaternion: Array, row: Array, error: Array) -> None:
    """Write the attitude error (3,) in the body frame, rad: 2 sin(half angle) along the axis.

    As in PX4's reduced attitude control, the shortest rotation of the thrust axis gives x and y
    (swing); the remaining rotation about the demanded thrust axis gives z (twist).
    """
    w, x, y, z = quaternion[0], quaternion[1], quaternion[2], quaternion[3]
    dw, dx, dy, dz = row[1], row[2], row[3], row[4]
    # conj(q) * q_demanded: the demanded attitude seen from the body
    ew = w * dw + x * dx + y * dy + z * dz
    ex = w * dx - x * dw - y * dz + z * dy
    ey = w * dy + x * dz - y * dw - z * dx
    ez = w * dz - x * dy + y * dx - z * dw
    # swing-twist: e = swing * twist, twist about z by atan2(ez, ew) * 2
    norm = math.sqrt(ew * ew + ez * ez)
    if norm < 1e-9:  # upside down: the twist is undefined
        error[0], error[1], error[2] = 2.0 * ex, 2.0 * ey, 0.0
        return
    cosine, sine = ew / norm, ez / norm
    error[0] = 2.0 * (ex * cosine - ey * sine)
    error[1] = 2.0 * (ey * cosine + ex * sine)
    error[2] = 2.0 * sine if cosine >= 0.0 else -2.0 * sine


@kernel
def angular_acceleration(plant: Any, step: int) -> None:
    """Write the demanded angular acceleration (FRD, rad/s^2) to `turn` of a
    `simulator.vehicle.dynamics.RECORD`.

    It follows from the *estimated* attitude and the true rates. Tilt and yaw have their own delays.
    """
    delays, gains, error, out = plant.delays, plant.gains, plant.turn_error, plant.turn
    for first, last, attitude_delay, rate_delay in (
        (0, 2, delays[0], delays[3]),
        (2, 3, delays[1], delays[4]),
    ):
        row = _delayed_row(plant, step, rate_delay)
        if row[_IS_ATTITUDE] > 0.5:
            row = _delayed_row(plant, step, attitude_delay)
        by_attitude = row[_IS_ATTITUDE] > 0.5
        if by_attitude:
            _attitude_error(plant.estimated, row, error)
        for i in range(first, last):
            rate = gains[0, i] * error[i] if by_attitude else row[_RATES + i]
            rate = min(max(rate, -gains[3, i]), gains[3, i])
            demand = gains[1, i] * (rate - plant.body[4 + i])
            out[i] = min(max(demand, -gains[2, i]), gains[2, i])
