"""STATUSTEXT cut into its 50-byte chunks and put together from them.

Knows severity, id and chunk number, no more. Twins: what `chunks` cuts, `TextAssembler` joins.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from offboard.mavlink.decode import TextChunk, printable
from offboard.mavlink.events import StatusText
from offboard.mavlink.outgoing import StatusTextOut

_ROOM = 50  # bytes; a chunk that is shorter is the last one
_MOST_CHUNKS, _MOST_PENDING = 20, 8
_PATIENCE_S = 1.0
_GAP = b"[...]"


def chunks(severity: int, text: str, text_id: int) -> list[StatusTextOut]:
    """The messages that say `text`; its end beyond 999 bytes is cut. `text_id`, 1 .. 65535, tells
    texts apart that are under way together."""
    data = text.encode("utf-8")[: _MOST_CHUNKS * _ROOM - 1]
    if len(data) <= _ROOM:
        return [StatusTextOut(severity, data)]
    return [  # one more, empty, where the last one is full
        StatusTextOut(severity, data[at : at + _ROOM], text_id, at // _ROOM)
        for at in range(0, len(data) + 1, _ROOM)
    ]


@dataclass(slots=True)
class _Pending:
    severity: int
    since_s: float
    chunks: dict[int, bytes] = field(default_factory=dict)
    count: int | None = None  # known once the last chunk is here

    def complete(self) -> bool:
        return self.count is not None and len(self.chunks) >= self.count

    def text(self) -> StatusText:
        count = max(self.chunks) + 1 if self.count is None else self.count
        data = b"".join(self.chunks.get(i, _GAP) for i in range(count))
        return StatusText(self.severity, printable(data))


class TextAssembler:
    """Bounded: the oldest unfinished text is given up first, with its gaps marked."""

    def __init__(self) -> None:
        self._pending: dict[int, _Pending] = {}

    def add(self, chunk: TextChunk, now_s: float) -> list[StatusText]:
        """Texts that this chunk completes, or that it makes too old to wait for."""
        done = self.expire(now_s)
        if chunk.text_id == 0 or (chunk.chunk == 0 and chunk.last):
            done.append(StatusText(chunk.severity, printable(chunk.data)))
            return done
        if chunk.chunk >= _MOST_CHUNKS:
            return done
        if chunk.text_id not in self._pending and len(self._pending) >= _MOST_PENDING:
            done.append(self._pending.pop(next(iter(self._pending))).text())
        pending = self._pending.setdefault(chunk.text_id, _Pending(chunk.severity, now_s))
        pending.chunks[chunk.chunk] = chunk.data
        if chunk.last:
            pending.count = chunk.chunk + 1
        if pending.complete():
            done.append(self._pending.pop(chunk.text_id).text())
        return done

    def expire(self, now_s: float) -> list[StatusText]:
        """Texts whose missing chunks have not come within a second."""
        old = [i for i, p in self._pending.items() if now_s - p.since_s > _PATIENCE_S]
        return [self._pending.pop(i).text() for i in old]
