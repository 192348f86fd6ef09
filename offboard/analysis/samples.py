"""Samples of a flight as structured arrays: what is kept of each message, and time weights.

A field of an array is a column; `time_s` is vehicle time in float64, values are float32, as they
are on the wire. Messages are converted in blocks as they are read, so that only what is kept takes
memory.
"""

from __future__ import annotations

import math
from array import array
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from offboard.analysis.tlog import columns, layout

Array = NDArray[np.float64]
Rows = NDArray[np.void]
WRAP_MS = 2**32
BLOCK = 8192  # messages that are converted at once
_BISECTIONS = 50
BOOT_MS, BOOT_US = ("time_boot_ms", 1.0), ("time_usec", 1e-3)  # stamps of messages, in ms


@dataclass(frozen=True, slots=True)
class Wire:
    """A message: its name, the fields of each column, and its stamp (`BOOT_MS` or `BOOT_US`); None
    where a sample has the time of the telemetry before it."""

    name: str
    fields: Mapping[str, str]
    stamp: tuple[str, float] | None = BOOT_MS


class Samples:
    """Rows in the order of arrival. `dtype` begins with `time_s`; a column that a message does not
    have is NaN."""

    def __init__(self, dtype: DTypeLike) -> None:
        self._dtype = np.dtype(dtype)
        self._rows = bytearray()
        self._wire: Wire | None = None  # of the messages that wait for their conversion
        self._payloads = bytearray()
        self._now_ms, self._unix_s = array("d"), array("d")

    def add(self, wire: Wire, payload: bytes, now_ms: float, unix_s: float) -> None:
        """A message. `now_ms`: stamp of the telemetry before it, NaN without. `unix_s`: of its
        entry in the log."""
        if wire is not self._wire or len(self._now_ms) >= BLOCK:
            self.convert()
            self._wire = wire
        size = layout(wire.name).itemsize
        self._payloads += payload[:size].ljust(size, b"\0")
        self._now_ms.append(now_ms)
        self._unix_s.append(unix_s)

    def convert(self) -> None:
        """Convert the messages that wait."""
        wire = self._wire
        if wire is None or not self._now_ms:
            return
        rows = np.full(len(self._now_ms), math.nan, self._dtype)
        rows["time_s"] = self._now_ms  # in ms until `rows`
        if wire.stamp:
            name, unit_ms = wire.stamp
            rows["time_s"] = unit_ms * columns(wire.name, self._payloads, name)[:, 0]
        if "unix_s" in rows.dtype.names:
            rows["unix_s"] = self._unix_s
        self.fill(rows, wire, self._payloads)
        self._rows += rows.tobytes()
        self._payloads, self._now_ms, self._unix_s = bytearray(), array("d"), array("d")

    def fill(self, rows: Rows, wire: Wire, payloads: bytearray) -> None:
        """Fill the columns of a block with the fields of its messages; of an array field as many
        elements as the column has."""
        for column, fields in wire.fields.items():
            values, shape = columns(wire.name, payloads, fields), rows[column].shape
            rows[column] = values[:, : math.prod(shape[1:])].reshape(shape)

    def rows(self, anchor_ms: float) -> Rows:
        """All rows, their times continued (see `continuous_s`). Nothing can be added afterwards."""
        self.convert()
        rows: Rows = np.frombuffer(self._rows, self._dtype)
        rows["time_s"] = continuous_s(rows["time_s"], anchor_ms)
        return rows


def continuous_s(stamps_ms: Any, anchor_ms: float) -> Any:
    """Vehicle time in s from `time_boot_ms`, which begins again at zero after 2^32 ms.

    The result is within 24 days of `anchor_ms`, any stamp of the same log. Stamps that do not wrap
    are put on the same clock.
    """
    if math.isnan(anchor_ms):
        return stamps_ms / 1e3
    away_ms = (stamps_ms - anchor_ms + WRAP_MS / 2) % WRAP_MS - WRAP_MS / 2
    return (anchor_ms + away_ms) / 1e3


def each_once(rows: Rows) -> Rows:
    """Rows sorted by time, the first one of equal times."""
    if (np.diff(rows["time_s"]) > 0.0).all():
        return rows
    return rows[np.unique(rows["time_s"], return_index=True)[1]]


def blocks(count: int) -> Iterator[slice]:
    """Parts of an array of hours: what is computed of one takes little memory."""
    return (slice(first, first + BLOCK) for first in range(0, count, BLOCK))


@dataclass(frozen=True, slots=True)
class Weighted:
    """Metrics of one signal; `p95` is not exceeded for 95 % of the time. NaN without samples."""

    mean: float = math.nan
    rms: float = math.nan
    sd: float = math.nan
    max: float = math.nan
    p95: float = math.nan


def weighted(values: Array, weights: Array) -> Weighted:
    """Metrics of samples (N,) with the time (N,) for which each stands; those that stand for none
    do not count."""
    total = float(weights.sum())
    if not total:
        return Weighted()
    mean, square = (
        float(weights @ values / total),
        float(np.einsum("i,i,i", weights, values, values) / total),
    )
    greatest = float(np.max(values, where=weights > 0.0, initial=-math.inf))
    return Weighted(
        mean=mean,
        rms=math.sqrt(square),
        sd=math.sqrt(max(square - mean**2, 0.0)),
        max=greatest,
        p95=_quantile(values, weights, 0.95 * total),
    )


def _quantile(values: Array, weights: Array, share: float) -> float:
    """The least value such that those up to it have the weight `share`. By bisection: to sort the
    samples of hours takes several times their memory."""
    low, high = float(values.min()), float(values.max())
    for _ in range(_BISECTIONS):
        middle = 0.5 * (low + high)
        if np.sum(weights, where=values <= middle) >= share:
            high = middle
        else:
            low = middle
    return high
