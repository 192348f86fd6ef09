"""The log's record of an event: a phase that begins, or another sentence of ours.

An event is a JSON text in TUNNEL messages of our record component, in numbered pieces that follow
each other. `pieces` splits an event, `join` restores all of a log.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Iterable, Iterator
from typing import NamedTuple

from offboard.mavlink.outgoing import PIECE_BYTES, ConfigurationRecord

EVENT_TYPE = 0xC0F4  # TUNNEL.payload_type; numbers above 32767 need no registration
SUPERVISOR = "supervisor"  # the cause of what the supervisor says
_HEAD = struct.Struct("<BB")  # index of the piece, number of pieces
_TEXT_MOST = 2000  # characters


class EventRecord(NamedTuple):
    """`phase`: number of the phase that begins (`flight.phases.Phase`), None for another
    event. `cause`: a word for what caused it, empty without one."""

    text: str
    phase: int | None = None
    cause: str = ""


def pieces(event: EventRecord) -> list[ConfigurationRecord]:
    """The messages that hold an event."""
    data = json.dumps(event._replace(text=event.text[:_TEXT_MOST])).encode()
    return numbered(data, _HEAD, EVENT_TYPE)


def numbered(data: bytes, head: struct.Struct, payload_type: int) -> list[ConfigurationRecord]:
    """Records that hold `data`, each piece after a `head` with its index and their number."""
    size = PIECE_BYTES - head.size
    parts = [data[at : at + size] for at in range(0, len(data), size)]
    return [
        ConfigurationRecord(head.pack(index, len(parts)) + part, payload_type)
        for index, part in enumerate(parts)
    ]


def join(payloads: Iterable[bytes]) -> Iterator[tuple[int, EventRecord]]:
    """The events in the payloads of TUNNEL messages, each with the index of its last payload.
    Those that are damaged, or of which a piece is missing, are left out."""
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
