"""STATUSTEXT: splits long texts into chunks of 50 bytes, and joins received chunks."""

from __future__ import annotations

from dataclasses import dataclass, field

from pymavlink.dialects.v20 import all as mavlink

from offboard.mavlink.decode import printable
from offboard.mavlink.events import StatusText
from offboard.mavlink.outgoing import StatusTextOut

_CHUNK_BYTES = 50  # a shorter chunk is the last one of its text
_CHUNKS_MAX, _PENDING_MAX = 20, 8
_CHUNK_TIMEOUT_S = 1.0
_GAP = b"[...]"  # in place of a missing chunk


def chunks(severity: int, text: str, text_id: int) -> list[StatusTextOut]:
    """Split `text`, of which at most 999 bytes are sent, into messages.

    `text_id`, 1 .. 65535, must differ between texts whose chunks may mix on the link.
    """
    data = text.encode("utf-8", "replace")[: _CHUNKS_MAX * _CHUNK_BYTES - 1]
    if len(data) <= _CHUNK_BYTES:
        return [StatusTextOut(severity, data)]
    return [  # if the last chunk is full, an empty one marks the end
        StatusTextOut(severity, data[at : at + _CHUNK_BYTES], text_id, at // _CHUNK_BYTES)
        for at in range(0, len(data) + 1, _CHUNK_BYTES)
    ]


@dataclass(slots=True)
class _Pending:
    severity: int
    since_s: float
    chunks: dict[int, bytes] = field(default_factory=dict)
    count: int | None = None  # known once the last chunk has arrived

    def text(self) -> StatusText:
        count = max(self.chunks) + 1 if self.count is None else self.count
        data = b"".join(self.chunks.get(i, _GAP) for i in range(count))
        return StatusText(self.severity, printable(data))


class TextAssembler:
    """Joins received chunks. If too many texts are incomplete, the oldest is returned with gaps."""

    def __init__(self) -> None:
        self._pending: dict[int, _Pending] = {}

    def add(self, payload: bytes, now_s: float) -> list[StatusText]:
        """Add the payload of a STATUSTEXT. Returns the texts that it completes, and those whose
        time is over."""
        # pymavlink would decode the text as ASCII
        layout = mavlink.MAVLink_statustext_message.unpacker
        severity, text, text_id, chunk = layout.unpack_from(payload.ljust(layout.size, b"\0"))
        data, terminator, _ = text.partition(b"\0")
        done = self.expire(now_s)
        if text_id == 0 or (chunk == 0 and terminator):
            return [*done, StatusText(severity, printable(data))]
        if chunk >= _CHUNKS_MAX:
            return done
        if text_id not in self._pending and len(self._pending) >= _PENDING_MAX:
            done.append(self._pending.pop(next(iter(self._pending))).text())
        pending = self._pending.setdefault(text_id, _Pending(severity, now_s))
        pending.chunks[chunk] = data
        if terminator:
            pending.count = chunk + 1
        if pending.count is not None and len(pending.chunks) >= pending.count:
            done.append(self._pending.pop(text_id).text())
        return done

    def expire(self, now_s: float) -> list[StatusText]:
        """Return, with gaps, the texts whose missing chunks have not arrived within a second."""
        old = [i for i, p in self._pending.items() if now_s - p.since_s > _CHUNK_TIMEOUT_S]
        return [self._pending.pop(i).text() for i in old]
