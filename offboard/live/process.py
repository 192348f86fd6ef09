"""Feeds the live page, which runs in a process of its own. Snapshots go through a queue and a pipe
of JSON lines, so that the loop never waits for clients. The process ends when the pipe closes."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Sequence
from contextlib import suppress
from typing import TYPE_CHECKING

from offboard.documents.arguments import split_address
from offboard.documents.errors import Unavailable
from offboard.flight.display import Snapshot
from offboard.link import clock
from offboard.live.display import Display, Shown, json_lines, line

if TYPE_CHECKING:
    from offboard.flight.flight import Flight
    from offboard.live.lines import JsonLines, Terminal

SERVER = "offboard.live.server"
PERIOD_S = 0.1  # least time between two snapshots, host time
QUEUED_MAX = 50  # greatest number of snapshots in the queue; the pipe holds about as many
CLOSE_S = 1.0  # time to write what is queued, and again for the process to end


class LiveProcess(Display):
    """Display that feeds the page. The constructor starts the process that serves the page.

    The process prints one JSON line: {"url": ...} once it listens, or {"error": ...} if it cannot.
    """

    def __init__(self, option: str, address: str) -> None:
        host, port = split_address(option, address)
        self._option = option
        self._process = subprocess.Popen(
            [sys.executable, "-P", "-m", SERVER, host, str(port)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            bufsize=0,
            start_new_session=True,  # signals of the terminal reach only the controller
        )
        super().__init__(self._write, QUEUED_MAX)

    def await_ready(self) -> str:
        """Wait until the process listens, and return its address. Raises Unavailable."""
        assert self._process.stdout is not None
        with self._process.stdout as output:
            said = output.readline()
        answer = json.loads(said) if said else {"error": "its process does not start"}
        if "error" in answer:
            raise Unavailable(f"{self._option}: {answer['error']}")
        return str(answer["url"])

    def head(self, **values: str) -> None:
        """Set texts of the page: `title`, or after the flight `verdict` and `report`."""
        self._writer.put(line("flight", **values))

    def is_due(self, shown: Shown) -> bool:
        now_s = clock.monotonic_s()
        if now_s < self._due_s and not shown.has_ended():
            return False
        self._due_s = now_s + PERIOD_S
        return True

    def close(self) -> None:
        self._writer.close(CLOSE_S)
        assert self._process.stdin is not None
        if not self._writer.is_free():  # the process does not read: free the thread
            self._process.kill()
        with suppress(OSError):
            self._process.stdin.close()
        try:
            self._process.wait(CLOSE_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()

    @property
    def lost(self) -> str:
        dropped = self._writer.dropped
        return f"{self._option}: {dropped} snapshots dropped, they were not read" if dropped else ""

    def _write(self, items: list[str | Snapshot]) -> None:
        assert self._process.stdin is not None
        data = memoryview(json_lines(items).encode())
        while data:
            data = data[self._process.stdin.write(data) :]


class Displays:
    """All displays of a flight: its lines, and the pages in processes of their own. `show` is
    called in every turn of the loop and must not wait. A display whose `show` raises is not called
    again."""

    def __init__(self, lines: Terminal | JsonLines, pages: Sequence[LiveProcess] = ()) -> None:
        self._lines, self._pages = lines, pages
        self._parts: list[Display] = [lines, *pages]
        self._working = list(self._parts)

    def tell(self, sentence: str) -> None:
        """Write a sentence about the preparation."""
        self._lines.tell(sentence)

    def begin(self, title: str) -> None:
        """Wait until the pages are served, write their addresses, and set their title. Raises
        UserError."""
        for page in self._pages:
            self.tell(f"live: {page.await_ready()}")
            page.head(title=title)

    def conclude(self, verdict: str, report: str) -> None:
        """Tell the pages how the flight ended, and where its report will be."""
        for page in self._pages:
            page.head(verdict=verdict, report=report)

    def show(self, flight: Flight) -> None:
        for part in tuple(self._working):
            try:
                part.show(flight)
            except (Exception, SystemExit):  # rich raises SystemExit on a closed pipe
                self._working.remove(part)

    def close(self) -> None:
        for part in self._parts:
            with suppress(Exception, SystemExit):
                part.close()

    @property
    def lost(self) -> list[str]:
        """Sentences that say what was not shown."""
        return [part.lost for part in self._parts if part.lost]
