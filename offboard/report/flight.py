"""The data of one log for a report: arrays, events, score, configuration, and what is missing."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from offboard.analysis import history, tlog
from offboard.analysis.columns import Rows
from offboard.analysis.history import History
from offboard.analysis.page import BLUE
from offboard.analysis.score import Score, score
from offboard.analysis.verdict import begin_times

_PARTS = {"controller": "law", "reference": "shape", "vehicle": "name"}  # part -> key of its name
_NO_HEARTBEAT = "no HEARTBEAT of an autopilot: no telemetry used"
_NO_RECORDS = (
    "no records of offboard: no reference, decisions, identification or metrics of the score"
)
# array of History, what it contains, usual message, substitute message, remark on the substitute
_TELEMETRY = (
    ("attitude", "attitude", "ATTITUDE_QUATERNION", "ATTITUDE", ""),
    ("position", "position", "LOCAL_POSITION_NED", "GLOBAL_POSITION_INT",
     ", relative to the first one"),
    ("commanded", "commanded attitude", "SET_ATTITUDE_TARGET of offboard", "ATTITUDE_TARGET", ""),
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class Flight:
    """One log. `facts` are rows of name and value; `missing` has a sentence for each kind of data
    that the log lacks; `configuration` is that of `history.configuration`. `letter`, `colour` and
    `dash` distinguish it from other flights of the same report; `zero_s` is the vehicle time at
    zero of the time axis."""

    name: str
    history: History
    score: Score
    facts: dict[str, str]
    missing: tuple[str, ...]
    configuration: str | None
    letter: str = ""
    colour: str = BLUE
    dash: str = "solid"
    zero_s: float = 0.0

    @property
    def label(self) -> str:
        """Letter and name; empty if the report has only this flight."""
        return f"{self.letter}: {self.name}" if self.letter else ""

    @property
    def track_s(self) -> float:
        """Vehicle time at which TRACK first began; without it that of the takeoff, or else of the
        first sample."""
        begun = begin_times(self.history.phases[::-1])
        return begun.get("track", begun.get("takeoff", self.begin_s))

    @property
    def begin_s(self) -> float:
        return min((rows["time_s"][0] for rows in self._samples if len(rows)), default=0.0)

    @property
    def end_s(self) -> float:
        return max((rows["time_s"][-1] for rows in self._samples if len(rows)), default=0.0)

    @property
    def _samples(self) -> tuple[Rows, ...]:
        return self.history.position, self.history.attitude, self.history.commanded


def read(path: Path) -> Flight:
    """Read a flight directory or a .tlog file. Raises UserError."""
    log = tlog.read(path)
    flown = history.gather(log)
    missing = [_NO_HEARTBEAT] if flown.vehicle is None else []
    if not len(flown.records):
        missing.append(_NO_RECORDS)
    for array, what, usual, substitute, how in _TELEMETRY:
        if not len(getattr(flown, array)):
            missing.append(f"no {what}: neither {usual} nor {substitute}")
        elif substitute in flown.substitutes:
            missing.append(f"no {usual}: the {what} is that of {substitute}{how}")
    if flown.unread:
        at = "" if math.isnan(flown.damaged_s) else f", at {flown.damaged_s:.2f} s of vehicle time"
        missing.append(f"{flown.unread}{at}")
    if log.truncated:
        missing.append(
            f"the log ends within an entry, at byte {log.path.stat().st_size - log.truncated}"
        )
    configuration = history.configuration(log)
    facts = {
        "log": str(log.path),
        "begun": f"{np.datetime64(next(iter(log)).unix_us, 'us').item():%Y-%m-%d %H:%M:%S} UTC",
        "autopilot": flown.dialect.name if flown.dialect else "unknown",
        **_configured(configuration),
        "messages": f"{flown.messages.total()} in {flown.wall_s:.1f} s of computer time",
    }
    name = path.name or path.resolve().name
    return Flight(name, flown, score(flown), facts, tuple(missing), configuration)


def _configured(text: str | None) -> dict[str, str]:
    """Return the names of controller, reference and vehicle from the configuration in the log. The
    name of a reference given as a table is that of its file."""
    try:
        document: Any = yaml.safe_load(text or "")
        parts = ((part, document[part], key) for part, key in _PARTS.items())
        return {name: str(part.get("file", part[key])) for name, part, key in parts}
    except (yaml.YAMLError, AttributeError, KeyError, TypeError):
        return {}
