"""The progress of many flights: a bar on a terminal, else a line for every twentieth of them."""

from __future__ import annotations

from types import TracebackType

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

from offboard.campaign.cases import Case
from offboard.flight import clock

LINES = 20


class Counter:
    """Context manager that shows how many flights have ended."""

    def __init__(self, console: Console) -> None:
        self._console = console
        self._bar = Progress(
            TextColumn("flights"), BarColumn(bar_width=20), MofNCompleteColumn(),
            TimeElapsedColumn(), TimeRemainingColumn(),
            console=console, transient=True, disable=not console.is_terminal,
        )  # fmt: skip
        self._task = self._bar.add_task("flights", total=None)
        self._begun_s = clock.monotonic_s()
        self._announced = False

    def __enter__(self) -> Counter:
        self._bar.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        value: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._bar.stop()

    def count(self, case: Case, done: int, planned: int) -> None:
        """A flight has ended: the `done`-th of `planned`."""
        self._bar.update(self._task, completed=done, total=planned)
        if self._console.is_terminal or (done % max(1, planned // LINES) and done != planned):
            return
        rate = 60.0 * done / max(1e-9, clock.monotonic_s() - self._begun_s)
        self._console.print(f"{done} of {planned} flights, {rate:.0f} a minute")

    def announce(self, sentence: str) -> None:
        """Print a sentence, once."""
        if not self._announced:
            self._announced = True
            self._bar.console.print(sentence)
