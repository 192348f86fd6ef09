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
    """Context manager that shows how many flights have ended."""

    def __init__(self, console: Console) -> None:
        super().__init__(
            TextColumn("flights"), BarColumn(bar_width=20), MofNCompleteColumn(),
            TextColumn("{task.fields[rate]}"), TimeElapsedColumn(), TimeRemainingColumn(),
            console=console, transient=True, disable=not console.is_terminal,
        )  # fmt: skip
        self._task = self.add_task("flights", total=None, rate="")
        self._begun_s = clock.monotonic_s()
        self._announced = False
        self._before: int | None = None  # flights that an earlier run has flown

    def count(self, done: int, planned: int, ended: str = "") -> None:
        """`done` of at most `planned` flights have ended; 0 at the beginning. With `ended`, a
        sentence on the last one, every flight is a line."""
        if done and self._before is None:
            self._before = done - 1
        own = done - (self._before or 0)
        rate = 60.0 * own / max(1e-9, clock.monotonic_s() - self._begun_s)
        told = f"{rate:.0f} a minute" if done else ""
        self.update(self._task, completed=done, total=planned, rate=told)
        every = 1 if ended else max(1, planned // LINES)
        if self.console.is_terminal or (done % every and done != planned and own != FIRST):
            return
        line = f"{done} of {planned} flights"
        if done:
            line += f", {told}, {remaining(60.0 * (planned - done) / rate)} left"
        if ended:
            line += f": {ended}"
        self.console.print(line, markup=False, soft_wrap=True)

    def ending(self, stops: StopRequests) -> bool:
        """Whether a stop was requested, which is then said, once."""
        if stops.requested and not self._announced:
            self._announced = True
            self.console.print(INTERRUPTED)
        return stops.requested


def remaining(seconds: float) -> str:
    """A duration in the largest unit that gives two figures."""
    if seconds < 100.0:
        return f"{seconds:.0f} s"
    minutes = seconds / 60.0
    return f"{minutes:.0f} min" if minutes < 100.0 else f"{minutes / 60.0:.1f} h"
