"""The flight as lines: for a person, on a terminal with a status line in place, or for a machine.

A thread writes, so that the loop does not wait for a terminal that Ctrl-S stops or for a full pipe.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from contextlib import suppress
from typing import Protocol

from rich.console import Console
from rich.live import Live
from rich.text import Text

from offboard.flight.display import Snapshot
from offboard.flight.phases import Phase
from offboard.flight.state import FlightState
from offboard.link import clock
from offboard.link.background import BackgroundWriter
from offboard.live.values import as_dict, line

LINES_MAX = 1000  # that wait to be written
CLOSE_S = 2.0  # for them, after the flight
STATUS_S = 0.2  # between two status lines, host time
SNAPSHOT_S = 1.0  # between two JSON snapshots, vehicle time


class Announcing(Protocol):
    """A companion, or the flights of a service. `announced` has the newest sentences, oldest first,
    `announcements` counts all that there were."""

    @property
    def announced(self) -> list[str]: ...
    @property
    def announcements(self) -> int: ...
    @property
    def phase(self) -> Phase: ...
    @property
    def state(self) -> FlightState: ...
    def snapshot(self) -> Snapshot: ...


class News:
    """Announcements, each once."""

    def __init__(self) -> None:
        self._seen = 0

    def of(self, flown: Announcing) -> list[str]:
        """Those since the last call."""
        new, self._seen = flown.announcements - self._seen, flown.announcements
        return flown.announced[-new:] if new else []


class Terminal:
    """Prints announcements with `show_line`; below them, where the console is a terminal that can
    do it, one status line in place."""

    def __init__(self, console: Console, show_line: Callable[[str], None]) -> None:
        in_place = console.is_terminal and not console.is_dumb_terminal
        self._live = _status_line(console) if in_place else None
        self._show_line = show_line
        self._writer = BackgroundWriter[str | Snapshot](self._write, LINES_MAX)
        self._news = News()
        self._due_s = -math.inf
        self._waits = False  # a status is queued: no second one

    def tell(self, sentence: str) -> None:
        """A sentence about the preparation."""
        self._writer.put(sentence)

    def show(self, companion: Announcing) -> None:
        for sentence in self._news.of(companion):
            self._writer.put(f"{_stamp(companion.state.time_s)}  {sentence}")
        now_s = clock.monotonic_s()
        if self._live and now_s >= self._due_s and not self._waits:
            self._due_s, self._waits = now_s + STATUS_S, True
            self._writer.put(companion.snapshot())

    def close(self) -> None:
        self._writer.close(CLOSE_S)
        if self._live and self._writer.is_free():
            with suppress(OSError, SystemExit):
                self._live.stop()

    @property
    def lost(self) -> str:
        dropped = 0 if self._writer.error else self._writer.dropped  # nobody misses a closed pipe
        if not dropped:
            return ""
        return f"{dropped} lines of the flight are missing above: the terminal was stopped"

    def _write(self, items: list[str | Snapshot]) -> None:
        for item in items:
            if isinstance(item, str):
                self._show_line(item)
            elif self._live:
                self._live.start()
                self._live.update(Text(status(item), no_wrap=True, overflow="ellipsis"))
                self._live.refresh()
                self._waits = False


def _status_line(console: Console) -> Live:
    return Live(
        console=console, auto_refresh=False, transient=True, redirect_stdout=False,
        redirect_stderr=False,
    )  # fmt: skip


def status(now: Snapshot) -> str:
    """Time, phase, error, link age, mode and failsafe in one line, as far as they are known."""
    parts = [f"{_stamp(now.time_s)}  {now.phase}"]
    if math.isfinite(now.position_error_m):
        parts.append(f"error {now.position_error_m:.3f} m")
    if math.isfinite(now.telemetry_age_s):
        parts.append(f"link age {1e3 * now.telemetry_age_s:.0f} ms")
    if now.mode:
        parts.append(now.mode)
    if now.failsafe != "fly":
        parts.append(f"{now.failsafe}: {now.failsafe_row}")
    return "  ".join(parts)


def _stamp(time_s: float) -> str:
    """Vehicle time; 0 before the first telemetry."""
    return f"{time_s:8.2f} s" if time_s else f"{'--':>8} s"


class JsonLines:
    """Writes one JSON object a line: snapshots once a second of vehicle time, announcements."""

    def __init__(self, write: Callable[[str], object]) -> None:
        self._print = write
        self._writer = BackgroundWriter[str](self._write, LINES_MAX)
        self._news = News()
        self._due_s = -math.inf

    def tell(self, sentence: str) -> None:
        """A sentence about the preparation."""
        self._writer.put(line("preparation", text=sentence))

    def show(self, companion: Announcing) -> None:
        time_s = companion.state.time_s
        for sentence in self._news.of(companion):
            self._writer.put(line("announcement", time_s=round(time_s, 3), text=sentence))
        if not self._due_s - SNAPSHOT_S <= time_s < self._due_s:  # or the clock has jumped back
            self._due_s = math.floor(time_s / SNAPSHOT_S + 1.0) * SNAPSHOT_S
            self._writer.put(line("snapshot", **as_dict(companion.snapshot())))

    def close(self) -> None:
        self._writer.close(CLOSE_S)

    @property
    def lost(self) -> str:
        dropped = 0 if self._writer.error else self._writer.dropped
        return f"{dropped} lines were not written: nobody read them" if dropped else ""

    def _write(self, lines: list[str]) -> None:
        self._print("".join(f"{each}\n" for each in lines))


class JsonLog(JsonLines):
    """Writes one JSON object a line, as log collectors read them: sentences with their UTC."""

    def tell(self, sentence: str) -> None:
        """A sentence about the service."""
        self._put("service", sentence)

    def show(self, companion: Announcing) -> None:
        for sentence in self._news.of(companion):
            time_s = companion.state.time_s
            self._put(companion.phase.value, sentence, vehicle_time_s=time_s)

    def _put(self, phase: str, sentence: str, **more: float) -> None:
        entry = {"time": clock.utc(), "level": "info", "phase": phase, "event": sentence, **more}
        self._writer.put(json.dumps(entry))
