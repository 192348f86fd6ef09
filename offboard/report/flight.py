"""What a report has of one log: arrays, events, score, configuration, and what is missing.

Ground stations often record ATTITUDE and GLOBAL_POSITION_INT without ATTITUDE_QUATERNION and
LOCAL_POSITION_NED, and the setpoint in force only as the vehicle reports it (ATTITUDE_TARGET): they
are the substitutes in a log that `offboard` has not written.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from offboard.analysis import history, tlog
from offboard.analysis.history import SETPOINT, Columns, History, Rows, Samples, table
from offboard.analysis.score import Score, score
from offboard.analysis.tlog import Tlog
from offboard.analysis.verdict import begin_times
from offboard.model.frames import quaternion_from_euler
from offboard.model.geodesy import Geodetic, position_ned_m

_PARTS = {"controller": "law", "reference": "shape", "vehicle": "name"}  # key that names each
_NO_HEARTBEAT = "no HEARTBEAT of an autopilot: no telemetry used"
_NO_RECORDS = (
    "no records of offboard: no reference, decisions, identification or figures of the score"
)


@dataclass(frozen=True, slots=True)
class Flight:
    """One log. `facts` are name and value; `missing` has a sentence for each thing that the log
    lacks; `engage_mode` is the mode of setpoints, empty for an unknown autopilot. `sent` is the
    history without substitutes: its setpoints are those that were sent."""

    name: str
    history: History
    sent: History
    score: Score
    facts: dict[str, str]
    missing: tuple[str, ...]
    engage_mode: str = ""

    @property
    def track_s(self) -> float:
        """Vehicle time at which the track began; otherwise of the take-off, or of the first
        sample."""
        begun = begin_times(self.history.phases)
        return begun.get("track", begun.get("takeoff", self.begin_s))

    @property
    def begin_s(self) -> float:
        return min((rows["time_s"][0] for rows in self._samples if len(rows)), default=0.0)

    @property
    def end_s(self) -> float:
        return max((rows["time_s"][-1] for rows in self._samples if len(rows)), default=0.0)

    @property
    def _samples(self) -> tuple[Rows, ...]:
        return self.history.position, self.history.attitude, self.history.setpoint


def read(path: Path) -> Flight:
    """Read a flight directory or a .tlog file. Raises TlogError."""
    log = tlog.read(tlog.find(path))
    flown = history.gather(log)
    missing = [_NO_HEARTBEAT] if flown.vehicle is None else []
    if not len(flown.records):
        missing.append(_NO_RECORDS)
    sent = flown
    flown, notes = _completed(flown, log)
    if flown.damage:
        at = "" if math.isnan(flown.damage_s) else f", at {flown.damage_s:.2f} s of vehicle time"
        notes.append(f"damaged log: {flown.damage}{at}")
    if log.truncated:
        notes.append(
            f"the log ends within an entry, at byte {log.path.stat().st_size - log.truncated}"
        )
    facts = {
        "log": str(log.path),
        "begun": f"{np.datetime64(next(iter(log)).unix_us, 'us').item():%Y-%m-%d %H:%M:%S} UTC",
        "autopilot": flown.dialect.name if flown.dialect else "unknown",
        **_configured(history.configuration(log)),
        "messages": f"{flown.messages.total()} in {flown.wall_s:.1f} s of computer time",
    }
    return Flight(
        path.name or path.resolve().name, flown, sent, score(flown), facts, (*missing, *notes),
        flown.dialect.engage_mode if flown.dialect else "",
    )  # fmt: skip


def _configured(text: str | None) -> dict[str, str]:
    """Names of the parts, from the configuration in the log; of a table that of its file."""
    try:
        document: Any = yaml.safe_load(text or "")
        parts = ((part, document[part], key) for part, key in _PARTS.items())
        return {name: str(part.get("file", part[key])) for name, part, key in parts}
    except (yaml.YAMLError, AttributeError, KeyError, TypeError):
        return {}


# ---------------------------------------------------------------------- substitutes


def _completed(flown: History, log: Tlog) -> tuple[History, list[str]]:
    """The history with substitutes for telemetry that it lacks, and a sentence for each thing that
    was replaced or is missing."""
    found = {
        name: Samples(name, columns)
        for name, (part, columns, *_) in _SUBSTITUTES.items()
        if not len(getattr(flown, part))
    }
    if not found:
        return flown, []
    for entry in log:
        if entry.name in found and (entry.system_id, entry.component_id) == flown.vehicle:
            found[entry.name].add(entry.frame.payload, math.nan, entry.unix_us / 1e6)
    anchor_ms = 1e3 * next(
        (rows["time_s"][0] for rows in (flown.attitude, flown.position) if len(rows)), math.nan
    )
    used: dict[str, Any] = {}
    notes = []
    for name, samples in found.items():
        part, _, convert, missing, replaced = _SUBSTITUTES[name]
        rows = samples.rows(anchor_ms)
        notes.append(replaced if len(rows) else missing)
        if len(rows):
            used[part] = convert(rows)
    return replace(flown, **used), notes


def _attitude(rows: Rows) -> Rows:
    quaternion = quaternion_from_euler(*rows["angles"].astype(np.float64).T)
    return table(
        rows,
        quaternion=np.asarray(quaternion, np.float32),
        rates_radps=rows["rates_radps"],
    )


def _position(rows: Rows) -> Rows:
    """Relative to the first position. Latitude and longitude in 1e-7 deg, mm, cm/s."""
    places = rows["place"] / (1e7, 1e7, 1e3)
    position = position_ned_m(places, Geodetic(*places[0].tolist()))
    return table(
        rows,
        position_ned_m=position.astype(np.float32),
        velocity_ned_mps=(rows["velocity"] / 100.0).astype(np.float32),
    )


# message -> the array of History that it replaces, its columns, their conversion, and what to say
# without the message and with it
_SUBSTITUTES: dict[str, tuple[str, Columns, Callable[[Rows], Rows], str, str]] = {
    "ATTITUDE": (
        "attitude",
        {"angles": ("roll", 3), "rates_radps": ("rollspeed", 3)},
        _attitude,
        "no attitude (ATTITUDE_QUATERNION, ATTITUDE)",
        "no ATTITUDE_QUATERNION: the attitude is that of ATTITUDE",
    ),
    "GLOBAL_POSITION_INT": (
        "position",
        {"place": ("lat", 3), "velocity": ("vx", 3)},
        _position,
        "no position (LOCAL_POSITION_NED, GLOBAL_POSITION_INT)",
        "no LOCAL_POSITION_NED: positions are of GLOBAL_POSITION_INT, relative to the first one",
    ),
    "ATTITUDE_TARGET": (
        "setpoint",
        SETPOINT,
        lambda rows: rows,
        "no setpoints (SET_ATTITUDE_TARGET of offboard, ATTITUDE_TARGET)",
        "no setpoints of offboard: the commanded attitude is the vehicle's ATTITUDE_TARGET",
    ),
}
