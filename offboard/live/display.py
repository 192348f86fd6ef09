"""What all displays of a flight have in common: a thread that writes, announcements each once,
snapshots when they are due, and both as JSON.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Protocol

from offboard.documents.errors import plain
from offboard.link.background import BackgroundWriter

if TYPE_CHECKING:  # the process that serves clients starts without the controller
    from offboard.flight.display import Snapshot
    from offboard.flight.flight import Flight

DIGITS = 9  # of a float
CLOSE_S = 2.0  # for what is queued, after the flight


class Shown(Protocol):
    """A companion, or the flights of a service."""

    @property
    def current(self) -> Flight: ...
    def snapshot(self) -> Snapshot: ...
    def has_ended(self) -> bool: ...


class Display:
    """Shows a flight. A thread gives texts and snapshots in batches to `write`, so that the loop
    waits for no terminal, pipe or client; at most `size` wait, what does not fit is dropped."""

    LOST = ""  # the sentence on what was dropped, with its number as {}

    def __init__(self, write: Callable[[list[str | Snapshot]], object], size: int) -> None:
        self._writer = BackgroundWriter["str | Snapshot"](write, size)
        self._seen = 0  # announcements
        self._due_s = -math.inf  # of the next snapshot

    def show(self, shown: Shown) -> None:
        """Queue what is new. Called in every turn of the loop."""
        flight = shown.current
        new, self._seen = flight.announcements - self._seen, flight.announcements
        for sentence in flight.announced[-new:] if new else []:
            self._writer.put(self.text(sentence, flight))
        if self.is_due(shown):
            self._writer.put(shown.snapshot())

    def tell(self, sentence: str) -> None:
        """A sentence about the preparation, or the service."""
        self._writer.put(self.text(sentence))

    def text(self, sentence: str, flight: Flight | None = None) -> str:
        """What is written of a sentence, which `flight` may have announced."""
        if flight is None:
            return line("preparation", text=sentence)
        return line("announcement", time_s=round(flight.time_s, 3), text=sentence)

    def is_due(self, shown: Shown) -> bool:
        """Whether to write a snapshot now; the next one is then due later."""
        raise NotImplementedError

    def close(self) -> None:
        """Write what is queued."""
        self._writer.close(CLOSE_S)

    @property
    def lost(self) -> str:
        """A sentence on what was not shown, empty if all was."""
        dropped = 0 if self._writer.error else self._writer.dropped  # nobody misses a closed pipe
        return self.LOST.format(dropped) if dropped else ""


def line(kind: str, **values: Any) -> str:
    """One JSON object, without line break; its key `type` says what it is."""
    return json.dumps({"type": kind} | values, allow_nan=False, separators=(",", ":"))


def json_lines(items: list[str | Snapshot]) -> str:
    """Lines of JSON: texts as they are, the fields of a snapshot; what is not known (NaN) is
    null."""
    lines = (
        item if isinstance(item, str) else line("snapshot", **plain(vars(item), DIGITS))
        for item in items
    )
    return "".join(f"{each}\n" for each in lines)
