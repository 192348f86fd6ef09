"""Snapshots as JSON: the values that the live page and `--json-lines` have in common."""

from __future__ import annotations

import json
from dataclasses import asdict, fields
from typing import Any

from offboard.documents.plain import plain
from offboard.flight.snapshot import Snapshot

DIGITS = 9  # of a float
_SCALARS = {"float": "number", "int": "integer", "str": "string", "bool": "boolean"}


def as_dict(snapshot: Snapshot) -> dict[str, Any]:
    """The fields of a snapshot; what is not known (NaN) is None."""
    values: dict[str, Any] = plain(asdict(snapshot), DIGITS)
    return values


def json_schema() -> dict[str, Any]:
    """JSON Schema of a snapshot, without the null of what is not known: viewers read no unions."""
    properties: dict[str, Any] = {"type": {"type": "string"}}
    for field in fields(Snapshot):
        scalar, item = _SCALARS.get(str(field.type)), "string" if "str" in field.type else "number"
        array = {"type": "array", "items": {"type": item}}
        properties[field.name] = {"type": scalar} if scalar else array
    return {"title": "offboard.Snapshot", "type": "object", "properties": properties}


def line(kind: str, **values: Any) -> str:
    """One JSON object, without line break; its key `type` says what it is."""
    return json.dumps({"type": kind} | values, allow_nan=False, separators=(",", ":"))
