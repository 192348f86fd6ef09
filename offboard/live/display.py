"""The base of all displays of a flight: a thread that writes each announcement once and snapshots
when they are due, and the JSON text of both.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Protocol

from offboard.documents.errors import plain
from offboard.link.background import BackgroundWriter

if TYPE_CHECKING:  # not imported at run time: the server of the page does not load the controller
    from offboard.flight.display import Snapshot
    from offboard.flight.flight import Flight

DIGITS = 9  # significant digits of a float
CLOSE_S = 2.0  # time to write what is queued after the flight


class Shown(Protocol):
    """What a display shows: a `Flight`, or the flights of a service."""

    @property
    def current(self) -> Flight: ...
    def snapshot(self) -> Snapshot: ...
    def has_ended(self) -> bool: ...


class Display:
    """Shows a flight. A thread gives texts and snapshots in batches to `write`, so that the loop
    never waits for a terminal, pipe or client. At most `size` items wait; further ones are dropped.
    """

    LOST = ""  # sentence about dropped items; {} is their number

    def __init__(self, write: Callable[[list[str | Snapshot]], object], size: int) -> None:
        self._writer = BackgroundWriter["str | Snapshot"](write, size)
        self._seen = 0  # number of announcements that were queued
        self._due_s = -math.inf  # time of the next snapshot

    def show(self, shown: Shown) -> None:
        """Queue new announcements, and a snapshot if due. Called in every turn of the loop."""
        flight = shown.current
        new, self._seen = flight.announcements - self._seen, flight.announcements
        for sentence in flight.announced[-new:] if new else []:
            self._writer.put(self.text(sentence, flight))
        if self.is_due(shown):
            self._writer.put(shown.snapshot())

    def tell(self, sentence: str) -> None:
        """Queue a sentence about the preparation, or about the service."""
        self._writer.put(self.text(sentence))

    def text(self, sentence: str, flight: Flight | None = None) -> str:
        """Return the text to write for a sentence. `flight` has announced it, or is None."""
        if flight is None:
            return line("preparation", text=sentence)
        return line("announcement", time_s=round(flight.time_s, 3), text=sentence)

    def is_due(self, shown: Shown) -> bool:
        """Whether to write a snapshot now. If so, also set when the next one is due."""
        raise NotImplementedError

    def close(self) -> None:
        """Write what is queued."""
        self._writer.close(CLOSE_S)

    @property
    def lost(self) -> str:
        """A sentence that says what was not shown; empty if all was."""
        # after an error, such as a closed pipe, nobody reads the items
        dropped = 0 if self._writer.error else self._writer.dropped
        return self.LOST.format(dropped) if dropped else ""


def line(kind: str, **values: Any) -> str:
    """Return a JSON object with the key `type` set to `kind`, without line break."""
    return json.dumps({"type": kind} | values, allow_nan=False, separators=(",", ":"))


def json_lines(items: list[str | Snapshot]) -> str:
    """Return lines of JSON: texts unchanged, snapshots as their fields with null for NaN."""
    lines = (
        item if isinstance(item, str) else line("snapshot", **plain(vars(item), DIGITS))
        for item in items
    )
    return "".join(f"{each}\n" for each in lines)
