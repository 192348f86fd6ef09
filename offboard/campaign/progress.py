"""The progress of many flights: how many have ended, how fast, and how long the rest takes.

One line in place on a terminal, else lines: at the beginning, after the first `FIRST` flights, and
for every twentieth of them.
"""

from __future__ import annotations

from rich.console import Console
from rich.status import Status

from offboard.link import clock
from offboard.link.stop import StopRequests

INTERRUPTED = "interrupted: flights in the air are finished; interrupt again to exit at once"
FIRST = 5  # flights after which the time is estimated first
LINES = 20


class Counter(Status):
    """Context manager that shows how many of at most `planned` flights have ended."""

    def __init__(self, console: Console, planned: int = 0) -> None:
        super().__init__("", console=console)
        self.planned = planned
        self._begun_s = clock.monotonic_s()
        self._announced = False
        self._known = self._flown = 0

    def begin(self, known: int) -> None:
        """`known` further flights have been flown by an earlier run."""
        self._known += known
        if not self._flown:
            already = f", {self._known} already flown" if self._known else ""
            self._show(f"{self.planned} flights{already}", in_lines=True)

    def ended(self) -> None:
        """A flight has ended."""
        self._flown += 1
        done = self._known + self._flown
        self.planned = max(self.planned, done)
        rate = 60.0 * self._flown / max(1e-9, clock.monotonic_s() - self._begun_s)
        left = remaining(60.0 * (self.planned - done) / rate)
        every = max(1, self.planned // LINES)
        self._show(
            f"{done} of {self.planned} flights, {rate:.0f} a minute, {left} left",
            in_lines=done % every == 0 or done == self.planned or self._flown == FIRST,
        )

    def ending(self, stops: StopRequests) -> bool:
        """Whether a stop was requested, which is then said, once."""
        if stops.requested and not self._announced:
            self._announced = True
            self.console.print(INTERRUPTED)
        return stops.requested

    def _show(self, line: str, *, in_lines: bool) -> None:
        if self.console.is_terminal:
            self.update(line)
        elif in_lines:
            self.console.print(line, markup=False, soft_wrap=True)


def remaining(seconds: float) -> str:
    """A duration in the largest unit that gives two figures."""
    if seconds < 100.0:
        return f"{seconds:.0f} s"
    minutes = seconds / 60.0
    return f"{minutes:.0f} min" if minutes < 100.0 else f"{minutes / 60.0:.1f} h"
