"""The log's record of an event: the beginning of a phase, or another announcement.

An event is logged as JSON text in consecutive, numbered TUNNEL messages of our record component.
`pieces` splits one event; `join` restores all events of a log.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Iterable, Iterator
from typing import NamedTuple

from offboard.mavlink.outgoing import PIECE_BYTES, ConfigurationRecord

EVENT_TYPE = 0xC0F4  # TUNNEL.payload_type; numbers above 32767 need no registration
SUPERVISOR = "supervisor"  # `cause` of the sentences of the supervisor
_HEAD = struct.Struct("<BB")  # index of the piece, number of pieces
_TEXT_MOST = 2000  # characters


class EventRecord(NamedTuple):
    """An event. `phase` is the number of the phase that begins (`flight.phases.Phase`), None for
    another event; `cause` is a word for the cause, or empty."""

    text: str
    phase: int | None = None
    cause: str = ""


def pieces(event: EventRecord) -> list[ConfigurationRecord]:
    """Split an event into records for the log; its text is cut at 2000 characters."""
    data = json.dumps(event._replace(text=event.text[:_TEXT_MOST])).encode()
    return numbered(data, _HEAD, EVENT_TYPE)


def numbered(data: bytes, head: struct.Struct, payload_type: int) -> list[ConfigurationRecord]:
    """Split `data` into records. Each begins with a `head`: its index and the number of records."""
    size = PIECE_BYTES - head.size
    parts = [data[at : at + size] for at in range(0, len(data), size)]
    return [
        ConfigurationRecord(head.pack(index, len(parts)) + part, payload_type)
        for index, part in enumerate(parts)
    ]


def join(payloads: Iterable[bytes]) -> Iterator[tuple[int, EventRecord]]:
    """Restore the events from the payloads of TUNNEL messages; each comes with the index of its
    last payload. Events that are damaged or lack a piece are left out."""
    parts: list[bytes] = []
    for number, payload in enumerate(payloads):
        if len(payload) < _HEAD.size:
            continue
        index, count = _HEAD.unpack_from(payload)
        parts = [*parts[:index], payload[_HEAD.size :]]
        if len(parts) != index + 1 or len(parts) < count:
            continue
        event = _event(b"".join(parts))
        if event:
            yield number, event


def _event(data: bytes) -> EventRecord | None:
    try:
        text, phase, cause = json.loads(data)
    except (ValueError, TypeError):
        return None
    known = phase is None or isinstance(phase, int)
    valid = known and isinstance(text, str) and isinstance(cause, str)
    return EventRecord(text, phase, cause) if valid else None
