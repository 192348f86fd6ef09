"""A stretch of flight as arrays: commands sent, attitudes and positions received.

All times are vehicle time in s; the stamp of a command is that of the newest telemetry when it was
sent. Shapes: N samples or M commands in the order of their stamps. NED, SI.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

# Columns.
SENT_AT, SENT_NORTH, SENT_EAST, SENT_THRUST, SENT_HEADING, COMMAND_WIDTH = 0, 1, 2, 3, 4, 5
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

    def between(self, begin_s: float, end_s: float) -> Trace:
        """Telemetry from `begin_s` to `end_s`, and all commands sent until `end_s`."""
        return Trace(
            self.commands[self.commands[:, SENT_AT] <= end_s],
            *(
                rows[(rows[:, STAMP] >= begin_s) & (rows[:, STAMP] <= end_s)]
                for rows in (self.attitude, self.position)
            ),
        )


def clean(commands: Array, attitude: Array, position: Array) -> Trace:
    """A Trace from rows in the order of arrival. Rows that are not finite or not newer than the one
    before are left out; of commands with one stamp the last is kept."""
    return Trace(
        _latest(_ordered(commands, strictly=False)),
        _ordered(attitude, strictly=True),
        _ordered(position, strictly=True),
    )


def _ordered(rows: Array, *, strictly: bool) -> Array:
    rows = rows[np.isfinite(rows).all(axis=1)]
    if not len(rows):
        return rows
    newest = np.maximum.accumulate(rows[:, 0])
    before = np.concatenate(([-np.inf], newest[:-1]))
    kept: Array = rows[rows[:, 0] > before if strictly else rows[:, 0] >= before]
    return kept


def _latest(rows: Array) -> Array:
    if not len(rows):
        return rows
    kept: Array = rows[np.append(np.diff(rows[:, 0]) > 0.0, True)]
    return kept


SPACING_S = 0.018  # closer samples are left out: motion and responses are slower


def thinned(stamps: Array, spacing_s: float) -> NDArray[np.intp]:
    """Indices of rows at least `spacing_s` apart."""
    kept: list[int] = []
    last = -math.inf
    for row, stamp in enumerate(stamps.tolist()):
        if stamp - last >= spacing_s:
            kept.append(row)
            last = stamp
    return np.array(kept, dtype=np.intp)


class Recorder:
    """The last `kept_s` seconds of a flight, at up to `rate_hz`, in a fixed amount of memory."""

    def __init__(self, *, kept_s: float = 30.0, rate_hz: float = 125.0) -> None:
        rows = math.ceil(kept_s * rate_hz)
        self._commands = _Rows(rows, COMMAND_WIDTH)
        self._attitude = _Rows(rows, ATTITUDE_WIDTH)
        self._position = _Rows(rows, POSITION_WIDTH)

    def on_command(
        self, time_s: float, direction_ne: tuple[float, float], thrust: float, heading_rad: float
    ) -> None:
        """A command sent; `thrust` along the body axis, as a fraction of full throttle."""
        self._commands.add((time_s, *direction_ne, thrust, heading_rad))

    def on_attitude(
        self, time_s: float, direction_ne: tuple[float, float], heading_rad: float
    ) -> None:
        self._attitude.add((time_s, *direction_ne, heading_rad))

    def on_position(
        self,
        time_s: float,
        position_ned_m: tuple[float, float, float],
        velocity_ned_mps: tuple[float, float, float],
    ) -> None:
        self._position.add((time_s, *position_ned_m, *velocity_ned_mps))

    def trace(self, begin_s: float, end_s: float) -> Trace:
        """A copy of what was recorded from `begin_s` to `end_s`, with all commands until then."""
        telemetry = (
            rows[(rows[:, STAMP] >= begin_s) & (rows[:, STAMP] <= end_s)]
            for rows in (self._attitude.kept, self._position.kept)
        )
        return clean(self._commands.kept, *telemetry).between(begin_s, end_s)


class _Rows:
    """The last `capacity` to twice `capacity` rows."""

    def __init__(self, capacity: int, width: int) -> None:
        self._capacity = capacity
        self._rows = np.empty((2 * capacity, width))
        self._count = 0

    @property
    def kept(self) -> Array:
        kept: Array = self._rows[: self._count]
        return kept

    def add(self, row: tuple[float, ...]) -> None:
        if self._count == len(self._rows):
            self._rows[: self._capacity] = self._rows[self._capacity :].copy()
            self._count = self._capacity
        self._rows[self._count] = row
        self._count += 1
