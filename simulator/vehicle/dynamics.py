"""Compiled functions that advance the vehicle below the autopilot, and that compute what its
estimator and its GPS receiver report.

All of them read and change a `RECORD` in place, which `simulator.vehicle.plant` fills.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from offboard.compiled import entry, kernel
from offboard.model.rigid_body import QUATERNION, RK4_SCRATCH_ROWS
from simulator.steps import STEP_S
from simulator.vehicle.airframe import ROTOR_SIZE, advance_airframe
from simulator.vehicle.attitude import ROW_WIDTH, angular_acceleration, delayed_thrust
from simulator.vehicle.noise import advance_process, fill_normals
from simulator.vehicle.sensors import (
    AXIS_STRIDE,
    EAST,
    ERROR_COUNT,
    NORTH,
    REPORT_WIDTH,
    STANDING_NOISE,
    WHITE_COUNT,
    YAW,
    turn_estimate,
)
from simulator.vehicle.wind import GUST_COUNT

# Random streams. Typed numbers, because a plain constant as an argument would make Numba compile
# the called function once more for each value
_ERROR_LANE, _GUST_LANE, _WHITE_LANE, _RECEIVER_LANE = (np.uint64(lane) for lane in range(4))

# Rows of the demand history: a power of two, greater than any vehicle's longest delay in steps
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
        ("velocity_error", "f8", 3),
        ("lag_s", "f8"),
        ("late_gps_ps", "f8"),
        ("white_sds", "f8", WHITE_COUNT),
        # the GPS receiver: position NED and velocity NE
        ("fix_sds", "f8", 5),
        # the attitude loop
        ("row", "f8", ROW_WIDTH),
        ("history", "f8", (_HISTORY_ROWS, ROW_WIDTH)),
        ("delays", "i8", 5),
        ("gains", "f8", (4, 3)),
        # constants
        ("body_constants", "f8", 13),
        ("rotor_constants", "f8", 5),
        ("air", "f8", 5),
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
        # output of `report_state`
        ("report", "f8", REPORT_WIDTH),
        # output of `receive_fix`
        ("fix", "f8", 5),
    ],
    align=True,
)
"""Complete state, constants and scratch of one vehicle below its autopilot; SI, NED and FRD."""


@entry(RECORD)
def draw_gusts(plants: Any) -> None:
    """Write the random numbers for the gust at the start of a flight to `gust_normals`."""
    plant = plants[0]
    fill_normals(plant.seed, _GUST_LANE, np.int64(-1), plant.gust_normals[:])


@entry(RECORD)
def report_state(plants: Any) -> None:
    """Write the estimate of the present state to `report`: truth, delayed by `lag_s`, plus errors,
    offsets and white noise."""
    plant = plants[0]
    body, error, white, out = plant.body, plant.error, plant.normals, plant.report
    fill_normals(plant.seed, _WHITE_LANE, plant.step, white[:])
    gain = 1.0 if plant.motors_on else STANDING_NOISE
    for i in range(WHITE_COUNT):
        white[i] *= gain * plant.white_sds[i]
    for axis in range(3):
        late = body[10 + axis] - plant.lag_s * body[7 + axis]
        out[axis] = late + error[AXIS_STRIDE * axis] + plant.offset[axis] + white[axis]
        slow = body[7 + axis] - plant.lag_s * plant.rotor[3 + axis]
        drifting = slow + error[AXIS_STRIDE * axis + 1] + white[3 + axis]
        out[3 + axis] = drifting + plant.velocity_error[axis]
        out[10 + axis] = body[4 + axis] + white[9 + axis]
    turn = white[6:9]
    turn[0] -= error[EAST + 2]
    turn[1] += error[NORTH + 2]
    turn[2] += error[YAW]
    turn_estimate(body, turn, out[6:10])


@entry(RECORD)
def receive_fix(plants: Any) -> None:
    """Write the GPS fix of the present state to `fix`."""
    plant = plants[0]
    fill_normals(plant.seed, _RECEIVER_LANE, plant.step, plant.fix[:])
    for i in range(5):
        plant.fix[i] *= plant.fix_sds[i]
    for i in range(3):
        plant.fix[i] += plant.body[10 + i]
    for i in range(2):
        plant.fix[3 + i] += plant.body[7 + i]


@entry(int, RECORD)
def advance_steps(count: int, plants: Any) -> None:
    """Advance by `count` steps, in place.

    Each step stores the demand in the history and then advances the wind, the attitude loop, the
    airframe and the estimator's errors.
    """
    plant = plants[0]
    first = plant.step
    for step in range(first, first + count):
        for i in range(ROW_WIDTH):
            plant.history[step % _HISTORY_ROWS, i] = plant.row[i]
        _move_air(plant, step)
        _control_attitude(plant, step)
        advance_airframe(plant, delayed_thrust(plant, step) if plant.motors_on else 0.0)
        if plant.noisy:
            _move_errors(plant, step)
        plant.step = step + 1


@kernel
def _move_air(plant: Any, step: int) -> None:
    """Compute the wind of the next step: steady wind plus gusts along it, across it and down."""
    gust, air, wind = plant.gust, plant.air, plant.wind
    if plant.gusty:
        fill_normals(plant.seed, _GUST_LANE, step, plant.gust_normals[:])
        advance_process(
            plant.gust_transition[:],
            plant.gust_scale[:],
            1.0,
            plant.gust_normals[:],
            gust[:],
            plant.work[:],
        )
    wind[0] = air[0] + air[3] * gust[0] - air[4] * gust[1]
    wind[1] = air[1] + air[4] * gust[0] + air[3] * gust[1]
    wind[2] = air[2] + gust[3]


@kernel
def _control_attitude(plant: Any, step: int) -> None:
    """Compute the angular acceleration that the attitude loop demands at the estimated attitude."""
    error, turn_error = plant.error, plant.turn_error
    turn_error[0], turn_error[1] = -error[EAST + 2], error[NORTH + 2]
    turn_error[2] = error[YAW]
    turn_estimate(plant.body, turn_error[:], plant.estimated[:])
    angular_acceleration(plant, step)


@kernel
def _move_errors(plant: Any, step: int) -> None:
    """Advance the errors of the estimator: a linear process, with the true velocity as an input if
    the GPS is late."""
    fill_normals(plant.seed, _ERROR_LANE, step, plant.normals[:])
    advance_process(
        plant.error_transition[:],
        plant.error_scale[:],
        1.0 if plant.motors_on else STANDING_NOISE,
        plant.normals[:],
        plant.error[:],
        plant.work[:],
    )
    for axis in range(2):
        plant.error[AXIS_STRIDE * axis + 3] += STEP_S * plant.late_gps_ps * plant.body[7 + axis]
