"""The displays of a flight while it happens: clients of the live page, JSON lines, the terminal,
and the snapshots that all of them show."""

from __future__ import annotations

import io
import json
import math
import os
import re
import signal
import socket
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from typing import Any
from urllib.parse import urlsplit
from urllib.request import urlopen

import pytest
from browser import Opened, opening
from pair import Pair, calm_hover, hover
from rich.console import Console
from uneventful import heartbeat, uneventful

from offboard.documents.errors import UserError
from offboard.flight.display import Snapshot
from offboard.flight.phases import Phase
from offboard.live.lines import JsonLines, Terminal, status
from offboard.live.process import Displays, LiveProcess

FLOOD = b"GET / HTTP/1.1\r\nHost: x\r\n\r\n" * 200
EVENTS = b"GET /events HTTP/1.1\r\nHost: x\r\n\r\n"


@contextmanager
def serving() -> Iterator[tuple[LiveProcess, str]]:
    with closing(LiveProcess("--live", "127.0.0.1:0")) as process:
        yield process, process.await_ready()


def shown_by(show: Callable[[Pair], object], every: int = 1) -> Pair:
    """Return a flight for which `show` is called at every step, or at every `every`-th one."""
    pair = hover()
    pair.every(every, show)
    return pair


# --- what must not disturb a flight ---------------------------------------------------------------


def test_live_page_clients_do_not_change_setpoints() -> None:
    """Nor does a client affect another one, which sees the flight to its end."""
    with serving() as (process, url):
        address = (urlsplit(url).hostname, urlsplit(url).port)
        reading = urlopen(f"{url}/events", timeout=20)
        deaf = socket.create_connection(address)
        deaf.sendall(EVENTS)  # this client reads nothing
        flooding = socket.create_connection(address)
        flooding.setblocking(False)

        def show(flying: Pair) -> None:
            process.show(flying.companion)
            if flying.steps % 50 == 0:
                with suppress(BlockingIOError, ConnectionError):  # the server may have closed it
                    flooding.send(FLOOD)
            if flying.steps % 500 == 0:
                with socket.create_connection(address) as leaving:
                    leaving.sendall(EVENTS[: flying.steps % 37])

        pair = shown_by(show)
        pair.fly()
        late = urlopen(f"{url}/events", timeout=20)
        deaf.close()
        flooding.close()
    assert pair.payloads == calm_hover().payloads
    for client in (reading, late):
        lines = client.read().decode().splitlines()
        messages = [json.loads(each[6:]) for each in lines if each.startswith('data: {"type')]
        assert lines[-3:-1] == ["event: end", "data: {}"]
        assert messages[0]["type"] == "history"
        newest = messages[-1] if len(messages) > 1 else messages[0]["newest"]
        assert newest["phase"] == "disarmed"
        assert newest["texts"][-1] == pair.companion.announced[-1]
    heights = [-row["position_ned_m"][2] for row in messages[0]["rows"] if row["position_ned_m"]]
    assert max(heights) == pytest.approx(1.0, abs=0.1)


def test_unread_displays_delay_nothing_and_report_losses(monkeypatch: pytest.MonkeyPatch) -> None:
    """The server is stopped, and the pipe of the JSON lines is full."""
    monkeypatch.setattr("offboard.live.process.PERIOD_S", 0.0)  # gives a thousand snapshots
    monkeypatch.setattr("offboard.live.display.CLOSE_S", 0.2)
    unread, full = os.pipe()
    lines = JsonLines(lambda text: os.write(full, text.encode() * 400))  # exceeds the pipe's buffer
    slowest_s = 0.0
    with serving() as (process, _):
        os.kill(process._process.pid, signal.SIGSTOP)

        def timed(flying: Pair) -> None:
            nonlocal slowest_s
            began_s = time.thread_time()
            process.show(flying.companion)
            lines.show(flying.companion)
            slowest_s = max(slowest_s, time.thread_time() - began_s)

        pair = shown_by(timed, every=3)
        pair.track()
        began_s = time.monotonic()
    assert time.monotonic() - began_s < 10.0
    lines.close()
    assert len(pair.payloads) > 60
    assert pair.payloads == calm_hover().payloads[: len(pair.payloads)]
    assert slowest_s < 0.02
    found = re.fullmatch(r"--live: (\d+) snapshots dropped, they were not read", process.lost)
    assert found
    assert int(found[1]) > 500
    assert re.fullmatch(r"\d+ lines were not written: their reader was too slow", lines.lost)
    os.close(unread)
    os.close(full)


