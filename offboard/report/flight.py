"""What a report has of one log: arrays, events, score, configuration, and what is missing."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from offboard.analysis import history, tlog
from offboard.analysis.history import History
from offboard.analysis.samples import Rows
from offboard.analysis.score import Score, score
from offboard.analysis.verdict import begin_times
from offboard.report.substitutes import completed

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
    flown, notes = completed(flown, log)
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
    """Names of the parts, from the configuration in the log."""
    try:
        document: Any = yaml.safe_load(text or "")
        return {part: str(document[part][key]) for part, key in _PARTS.items()}
    except (yaml.YAMLError, KeyError, TypeError):
        return {}
