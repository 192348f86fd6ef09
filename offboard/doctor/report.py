"""A report as JSON: rows of checks with their findings."""

from __future__ import annotations

import json
from collections.abc import Sequence

from offboard.doctor.findings import Finding, Level, Row, worst
from offboard.doctor.observation import Observation


def as_json(rows: Sequence[Row], seen: Observation, verdict: str) -> str:
    """One object with the worst level, the verdict, what was observed where, and a list of rows."""
    found, version = seen.vehicle.found, seen.vehicle.version
    document = {
        "level": name(worst(rows)),
        "verdict": verdict,
        "connection": seen.connection,
        "listened_s": round(seen.listened_s, 2),
        "vehicle": found and {"autopilot": found.autopilot, "system_id": found.system_id},
        "version": version and [version.major, version.minor, version.patch],
        "rows": [
            {
                "check": row.check,
                "level": name(row.level),
                "findings": [_finding(each) for each in row.findings],
            }
            for row in rows
        ],
    }
    return json.dumps(document, indent=2, ensure_ascii=False) + "\n"


def _finding(finding: Finding) -> dict[str, str]:
    return {"level": name(finding.level), "found": finding.found, "hint": finding.hint}


def name(level: Level) -> str:
    return level.name.lower()
