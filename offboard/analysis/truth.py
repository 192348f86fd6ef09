"""True positions of a simulated vehicle, as it reports them."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
from numpy.typing import NDArray

from offboard.analysis.sender import Stream
from offboard.model.geodesy import Geodetic, origin_of, position_ned_m

Array = NDArray[np.float64]
_SCALE = (1e7, 1e7, 1e3)  # of latitude, longitude and altitude


def true_positions(streams: Mapping[str, Stream], time_s: Callable[[Array], Array]) -> Array:
    """(N, 4): time, north, east, down, from the first known origin of the local frame on.

    `streams`: the vehicle's messages by name. `time_s` gives the time of stamps in ms.
    """
    hil, state = streams["HIL_STATE_QUATERNION"], streams["SIM_STATE"]
    given = hil.columns("time_usec lat lon alt") / (1e3, *_SCALE)
    without_stamp = state.columns("lat_int lon_int alt") / (1e7, 1e7, 1.0)
    rows = np.vstack((given, np.insert(without_stamp, 0, 0.0, axis=1)))
    places = np.concatenate((hil.places, state.places))
    now_ms = np.concatenate((hil.now_ms, state.now_ms))
    rows[:, 0] = time_s(np.where(rows[:, 0] > 0.0, rows[:, 0], now_ms))
    origins = _origins(streams["GPS_GLOBAL_ORIGIN"], streams["HOME_POSITION"])
    newest = np.searchsorted([place for place, _ in origins], places)
    known = np.flatnonzero(newest)
    known = known[np.argsort(places[known])]
    positions = [
        position_ned_m(Geodetic(*rows[row, 1:].tolist()), origins[newest[row] - 1][1])
        for row in known
    ]
    return np.column_stack((rows[known, 0], np.reshape(positions, (-1, 3))))


def _origins(given: Stream, home: Stream) -> list[tuple[int, Geodetic]]:
    """(place in the log, origin of the local frame). HOME_POSITION gives one point in both
    frames."""
    places = (given.columns("latitude longitude altitude") / _SCALE).tolist()
    homes = home.columns("latitude longitude altitude x y z") / (*_SCALE, 1.0, 1.0, 1.0)
    origins = [(at, Geodetic(*place)) for at, place in zip(given.places, places, strict=True)]
    for at, (*place, north, east, down) in zip(home.places, homes.tolist(), strict=True):
        origins.append((at, origin_of(Geodetic(*place), (north, east, down))))
    return sorted(origins)