def test_unusable_live_address_is_refused() -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        address = f"127.0.0.1:{taken.getsockname()[1]}"
        for unusable, says in (
            (address, f"--live: {address} cannot be listened on"),
            ("no.such.invalid:8014", r"listened on \((?!Unknown error)"),
        ):
            with (
                closing(LiveProcess("--live", unusable)) as process,
                pytest.raises(UserError, match=says),
            ):
                process.await_ready()
    for wrong in (
        "",
        "8014x",
        "localhost:",
        "127.0.0.1:99999",
        "127.0.0.1:²",
        "[::1:1",
        "127..0.1:1",
    ):
        with pytest.raises(UserError, match="give HOST:PORT"):
            LiveProcess("--live", wrong)


# --- one flight, shown in every way ---------------------------------------------------------------


class Broken:
    lost = "broken"

    def show(self, _: object) -> None:
        raise SystemExit(1)

    def close(self) -> None:
        raise OSError


@dataclass
class Shown:
    pair: Pair
    lines: list[dict[str, Any]]
    terminal: str
    pipe: str
    seen: list[tuple[float, Snapshot]]  # true height and snapshot, every 0.1 s
    page: Opened


@pytest.fixture(scope="module")
def shown() -> Iterator[Shown]:
    written: list[str] = []
    displays = [Displays(JsonLines(written.append), [Broken()])]  # type: ignore[list-item]
    files = io.StringIO(), io.StringIO()
    seen: list[tuple[float, Snapshot]] = []
    with (
        pytest.MonkeyPatch.context() as patch,
        serving() as (process, url),
        opening(url, width=400) as page,
    ):
        patch.setattr("offboard.live.lines.STATUS_S", 0.0)
        patch.setenv("TERM", "xterm")
        for file in files:
            console = Console(file=file, force_terminal=file is files[0], width=80)
            displays.append(Displays(Terminal(console, partial(console.print, soft_wrap=True))))

        def show(flying: Pair) -> None:
            for display in displays:
                display.show(flying.companion)
            if flying.steps % 25 == 0:
                process.show(flying.companion)
                height_m = float(flying.instance.autopilot.plant.height_m)
                seen.append((height_m, flying.companion.snapshot()))

        for display in displays:
            display.tell("preparing")
        pair = shown_by(show)
        pair.fly()
        for display in displays:
            display.close()
        assert [display.lost for display in displays] == [["broken"], [], []]
        process.head(title="a flight: lemniscate by pso")
        process.show(pair.companion)
        process.head(verdict="flown and landed", report="flights/a/report.html")
        objects = [json.loads(each) for each in "".join(written).splitlines()]
        yield Shown(pair, objects, files[0].getvalue(), files[1].getvalue(), seen, page)


def test_live_page_is_readable_and_follows_the_flight(shown: Shown) -> None:
    opened = shown.page
    ended = "document.getElementById('phase').innerText.startsWith('disarmed')"
    opened.page.wait_for_function(ended)
    for width, scheme in ((400, "dark"), (1280, "light")):
        opened.resize(width)
        opened.switch(scheme)
        assert opened.width_px() == width
        assert opened.unreadable() == opened.colliding() == []
    opened.page.wait_for_function("document.getElementById('plan').data[1].x.length > 3")
    last = opened.page.inner_text("#texts li >> nth=0")
    assert re.fullmatch(rf"\d+\.\d\d s +{re.escape(shown.pair.companion.announced[-1])}", last)
    assert opened.page.inner_text("h1") == "a flight: lemniscate by pso"
    assert opened.page.inner_text("#report").endswith("flights/a/report.html")
    assert opened.page.inner_text("#skipped_ticks") == "0"
    assert opened.page.inner_text("#failsafe") == "none"
    assert opened.problems == opened.fetched == []


