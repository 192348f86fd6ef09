"""The flight as lines of text: on a terminal with a status line, or as JSON for programs."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from contextlib import suppress

from rich.console import Console
from rich.live import Live
from rich.text import Text

from offboard.flight.display import Snapshot
from offboard.flight.flight import Flight
from offboard.link import clock
from offboard.live.display import Display, Shown, json_lines

LINES_MAX = 1000  # greatest number of lines that wait to be written
STATUS_S = 0.2  # period of the status line, host time
SNAPSHOT_S = 1.0  # period of JSON snapshots, vehicle time


class Terminal(Display):
    """Prints announcements by `show_line`. Below them, a terminal that can move its cursor has one
    status line, which is updated in place."""

    LOST = "{} lines of the flight are missing above: the terminal was stopped"

    def __init__(self, console: Console, show_line: Callable[[str], None]) -> None:
        self._live: Live | None = None
        if console.is_terminal and not console.is_dumb_terminal:
            self._live = Live(
                console=console, auto_refresh=False, transient=True, redirect_stdout=False,
                redirect_stderr=False,
            )  # fmt: skip
        self._show_line = show_line
        self._waits = False  # whether a status is queued, so that no second one is
        super().__init__(self._write, LINES_MAX)

    def text(self, sentence: str, flight: Flight | None = None) -> str:
        return f"{_stamp(flight.time_s)}  {sentence}" if flight else sentence

    def is_due(self, shown: Shown) -> bool:
        now_s = clock.monotonic_s()
        if not self._live or now_s < self._due_s or self._waits:
            return False
        self._due_s, self._waits = now_s + STATUS_S, True
        return True

    def close(self) -> None:
        super().close()
        if self._live and self._writer.is_free():
            with suppress(OSError, SystemExit):
                self._live.stop()

    def _write(self, items: list[str | Snapshot]) -> None:
        for item in items:
            if isinstance(item, str):
                self._show_line(item)
            elif self._live:
                self._live.start()
                self._live.update(Text(status(item), no_wrap=True, overflow="ellipsis"))
                self._live.refresh()
                self._waits = False


def status(now: Snapshot) -> str:
    """Return vehicle time, phase, position error, age of telemetry, mode and failsafe as one line,
    as far as they are known."""
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
    """Return vehicle time as text, "--" before the first telemetry (`time_s` is 0)."""
    return f"{time_s:8.2f} s" if time_s else f"{'--':>8} s"


class JsonLines(Display):
    """Writes one JSON object per line: announcements, and a snapshot per second of vehicle time."""

    LOST = "{} lines were not written: their reader was too slow"

    def __init__(self, write: Callable[[str], object]) -> None:
        super().__init__(lambda items: write(json_lines(items)), LINES_MAX)

    def is_due(self, shown: Shown) -> bool:
        time_s = shown.current.time_s
        # due also after a jump of the vehicle's clock backwards
        if self._due_s - SNAPSHOT_S <= time_s < self._due_s:
            return False
        self._due_s = math.floor(time_s / SNAPSHOT_S + 1.0) * SNAPSHOT_S
        return True


class JsonLog(JsonLines):
    """Writes one JSON object per line for log collectors: each sentence with its time (UTC)."""

    def text(self, sentence: str, flight: Flight | None = None) -> str:
        entry: dict[str, object] = {"time": clock.utc(), "level": "info", "phase": "service"}
        entry |= {"event": sentence}
        if flight:
            entry |= {"phase": flight.phase.value, "vehicle_time_s": flight.time_s}
        return json.dumps(entry)

    def is_due(self, shown: Shown) -> bool:
        return False
