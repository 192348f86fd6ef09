"""Messages of a log by sender and kind, as columns: the vehicle's, and those of `offboard`."""

from __future__ import annotations

import math
from array import array
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from offboard.analysis.tlog import LoggedMessage, columns, layout

Array = NDArray[np.float64]
WRAP_MS = 2**32


class Stream:
    """The messages of one kind from one sender, in the order of arrival.

    With `placed`, for each also its place in the log, its Unix time, and the vehicle time in ms of
    the newest telemetry before it (NaN without).
    """

    def __init__(self, name: str, *, placed: bool = True) -> None:
        self._name = name
        self._size = layout(name).itemsize
        self._payloads = bytearray()
        self._placed = placed
        self.places, self.unix_us, self.now_ms = array("q"), array("q"), array("d")

    def __len__(self) -> int:
        return len(self._payloads) // self._size

    def add(self, entry: LoggedMessage, place: int, now_ms: float) -> None:
        self._payloads += entry.frame.payload[: self._size].ljust(self._size, b"\0")
        if self._placed:
            self.places.append(place)
            self.unix_us.append(entry.unix_us)
            self.now_ms.append(now_ms)

    def columns(self, fields: str, rows: slice = slice(None)) -> Array:
        """(N, columns): the fields of all messages, or of some `rows`, separated by spaces."""
        return columns(self._name, self._payloads, fields, rows)

    def payloads(self) -> Iterator[bytes]:
        for at in range(0, len(self._payloads), self._size):
            yield bytes(self._payloads[at : at + self._size])


def continuous_s(stamps_ms: Array, anchor_ms: float) -> Array:
    """Vehicle time in s from `time_boot_ms`, which begins again at zero after 2^32 ms.

    The result is within 24 days of `anchor_ms`, any stamp of the same log. Stamps that do not wrap
    are put on the same clock.
    """
    if math.isnan(anchor_ms):
        return stamps_ms / 1e3
    away_ms = (stamps_ms - anchor_ms + WRAP_MS / 2) % WRAP_MS - WRAP_MS / 2
    time_s: Array = (anchor_ms + away_ms) / 1e3
    return time_s