def test_json_lines_contain_announcements_and_snapshots(shown: Shown) -> None:
    assert shown.lines[0] == {"type": "preparation", "text": "preparing"}
    told = [each["text"] for each in shown.lines if each["type"] == "announcement"]
    assert told == shown.pair.companion.announced
    times = [each["time_s"] for each in shown.lines if each["type"] == "snapshot"]
    assert times[1:] == pytest.approx(range(1, len(times)), abs=0.05)
    assert times[-1] == pytest.approx(shown.pair.time_s, abs=1.0)


def test_terminal_prints_each_announcement_and_one_status_line(shown: Shown) -> None:
    plain = re.sub(r"\x1b\[[0-9;?]*[a-zA-Z]", "", shown.terminal).replace("\r", "\n")
    assert plain.splitlines()[0] == shown.pipe.splitlines()[0] == "preparing"
    for sentence in shown.pair.companion.announced:
        assert plain.count(f" s  {sentence}") == shown.pipe.count(f" s  {sentence}") == 1
    assert "\x1b" not in shown.pipe
    assert "\x1b[2K" in shown.terminal  # a line is erased before it is written again
    assert re.search(r"s  track  error 0\.0\d\d m  link age \d+ ms  OFFBOARD", plain)
    shows_cursor, hides_cursor = "\x1b[?25h", "\x1b[?25l"
    assert shown.terminal.rindex(shows_cursor) > shown.terminal.rindex(hides_cursor)


def test_snapshots_agree_with_the_flight(shown: Shown) -> None:
    first, last = shown.seen[0][1], shown.pair.companion.snapshot()
    assert (first.authority, first.reference_ned_m) == ("free", None)
    assert math.isnan(first.position_error_m)
    tracked = [each for each in shown.seen if each[1].phase == "track"]
    assert len(tracked) == pytest.approx(30, abs=2)
    for true_height_m, now in tracked:
        assert now.position_ned_m is not None
        assert now.reference_ned_m is not None
        assert -now.position_ned_m[2] == pytest.approx(true_height_m, abs=0.3)
        error_m = math.dist(now.position_ned_m, now.reference_ned_m)
        assert now.position_error_m == pytest.approx(error_m, abs=1e-9)
        assert (now.mode, now.armed, now.authority) == ("OFFBOARD", True, "ours")
        assert now.failsafe == "fly"
    ends_s = [tracked[0][1].track_time_s, tracked[-1][1].track_time_s]
    assert ends_s == pytest.approx([0.0, 3.0], abs=0.2)
    assert (last.phase, last.armed) == ("disarmed", False)
    followed = {now.phase for _, now in shown.seen if now.reference_ned_m is not None}
    assert followed == {"climb", "track", "hover"}
    assert last.texts[-1] == shown.pair.companion.announced[-1]


def test_status_line_omits_unknown_values() -> None:
    now = hover().companion.snapshot()
    assert status(now).strip() == "-- s  connect  unknown"
    shown = {"phase": "track", "position_error_m": 12.3456}
    vars(now).update(shown, failsafe="hold", failsafe_row="link")
    assert status(now).strip() == "-- s  track  error 12.346 m  unknown  hold: link"


def test_snapshot_shows_the_pilots_mode_and_lost_authority() -> None:
    state: Any = uneventful(Phase.TRACK)
    heartbeat(state, armed=True, mode="AUTO.LOITER")
    assert (Snapshot(state).authority, Snapshot(state).mode) == ("lost", "AUTO.LOITER")
