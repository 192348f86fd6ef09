"""Motion of the vehicle under the commands sent, compiled, for the observer's predictions.

A state has `STATE_SIZE` numbers at the indices below (NED, SI): position, velocity, thrust
direction b (north and east) and its rate, disturbance, bias of the reported velocity, collective
thrust after its lag, heading and its rate. Motion is integrated with Runge-Kutta steps that end
when a command takes effect. States are changed in place.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from offboard.compiled import entry, kernel
from offboard.model.axes import acceleration, b_z_of
from offboard.model.vehicle import Vehicle

Array = NDArray[np.float64]

POSITION = 0
VELOCITY = 3
TILT = 6
TILT_RATE = 8
DISTURBANCE = 10
BIAS = 13
THRUST = 16
HEADING = 17
HEADING_RATE = 18
STATE_SIZE = 19

PLANT = np.dtype(
    [
        (name, "f8")
        for name in (
            "gravity", "drag_ps", "thrust_delay_s", "thrust_lag_s",
            "tilt_delay_s", "tilt_frequency", "tilt_damping",
            "yaw_delay_s", "yaw_frequency", "yaw_damping",
        )
    ],
    align=True,
)  # fmt: skip
"""The constants of a vehicle that its motion needs."""

# Columns of the command history, oldest row first.
SENT_AT = 0
SENT_TILT = 1
SENT_THRUST = 3
SENT_HEADING = 4
COMMAND_SIZE = 5

COMMANDS_KEPT = 128
NOW, LATER = 0, 1  # rows of the states
MOTION = np.dtype(
    [
        ("states", "f8", (2, STATE_SIZE)),
        ("plant", PLANT),
        ("history", "f8", (COMMANDS_KEPT, COMMAND_SIZE)),
        ("sent", "i8"),  # rows of the history that are in use
        ("slopes", "f8", (5, STATE_SIZE)),  # scratch
    ],
    align=True,
)
"""States, the constants of the plant and the commands sent."""

LONGEST_STEP_S = 0.01
BIAS_TIME_CONSTANT_S = 10.0  # with which the bias of the reported velocity is forgotten
SAME_TIME_S = 1e-9


def plant_of(vehicle: Vehicle) -> tuple[float, ...]:
    """The PLANT of `vehicle`, in the order of its fields."""
    tilt, yaw = vehicle.tilt, vehicle.yaw
    return (
        vehicle.gravity_mps2, vehicle.drag_per_mass_ps,
        vehicle.thrust_delay_s, vehicle.thrust_lag_s,
        tilt.delay_s, tilt.natural_frequency_radps, tilt.damping,
        yaw.delay_s, yaw.natural_frequency_radps, yaw.damping,
    )  # fmt: skip


@kernel
def _in_force(motion: Any, time_s: float, delay_s: float) -> tuple[int, float]:
    """Row of the command acting at `time_s` (-1: none yet) and the time when the next one acts."""
    row = motion.sent - 1
    while row >= 0 and motion.history[row, SENT_AT] + delay_s > time_s + SAME_TIME_S:
        row -= 1
    following = math.inf
    if row + 1 < motion.sent:
        following = motion.history[row + 1, SENT_AT] + delay_s
    return row, following


@kernel
def _differentiate(
    state: Array,
    thrust: float,
    tilt_n: float,
    tilt_e: float,
    heading: float,
    plant: Any,
    rate: Array,
) -> None:
    """Right-hand side at collective thrust `thrust` and the commands now in force."""
    b_n, b_e = state[TILT], state[TILT + 1]
    gravity = (0.0, 0.0, plant.gravity)
    direction = (b_n, b_e, b_z_of(b_n, b_e))
    for axis in range(3):
        velocity = state[VELOCITY + axis]
        rate[POSITION + axis] = velocity
        rate[VELOCITY + axis] = acceleration(
            gravity[axis], thrust * direction[axis], plant.drag_ps, velocity,
            state[DISTURBANCE + axis],
        )  # fmt: skip
        rate[DISTURBANCE + axis] = 0.0
        rate[BIAS + axis] = -state[BIAS + axis] / BIAS_TIME_CONSTANT_S
    stiffness = plant.tilt_frequency**2
    damping = 2.0 * plant.tilt_damping * plant.tilt_frequency
    rate[TILT] = state[TILT_RATE]
    rate[TILT + 1] = state[TILT_RATE + 1]
    rate[TILT_RATE] = stiffness * (tilt_n - b_n) - damping * state[TILT_RATE]
    rate[TILT_RATE + 1] = stiffness * (tilt_e - b_e) - damping * state[TILT_RATE + 1]
    rate[THRUST] = 0.0
    rate[HEADING] = state[HEADING_RATE]
    rate[HEADING_RATE] = (
        plant.yaw_frequency**2 * (heading - state[HEADING])
        - 2.0 * plant.yaw_damping * plant.yaw_frequency * state[HEADING_RATE]
    )


@kernel
def _lagged(thrust: float, commanded: float, lag_s: float, step_s: float) -> float:
    if lag_s <= 0.0:
        return commanded
    return commanded + (thrust - commanded) * math.exp(-step_s / lag_s)


@kernel
def _move(state: Array, h: float, rate: Array, moved: Array) -> None:
    for i in range(STATE_SIZE):
        moved[i] = state[i] + h * rate[i]


@kernel
def _step(
    state: Array,
    h: float,
    tilt_n: float,
    tilt_e: float,
    thrust: float,
    heading: float,
    plant: Any,
    slopes: Array,
) -> None:
    """One Runge-Kutta step of fourth order; the thrust's lag is integrated exactly."""
    lag = plant.thrust_lag_s
    middle = _lagged(state[THRUST], thrust, lag, 0.5 * h)
    end = _lagged(state[THRUST], thrust, lag, h)
    start = state[THRUST] if lag > 0.0 else thrust
    k1, k2, k3, k4, moved = slopes[0], slopes[1], slopes[2], slopes[3], slopes[4]
    _differentiate(state, start, tilt_n, tilt_e, heading, plant, k1)
    _move(state, 0.5 * h, k1, moved)
    _differentiate(moved, middle, tilt_n, tilt_e, heading, plant, k2)
    _move(state, 0.5 * h, k2, moved)
    _differentiate(moved, middle, tilt_n, tilt_e, heading, plant, k3)
    _move(state, h, k3, moved)
    _differentiate(moved, end, tilt_n, tilt_e, heading, plant, k4)
    for i in range(STATE_SIZE):
        state[i] += h / 6.0 * (k1[i] + 2.0 * k2[i] + 2.0 * k3[i] + k4[i])
    state[THRUST] = end


