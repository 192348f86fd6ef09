"""Snapshots as JSON: the values that the live page and `--json-lines` have in common."""

from __future__ import annotations

import json
from typing import Any

from offboard.documents.plain import plain
from offboard.flight.display import Snapshot

DIGITS = 9  # of a float


def as_dict(snapshot: Snapshot) -> dict[str, Any]:
    """The fields of a snapshot; what is not known (NaN) is None."""
    values: dict[str, Any] = plain(vars(snapshot), DIGITS)
    return values


def line(kind: str, **values: Any) -> str:
    """One JSON object, without line break; its key `type` says what it is."""
    return json.dumps({"type": kind} | values, allow_nan=False, separators=(",", ":"))
