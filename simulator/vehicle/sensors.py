"""Estimator errors: models identified on autopilots, and the estimate made from truth and errors.

The error of an estimator is a linear process per NED axis, e = [e_p, e_v, e_b, e_r] with
e' = A e + w, plus white noise. Where the GPS is later than the estimator assumes, e_r' also depends
on the true velocity. e_p and e_v are estimated minus true position and velocity; e_b is estimated
minus true thrust direction; e_r is the rate of e_p where e_p is smooth. PX4's process reproduces a
smooth position, and a velocity that is *not* its derivative, which white noise alone does not.
Knows no vehicle and no MAVLink.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from offboard.compiled import kernel
from offboard.documents.parameters import Parameters
from offboard.model.vehicle import NonNegativeTriple
from simulator.vehicle.noise import LinearProcess, block_diagonal, discretise

Array = NDArray[np.float64]
Rows = tuple[tuple[float, ...], ...]

# Order of the error state: north p v b r, east p v b r, down p v r, yaw.
NORTH, EAST, DOWN, YAW, ERROR_COUNT = 0, 4, 8, 11, 12
AXIS_STRIDE = 4

WHITE_COUNT = 12  # position, velocity, attitude, rates

# Factor on the noise while the motors are off, because the IMU then has less noise.
STANDING_NOISE = 0.1


class EstimatorName(StrEnum):
    """Models of estimator errors; the last three were identified on these autopilots."""

    PERFECT = "perfect"
    WHITE = "white"
    PX4_LIKE = "px4_like"
    ARDUPILOT_LIKE = "ardupilot_like"
    ARDUPILOT_SITL = "ardupilot_sitl"


class WhiteNoise(Parameters):
    """Standard deviations of the `white` estimator, the same on each axis, independent at each
    sample. The minima are the values of `perfect`: the controller ignores a position that repeats.
    """

    position_m: float = Field(default=0.02, ge=0.00005, le=10)
    velocity_mps: float = Field(default=0.02, ge=0.00005, le=10)
    attitude_rad: float = Field(default=0.001, ge=0.000001, le=0.3)
    rates_radps: NonNegativeTriple = (0.07, 0.035, 0.014)


@dataclass(frozen=True, slots=True)
class AxisError:
    """Error e' = drift e + noise xi of one axis; xi is white with unit density; p m, v m/s, b rad.

    The model may have fewer states than the error state, in the same order; the others are zero.
    """

    drift: Rows = ()
    noise: Rows = ()


@dataclass(frozen=True, slots=True)
class ErrorModel:
    """Errors of one estimator and of its GPS receiver."""

    north: AxisError
    east: AxisError
    down: AxisError
    yaw_sd_rad: float
    yaw_time_s: float
    white: WhiteNoise
    lag_s: float  # delay of position and velocity behind their time stamp
    # e_r' of north and east per true velocity, 1/s, of a GPS that is later than assumed
    late_gps_ps: float = 0.0
    receiver: tuple[float, ...] = (0.0,) * 5  # white sd of a GPS fix: position NED, velocity N, E


_NONE = AxisError()
# Without any noise an estimate would repeat itself while the vehicle stands, and no real one does:
# of 9,000 samples that PX4 1.16 and ArduCopter 4.6 sent while armed, none repeats the one before.
# Armed on the ground, ArduCopter's samples change by medians of 6e-5 m, 6e-5 m/s, 1.3e-6 and
# 4e-5 rad/s.
_LEAST = WhiteNoise(
    position_m=0.00005, velocity_mps=0.00005, attitude_rad=0.000001, rates_radps=(0.00004,) * 3
)
PERFECT = ErrorModel(_NONE, _NONE, _NONE, 0.0, 15.0, _LEAST, 0.0)

# GPS noise of PX4's SIH, measured as GPS_RAW_INT minus truth at 47 deg north. SIH adds the noise to
# latitude and longitude in degrees, so that it is smaller in metres to the east.
SIH_RECEIVER = (0.19, 0.13, 0.52, 0.062, 0.072)

# PX4 1.16 SITL with its SIH quadrotor, identified from estimate minus truth in hover and on
# lemniscates. Accelerometer noise drives e_v. e_p does not integrate it: the filter's position
# corrections remove it within about half a second. The output predictor smooths them, so e_p has
# its own rate, e_r, whose noise is correlated with that of e_v. North and east differ because
# SIH's IMU noise is per body axis.
PX4_LIKE = ErrorModel(
    north=AxisError(
        drift=(
            (0.0, 0.0, 0.0, 1.0),
            (-0.087, -0.249, -3.36, 0.753),
            (-0.010, 0.014, -0.175, -0.016),
            (-0.318, -0.151, -6.65, -2.40),
        ),
        noise=(
            (0.0, 0.0, 0.0),
            (0.037, 0.0, 0.0),
            (0.0, 0.009, 0.0),
            (0.050, 0.0, 0.122),
        ),
    ),
    east=AxisError(
        drift=(
            (0.0, 0.0, 0.0, 1.0),
            (0.039, -0.379, -4.24, 0.968),
            (-0.013, 0.025, -0.004, -0.014),
            (-0.275, -0.123, -5.25, -1.49),
        ),
        noise=(
            (0.0, 0.0, 0.0),
            (0.102, 0.0, 0.0),
            (0.0, 0.009, 0.0),
            (0.121, 0.0, 0.112),
        ),
    ),
    down=AxisError(
        drift=((0.0, 0.0, 1.0), (-0.031, -0.131, 0.293), (-0.274, 0.556, -1.97)),
        noise=((0.0, 0.0), (0.085, 0.0), (0.090, 0.157)),
    ),
    yaw_sd_rad=math.radians(2.5),
    yaw_time_s=15.0,
    white=WhiteNoise(
        position_m=0.00005,
        velocity_mps=0.0005,
        attitude_rad=0.0001,
        rates_radps=(0.07, 0.035, 0.014),
    ),
    lag_s=0.004,
    receiver=SIH_RECEIVER,
)


# ArduCopter 4.6 EKF3, identified as PX4's was. The sensors had more noise than SITL's default, like
# those of a real vehicle. Standard deviations are N and E 0.057 m and 0.027 m/s, D 0.023 and 0.006,
# correlated over 1-1.5 s. The mean rate of the position over 1 s differs from the velocity by
# 0.05 m/s, over 4 s by 0.02.
_ARDUPILOT_LATERAL = AxisError(
    drift=(
        (0.0, 0.0, 0.0, 1.0),
        (0.069, -0.832, -10.83, 0.430),
        (0.005, 0.012, -1.307, -0.016),
        (-2.323, 1.275, -0.582, -2.341),
    ),
    noise=(
        (0.0, 0.0, 0.0),
        (0.0060, 0.0, 0.0),
        (-0.0006, 0.0029, 0.0),
        (0.0166, -0.0022, 0.1678),
    ),
)
ARDUPILOT_LIKE = ErrorModel(
    north=_ARDUPILOT_LATERAL,
    east=_ARDUPILOT_LATERAL,
    down=AxisError(
        drift=((0.0, 0.0, 1.0), (0.013, -0.254, 0.252), (-1.028, 0.498, -1.894)),
        noise=((0.0, 0.0), (0.0027, 0.0), (0.0002, 0.0414)),
    ),
    yaw_sd_rad=math.radians(0.5),
    yaw_time_s=15.0,
    white=WhiteNoise(
        position_m=0.00005,
        velocity_mps=0.0001,
        attitude_rad=0.0001,
        rates_radps=(0.02, 0.02, 0.01),
    ),
    lag_s=0.0,
    receiver=SIH_RECEIVER,
)

# ArduCopter 4.6 SITL as shipped, whose sensors have no noise. Its GPS is later than its EKF3
# assumes, so that e_p follows minus this delay times the true velocity through a second-order
# filter. Fits to estimate minus truth of nine flights give 1.3 to 1.8 rad/s, damping 0.37 to 0.69,
# a delay of 23 to 31 ms, and leave 0.01 m. In the scenario of this name the tracking errors are
# 0.0009 m (hover), 0.0016 and 0.0050 (lemniscates of 15 and 8 s), 0.017 and 0.0038 (the latter with
# 120 ms more delay each way, and in wind of 0.65 m/s) and 0.021 (circle at 8 m/s); on the real
# autopilot they are 0.0009, 0.0018, 0.0046, 0.014, 0.0044 and 0.018 m.
_SITL_RADPS, _SITL_DAMPING, _SITL_LATE_S = 1.6, 0.55, 0.0225
_SITL_LATERAL = AxisError(
    drift=(
        (0.0, 0.0, 0.0, 1.0),
        (),
        (),
        (-(_SITL_RADPS**2), 0.0, 0.0, -2.0 * _SITL_DAMPING * _SITL_RADPS),
    ),
    noise=((), (), (), (0.005,)),
)
ARDUPILOT_SITL = replace(
    PERFECT, north=_SITL_LATERAL, east=_SITL_LATERAL, late_gps_ps=-(_SITL_RADPS**2) * _SITL_LATE_S
)


def error_model(name: EstimatorName, white: WhiteNoise) -> ErrorModel:
    """Return the error model of this name; only WHITE uses `white`."""
    return {
        EstimatorName.PERFECT: PERFECT,
        EstimatorName.WHITE: ErrorModel(_NONE, _NONE, _NONE, 0.0, 15.0, white, 0.0),
        EstimatorName.PX4_LIKE: PX4_LIKE,
        EstimatorName.ARDUPILOT_LIKE: ARDUPILOT_LIKE,
        EstimatorName.ARDUPILOT_SITL: ARDUPILOT_SITL,
    }[name]


def error_process(model: ErrorModel, step_s: float) -> LinearProcess:
    """Return the process of the error state (NORTH, EAST, DOWN, YAW) with steps of `step_s`."""
    sizes = ((model.north, EAST - NORTH), (model.east, DOWN - EAST), (model.down, YAW - DOWN))
    parts = [discretise(*_padded(axis, size), step_s) for axis, size in sizes]
    yaw_density = model.yaw_sd_rad * math.sqrt(2.0 / model.yaw_time_s)
    parts.append(discretise([[-1.0 / model.yaw_time_s]], [yaw_density], step_s))
    return block_diagonal(*parts)


def _padded(axis: AxisError, size: int) -> tuple[Array, Array]:
    """Drift and noise, each (size, size). States that the model does not have stay zero."""
    drift, noise = -np.eye(size), np.zeros((size, size))
    for i, (drift_row, noise_row) in enumerate(zip(axis.drift, axis.noise, strict=True)):
        drift[i, : len(drift_row)] = drift_row
        noise[i, : len(noise_row)] = noise_row
    return drift, noise


def white_sds(model: ErrorModel) -> Array:
    """Standard deviations (12,) of the white noise of position, velocity, attitude and rates."""
    white = model.white
    lateral = np.repeat([white.position_m, white.velocity_mps, white.attitude_rad], 3)
    return np.concatenate([lateral, white.rates_radps])


@kernel
def turn_estimate(body: Array, error: Array, out: Array) -> None:
    """Write the attitude of `body`, rotated by the small NED rotation `error` (3,) rad, to `out`
    (4,), with unit length.

    A rotation (-e_bE, e_bN, e_psi) changes the thrust direction of a level body by (e_bN, e_bE).
    """
    w, x, y, z = body[0], body[1], body[2], body[3]
    a, b, c = 0.5 * error[0], 0.5 * error[1], 0.5 * error[2]
    out[0] = w - a * x - b * y - c * z
    out[1] = x + a * w + b * z - c * y
    out[2] = y + b * w + c * x - a * z
    out[3] = z + c * w + a * y - b * x
    norm = math.sqrt(out[0] ** 2 + out[1] ** 2 + out[2] ** 2 + out[3] ** 2)
    for i in range(4):
        out[i] /= norm


# Layout of a report, which is the estimate as one array.
POSITION, VELOCITY, ATTITUDE, RATES = slice(0, 3), slice(3, 6), slice(6, 10), slice(10, 13)
REPORT_WIDTH = 13