@entry(MOTION, int, float, float)
def replay(motions: Any, row: int, start_s: float, end_s: float) -> None:
    """Propagate the state NOW from `start_s` to `end_s` under the commands sent, each axis with its
    own delay, and write it to `row`, NOW or LATER. `motions` is one MOTION (1,).

    Until the first command takes effect, tilt, thrust and heading keep their values.
    """
    motion = motions[0]
    state, history, plant = motion.states[row], motion.history, motion.plant
    for i in range(STATE_SIZE):
        state[i] = motion.states[NOW, i]
    longest = min(LONGEST_STEP_S, 0.2 / plant.tilt_frequency, 0.2 / plant.yaw_frequency)
    time = start_s
    while end_s - time > SAME_TIME_S:
        tilt_row, tilt_next = _in_force(motion, time, plant.tilt_delay_s)
        thrust_row, thrust_next = _in_force(motion, time, plant.thrust_delay_s)
        heading_row, heading_next = _in_force(motion, time, plant.yaw_delay_s)
        until = min(end_s, min(tilt_next, min(thrust_next, heading_next)))
        steps = max(1, math.ceil((until - time) / longest - 1e-6))
        h = (until - time) / steps
        tilt_n, tilt_e = state[TILT], state[TILT + 1]
        thrust, heading = state[THRUST], state[HEADING]
        if tilt_row >= 0:
            tilt_n, tilt_e = history[tilt_row, SENT_TILT], history[tilt_row, SENT_TILT + 1]
        if thrust_row >= 0:
            thrust = history[thrust_row, SENT_THRUST]
        if heading_row >= 0:
            heading += wrapped(history[heading_row, SENT_HEADING] - state[HEADING])
        for _ in range(steps):
            _step(state, h, tilt_n, tilt_e, thrust, heading, plant, motion.slopes[:])
        time = until


@kernel
def wrapped(angle_rad: float) -> float:
    """The angle wrapped to -pi .. pi."""
    return angle_rad - 2.0 * math.pi * math.floor(angle_rad / (2.0 * math.pi) + 0.5)
