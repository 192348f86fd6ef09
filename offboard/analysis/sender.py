"""The messages of a log sorted by who sent them: the vehicle, or `offboard`; and vehicle time."""

from __future__ import annotations

import math
from collections.abc import Callable
from operator import itemgetter

import numpy as np
from numpy.typing import NDArray

from offboard.analysis.tlog import LoggedMessage, Tlog, columns, name_of

Array = NDArray[np.float64]
# (system, component, message id) -> (place in the log, message), in order
Streams = dict[tuple[int, int, int], list[tuple[int, LoggedMessage]]]


def streams_of(log: Tlog) -> Streams:
    """The messages of a log, each with its place in it, by sender and kind."""
    streams: Streams = {}
    for place, entry in enumerate(log.messages):
        frame = entry.frame
        key = frame.system_id, frame.component_id, frame.message_id
        streams.setdefault(key, []).append((place, entry))
    return streams


class Sender:
    """The messages of one side of the link. `sent(system, component)` is True for that side."""

    def __init__(self, streams: Streams, sent: Callable[[int, int], bool]) -> None:
        self._kinds: dict[str, list[tuple[int, LoggedMessage]]] = {}
        for (system, component, kind), stream in streams.items():
            if sent(system, component):
                self._kinds.setdefault(name_of(kind), []).extend(stream)
        for stream in self._kinds.values():
            stream.sort(key=itemgetter(0))

    def of(self, name: str) -> list[tuple[int, LoggedMessage]]:
        """(place, message) of all messages of that name."""
        return self._kinds.get(name, [])

    def places(self, name: str) -> NDArray[np.intp]:
        return np.array([place for place, _ in self.of(name)], dtype=np.intp)

    def columns(self, name: str, fields: str) -> Array:
        """(N, columns): the fields of all messages of that name."""
        return columns(name, [entry for _, entry in self.of(name)], fields)

    def table(self, name: str, fields: str) -> Array:
        """As `columns`, with the vehicle time in seconds as first column."""
        rows = self.columns(name, f"time_boot_ms {fields}")
        rows[:, 0] /= 1e3
        return rows


class VehicleClock:
    """Vehicle time at a place in the log: that of the newest telemetry before it."""

    def __init__(self, vehicle: Sender) -> None:
        names = ("LOCAL_POSITION_NED", "ATTITUDE_QUATERNION")
        places = np.concatenate([vehicle.places(name) for name in names])
        times = np.concatenate([vehicle.table(name, "")[:, 0] for name in names])
        order = np.argsort(places)
        self._places, self._times = places[order], np.append(math.nan, times[order])

    def at(self, places: NDArray[np.intp]) -> Array:
        """(N,) seconds, NaN before any telemetry."""
        times: Array = self._times[np.searchsorted(self._places, places)]
        return times
