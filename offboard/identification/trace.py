"""A stretch of flight as arrays: commands sent, attitudes and positions received.

All times are vehicle time in s; the stamp of a command is that of the newest telemetry when it was
sent. Arrays have N samples or M commands, in the order of their stamps. NED, SI.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

# Columns of commands, attitudes and positions, and their number
SENT_AT, SENT_NORTH, SENT_THRUST, SENT_HEADING, COMMAND_WIDTH = 0, 1, 3, 4, 5
STAMP, NORTH, EAST, HEADING, ATTITUDE_WIDTH = 0, 1, 2, 3, 4
POSITION, VELOCITY, POSITION_WIDTH = slice(1, 4), slice(4, 7), 7


@dataclass(frozen=True, slots=True)
class Trace:
    """Commands and telemetry of a stretch of flight.

    `commands` (M, 5): stamp, thrust direction north and east, collective thrust along the body
    axis as a fraction of full throttle, heading (rad). `attitude` (N, 4): stamp, thrust direction
    north and east, heading (rad). `position` (N, 7): stamp, position (m), reported velocity (m/s).
    """

    commands: Array
    attitude: Array
    position: Array

    @property
    def begin_s(self) -> float:
        """First time with both attitude and position; NaN if there is none."""
        if not len(self.attitude) or not len(self.position):
            return math.nan
        return float(max(self.attitude[0, STAMP], self.position[0, STAMP]))

    @property
    def end_s(self) -> float:
        """Last time with both attitude and position; NaN if there is none."""
        if not len(self.attitude) or not len(self.position):
            return math.nan
        return float(min(self.attitude[-1, STAMP], self.position[-1, STAMP]))

    @property
    def seconds(self) -> float:
        """Time with both attitude and position; 0 if there is none."""
        seconds = self.end_s - self.begin_s
        return max(seconds, 0.0) if math.isfinite(seconds) else 0.0

    def between(self, begin_s: float, end_s: float) -> Trace:
        """Return the telemetry from `begin_s` to `end_s`, and all commands sent until `end_s`."""
        return Trace(
            self.commands[self.commands[:, SENT_AT] <= end_s],
            *(
                rows[(rows[:, STAMP] >= begin_s) & (rows[:, STAMP] <= end_s)]
                for rows in (self.attitude, self.position)
            ),
        )


def clean(commands: Array, attitude: Array, position: Array) -> Trace:
    """Return a Trace of rows in the order of arrival. Rows that are not finite, telemetry that is
    not newer and commands that are older than those before are omitted; of commands with the same
    stamp the last is kept."""
    commands, attitude, position = (
        rows[np.isfinite(rows).all(axis=1)] for rows in (commands, attitude, position)
    )
    commands = commands[commands[:, SENT_AT] >= np.maximum.accumulate(commands[:, SENT_AT])]
    last_of_stamp = np.append(np.diff(commands[:, SENT_AT]) > 0.0, True)[: len(commands)]
    return Trace(commands[last_of_stamp], _newer(attitude), _newer(position))


def _newer(rows: Array) -> Array:
    """Return the rows that are newer than all before."""
    newest = np.maximum.accumulate(rows[:, STAMP])
    newer: Array = rows[rows[:, STAMP] > np.append(-np.inf, newest)[: len(rows)]]
    return newer


SPACING_S = 0.018  # closer samples are omitted, because motion and responses are slower


def thinned(stamps: Array, spacing_s: float) -> NDArray[np.intp]:
    """Return the indices of rows at least `spacing_s` apart."""
    kept: list[int] = []
    last = -math.inf
    for row, stamp in enumerate(stamps.tolist()):
        if stamp - last >= spacing_s:
            kept.append(row)
            last = stamp
    return np.array(kept, dtype=np.intp)


class Rows:
    """Keeps the last rows of `width` numbers: at least `capacity`, at most twice as many."""

    def __init__(self, width: int, capacity: int = 3750) -> None:  # 30 s at 125 Hz
        self._capacity = capacity
        self._rows = np.empty((2 * capacity, width))
        self._count = 0

    @property
    def kept(self) -> Array:
        kept: Array = self._rows[: self._count]
        return kept

    def add(self, *numbers: float) -> None:
        if self._count == len(self._rows):
            self._rows[: self._capacity] = self._rows[self._capacity :]
            self._count = self._capacity
        self._rows[self._count] = numbers
        self._count += 1
