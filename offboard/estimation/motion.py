"""f: the motion of the vehicle under the commands sent, compiled, for the observer's predictions.

The state x has `STATE_SIZE` numbers at the indices below (NED, SI): position, velocity, thrust
direction b (north and east) and its rate, disturbance, bias of the reported velocity, collective
thrust after its lag, heading and its rate. Runge-Kutta steps end when a command takes effect. The
code has loops over single numbers, because array expressions take seconds to compile.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from offboard.compiled import array, entry, kernel
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

# Columns of the commands sent; the first row is the oldest
SENT_AT = 0
SENT_TILT = 1
SENT_THRUST = 3
SENT_HEADING = 4
COMMAND_SIZE = 5

LONGEST_STEP_S = 0.01
BIAS_TIME_CONSTANT_S = 10.0  # with which the bias of the reported velocity decays
SAME_TIME_S = 1e-9


def plant_of(vehicle: Vehicle) -> Any:
    """Return the PLANT (1,) of `vehicle`."""
    tilt, yaw = vehicle.tilt, vehicle.yaw
    constants = (
        vehicle.gravity_mps2, vehicle.drag_per_mass_ps,
        vehicle.thrust_delay_s, vehicle.thrust_lag_s,
        tilt.delay_s, tilt.natural_frequency_radps, tilt.damping,
        yaw.delay_s, yaw.natural_frequency_radps, yaw.damping,
    )  # fmt: skip
    return np.array([constants], PLANT)


@entry(array(1), PLANT, array(2), float, float)
def propagate(state: Array, plants: Any, sent: Array, start_s: float, end_s: float) -> None:
    """Propagate `state` (19,) in place from `start_s` to `end_s` under the commands `sent` (n, 5),
    each axis with its own delay. `plants` is one PLANT (1,).

    Until the first command takes effect, tilt, thrust and heading keep their values.
    """
    plant = plants[0]
    longest = min(LONGEST_STEP_S, 0.2 / plant.tilt_frequency, 0.2 / plant.yaw_frequency)
    time = start_s
    while end_s - time > SAME_TIME_S:
        tilt_row, tilt_next = _in_force(sent, time, plant.tilt_delay_s)
        thrust_row, thrust_next = _in_force(sent, time, plant.thrust_delay_s)
        heading_row, heading_next = _in_force(sent, time, plant.yaw_delay_s)
        until = min(end_s, min(tilt_next, min(thrust_next, heading_next)))
        steps = max(1, math.ceil((until - time) / longest - 1e-6))
        north, east = state[TILT], state[TILT + 1]
        thrust, heading = state[THRUST], state[HEADING]
        if tilt_row >= 0:
            north, east = sent[tilt_row, SENT_TILT], sent[tilt_row, SENT_TILT + 1]
        if thrust_row >= 0:
            thrust = sent[thrust_row, SENT_THRUST]
        if heading_row >= 0:
            turn = sent[heading_row, SENT_HEADING] - heading
            heading += turn - 2.0 * math.pi * math.floor(turn / (2.0 * math.pi) + 0.5)
        for _ in range(steps):
            _step(state, (until - time) / steps, (north, east, thrust, heading), plant)
        time = until


@kernel
def _in_force(sent: Array, time_s: float, delay_s: float) -> tuple[int, float]:
    """Return the row of the command acting at `time_s` (-1: none yet) and the time when the next
    one begins to act."""
    row, following = sent.shape[0] - 1, math.inf
    while row >= 0 and sent[row, SENT_AT] + delay_s > time_s + SAME_TIME_S:
        following = sent[row, SENT_AT] + delay_s
        row -= 1
    return row, following


@kernel
def _step(state: Array, h: float, command: tuple[float, float, float, float], plant: Any) -> None:
    """Do one fourth-order Runge-Kutta step; the thrust's lag is integrated exactly."""
    rate, total = np.zeros(STATE_SIZE), np.zeros(STATE_SIZE)
    at, thrust = np.empty(STATE_SIZE), command[2]
    for share, weight in ((0.0, 1.0), (0.5, 2.0), (0.5, 2.0), (1.0, 1.0)):
        for i in range(STATE_SIZE):
            at[i] = state[i] + share * h * rate[i]
        if plant.thrust_lag_s > 0.0:
            left = math.exp(-share * h / plant.thrust_lag_s)
            thrust = command[2] + left * (state[THRUST] - command[2])
        _differentiate(at, thrust, command, plant, rate)
        for i in range(STATE_SIZE):
            total[i] += weight * rate[i]
    for i in range(STATE_SIZE):
        state[i] += h / 6.0 * total[i]
    state[THRUST] = thrust


@kernel
def _differentiate(
    state: Array,
    thrust: float,
    command: tuple[float, float, float, float],
    plant: Any,
    rate: Array,
) -> None:
    """Compute `rate`, x' at collective thrust `thrust` and the `command` now in force: thrust
    direction north and east, thrust, heading."""
    gravity = (0.0, 0.0, plant.gravity)
    direction = (state[TILT], state[TILT + 1], b_z_of(state[TILT], state[TILT + 1]))
    for axis in range(3):
        velocity = state[VELOCITY + axis]
        rate[POSITION + axis] = velocity
        rate[VELOCITY + axis] = acceleration(
            gravity[axis], thrust * direction[axis], plant.drag_ps, velocity,
            state[DISTURBANCE + axis],
        )  # fmt: skip
        rate[BIAS + axis] = -state[BIAS + axis] / BIAS_TIME_CONSTANT_S
    for axis in range(2):
        away, speed = command[axis] - state[TILT + axis], state[TILT_RATE + axis]
        rate[TILT + axis] = speed
        rate[TILT_RATE + axis] = (
            plant.tilt_frequency**2 * away - 2.0 * plant.tilt_damping * plant.tilt_frequency * speed
        )
    turn, speed = command[3] - state[HEADING], state[HEADING_RATE]
    rate[HEADING] = speed
    rate[HEADING_RATE] = (
        plant.yaw_frequency**2 * turn - 2.0 * plant.yaw_damping * plant.yaw_frequency * speed
    )
