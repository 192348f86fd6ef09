"""Snapshots as JSON: the values that the live page and `--json-lines` have in common."""

from __future__ import annotations

import json
import math
from dataclasses import asdict
from typing import Any

from offboard.flight.snapshot import Snapshot


def as_dict(snapshot: Snapshot) -> dict[str, Any]:
    """The fields of a snapshot; what is not known (NaN) is None."""
    return {name: plain(value) for name, value in asdict(snapshot).items()}


def line(kind: str, **values: Any) -> str:
    """One JSON object, without line break; its key `type` says what it is."""
    return json.dumps({"type": kind} | values, allow_nan=False, separators=(",", ":"))


def plain(value: Any) -> Any:
    """A value for JSON: floats with nine digits, None for what is not finite."""
    if isinstance(value, float):
        return float(f"{value:.9g}") if math.isfinite(value) else None
    return [plain(each) for each in value] if isinstance(value, tuple) else value
