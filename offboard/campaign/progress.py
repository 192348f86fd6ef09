"""The progress of many flights: how many have ended, how fast, and how long the rest takes.

A bar on a terminal, else lines: at the beginning, after the first `FIRST` flights, and for every
twentieth of them.
"""

from __future__ import annotations

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

from offboard.link import clock
from offboard.link.stop import StopRequests

INTERRUPTED = "interrupted: flights in the air are finished; interrupt again to exit at once"
FIRST = 5  # flights after which the time is estimated first
LINES = 20


class Counter(Progress):
    """Context manager that shows how many of at most `planned` flights have ended."""

    def __init__(self, console: Console, planned: int = 0) -> None:
        super().__init__(
            TextColumn("flights"), BarColumn(bar_width=20), MofNCompleteColumn(),
            TextColumn("{task.fields[rate]}"), TimeElapsedColumn(), TimeRemainingColumn(),
            console=console, transient=True, disable=not console.is_terminal,
        )  # fmt: skip
        self.planned = planned
        self._task = self.add_task("flights", total=planned, rate="")
        self._begun_s = clock.monotonic_s()
        self._announced = False
        self._known = self._flown = 0

    def begin(self, known: int) -> None:
        """`known` further flights have been flown by an earlier run."""
        self._known += known
        self._update("")
        if not self._flown:
            already = f", {self._known} already flown" if self._known else ""
            self._say(f"{self.planned} flights{already}")

    def ended(self) -> None:
        """A flight has ended."""
        self._flown += 1
        done = self._known + self._flown
        self.planned = max(self.planned, done)
        rate = 60.0 * self._flown / max(1e-9, clock.monotonic_s() - self._begun_s)
        self._update(f"{rate:.0f} a minute")
        every = max(1, self.planned // LINES)
        if done % every == 0 or done == self.planned or self._flown == FIRST:
            left = remaining(60.0 * (self.planned - done) / rate)
            self._say(f"{done} of {self.planned} flights, {rate:.0f} a minute, {left} left")

    def ending(self, stops: StopRequests) -> bool:
        """Whether a stop was requested, which is then said, once."""
        if stops.requested and not self._announced:
            self._announced = True
            self.console.print(INTERRUPTED)
        return stops.requested

    def _update(self, rate: str) -> None:
        done = self._known + self._flown
        self.update(self._task, completed=done, total=self.planned, rate=rate)

    def _say(self, line: str) -> None:
        if not self.console.is_terminal:
            self.console.print(line, markup=False, soft_wrap=True)


def remaining(seconds: float) -> str:
    """A duration in the largest unit that gives two figures."""
    if seconds < 100.0:
        return f"{seconds:.0f} s"
    minutes = seconds / 60.0
    return f"{minutes:.0f} min" if minutes < 100.0 else f"{minutes / 60.0:.1f} h"
