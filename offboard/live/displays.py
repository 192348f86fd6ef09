"""All displays of one flight as one: a display that fails takes no other one with it."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress

from offboard.flight.flight import Flight
from offboard.live.display import Display
from offboard.live.lines import JsonLines, Terminal
from offboard.live.process import LiveProcess


class Displays:
    """The lines of a flight, and the processes that serve clients. Their `show` is called in every
    turn of the loop and must not wait; one whose `show` raises is not called again."""

    def __init__(self, lines: Terminal | JsonLines, pages: Sequence[LiveProcess] = ()) -> None:
        self._lines, self._pages = lines, pages
        self._parts: list[Display] = [lines, *pages]
        self._working = list(self._parts)

    def await_ready(self) -> list[str]:
        """Wait until all processes listen; where. Raises UserError."""
        return [page.await_ready() for page in self._pages]

    def tell(self, sentence: str) -> None:
        """A sentence about the preparation."""
        self._lines.tell(sentence)

    def title(self, title: str) -> None:
        """What is flown, for the pages."""
        for page in self._pages:
            page.tell(title=title)

    def conclude(self, verdict: str, report: str) -> None:
        """How the flight ended, and where its report will be, for the pages."""
        for page in self._pages:
            page.tell(verdict=verdict, report=report)

    def show(self, companion: Flight) -> None:
        for part in tuple(self._working):
            try:
                part.show(companion)
            except (Exception, SystemExit):  # rich ends the program on a closed pipe
                self._working.remove(part)

    def close(self) -> None:
        for part in self._parts:
            with suppress(Exception, SystemExit):
                part.close()

    @property
    def lost(self) -> list[str]:
        """Sentences on what was not shown."""
        return [part.lost for part in self._parts if part.lost]
