"""What shows a flight while it happens: clients of the live page, JSON lines, the terminal."""

from __future__ import annotations

import io
import json
import os
import re
import signal
import socket
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager, suppress
from functools import partial
from itertools import count
from typing import Any
from urllib.parse import urlsplit
from urllib.request import urlopen

import pytest
from browser import opening
from pair import Pair, hover
from rich.console import Console

from offboard.documents.errors import UserError
from offboard.live.lines import JsonLines, Terminal, status
from offboard.live.process import Displays, LiveProcess

SERVER = "offboard.live.server"
FLOOD = b"GET / HTTP/1.1\r\nHost: x\r\n\r\n" * 200
EVENTS = b"GET /events HTTP/1.1\r\nHost: x\r\n\r\n"


@contextmanager
def serving() -> Iterator[tuple[LiveProcess, str]]:
    with closing(LiveProcess(SERVER, "--live", "127.0.0.1:0")) as process:
        yield process, process.await_ready()


def flown(*shows: Callable[[Any], None]) -> Pair:
    """A flight whose companion is shown at every step, as the loop does at every turn."""
    pair = hover()

    def look(flying: Pair) -> bool:
        for show in shows:
            show(flying.companion)
        return False

    pair.at.append((look, lambda _: None))
    pair.fly()
    return pair


@pytest.fixture(scope="module")
def undisturbed() -> list[bytes]:
    """The setpoints of a flight that nothing shows."""
    return flown().payloads


def test_no_client_of_the_live_page_changes_a_setpoint(undisturbed: list[bytes]) -> None:
    """Nor does it take anything from another client, which sees the flight to its end."""
    with serving() as (process, url):
        address = (urlsplit(url).hostname, urlsplit(url).port)
        reading = urlopen(f"{url}/events", timeout=20)
        deaf = socket.create_connection(address)
        deaf.sendall(EVENTS)  # and reads nothing
        flooding = socket.create_connection(address)
        flooding.setblocking(False)
        steps = count()

        def disturb(_: object) -> None:
            step = next(steps)
            if step % 50 == 0:
                with suppress(BlockingIOError, ConnectionError):  # it may be closed
                    flooding.send(FLOOD)
            if step % 500 == 0:
                with socket.create_connection(address) as leaving:
                    leaving.sendall(EVENTS[: step % 37])

        pair = flown(process.show, disturb)
        late = urlopen(f"{url}/events", timeout=20)
        deaf.close()
        flooding.close()
    assert len(undisturbed) > 80
    assert pair.payloads == undisturbed
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


def test_what_nobody_reads_delays_nothing_and_is_told(
    undisturbed: list[bytes], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A server that stands still, and a pipe that is full."""
    monkeypatch.setattr("offboard.live.process.PERIOD_S", 0.0)  # a thousand snapshots
    monkeypatch.setattr("offboard.live.display.CLOSE_S", 0.2)
    unread, full = os.pipe()
    lines = JsonLines(lambda text: os.write(full, text.encode() * 400))  # more than it holds
    slowest_s = 0.0
    with serving() as (process, _):
        os.kill(process._process.pid, signal.SIGSTOP)

        def timed(companion: Any) -> None:
            nonlocal slowest_s
            began_s = time.thread_time()
            process.show(companion)
            lines.show(companion)
            slowest_s = max(slowest_s, time.thread_time() - began_s)

        steps = count()
        pair = flown(lambda companion: timed(companion) if next(steps) % 5 == 0 else None)
        began_s = time.monotonic()
    assert time.monotonic() - began_s < 10.0
    lines.close()
    assert pair.payloads == undisturbed
    assert slowest_s < 0.02
    found = re.fullmatch(r"--live: (\d+) snapshots dropped, they were not read", process.lost)
    assert found
    assert int(found[1]) > 500
    assert re.fullmatch(r"\d+ lines were not written: nobody read them", lines.lost)
    os.close(unread)
    os.close(full)


def test_an_address_that_cannot_be_served_is_refused() -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        address = f"127.0.0.1:{taken.getsockname()[1]}"
        refused = f"--live: {address} cannot be listened on"
        with (
            closing(LiveProcess(SERVER, "--live", address)) as process,
            pytest.raises(UserError, match=refused),
        ):
            process.await_ready()
    with (
        closing(LiveProcess(SERVER, "--live", "no.such.invalid:8014")) as process,
        pytest.raises(UserError, match=r"listened on \((?!Unknown error)"),
    ):
        process.await_ready()
    for wrong in ("", "8014x", "localhost:", "127.0.0.1:99999", "127.0.0.1:²", "[::1:1"):
        with pytest.raises(UserError, match="give HOST:PORT"):
            LiveProcess(SERVER, "--live", wrong)


def test_the_live_page_follows_the_flight_in_both_schemes_and_widths() -> None:
    pair = hover()
    with serving() as (process, url), opening(url, width=400) as opened:
        pair.at.append((lambda p: p.steps % 25 == 0 and process.show(p.companion), lambda _: None))
        pair.fly()
        process.tell(title="a flight: lemniscate by pso")
        process.show(pair.companion)
        process.tell(verdict="flown and landed", report="flights/a/report.html")
        ended = "document.getElementById('phase').innerText.startsWith('disarmed')"
        opened.page.wait_for_function(ended)
        for width in (400, 1280):
            opened.resize(width)
            for scheme in ("dark", "light"):
                opened.switch(scheme)
                assert opened.width_px() == width
                assert opened.unreadable() == opened.colliding() == []
        drawn = "document.getElementById('plan').data[1].x.length"
        opened.page.wait_for_function(f"{drawn} > 3")
        last = opened.page.inner_text("#texts li >> nth=0")
        assert re.fullmatch(rf"\d+\.\d\d s +{re.escape(pair.companion.announced[-1])}", last)
        assert opened.page.inner_text("h1") == "a flight: lemniscate by pso"
        assert opened.page.inner_text("#report").endswith("flights/a/report.html")
        assert opened.page.inner_text("#skipped") == "0"
        assert opened.problems == opened.fetched == []


class Broken:
    lost = "broken"

    def show(self, _: object) -> None:
        raise SystemExit(1)

    def close(self) -> None:
        raise OSError


@pytest.fixture(scope="module")
def lines() -> tuple[Pair, list[str], str, str]:
    """A flight, its JSON lines, and the text of a terminal and of a pipe."""
    written: list[str] = []
    displays = [Displays(JsonLines(written.append), [Broken()])]  # type: ignore[list-item]
    files = io.StringIO(), io.StringIO()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("offboard.live.lines.STATUS_S", 0.0)
        patch.setenv("TERM", "xterm")
        for file in files:
            console = Console(file=file, force_terminal=file is files[0], width=80)
            displays.append(Displays(Terminal(console, partial(console.print, soft_wrap=True))))
        for display in displays:
            display.tell("preparing")
        pair = flown(*(display.show for display in displays))
        for display in displays:
            display.close()
    assert [display.lost for display in displays] == [["broken"], [], []]
    objects = "".join(written).splitlines()
    return pair, objects, files[0].getvalue(), files[1].getvalue()


def test_json_lines_are_one_object_each(lines: tuple[Pair, list[str], str, str]) -> None:
    pair, written, *_ = lines
    objects = [json.loads(each) for each in written]
    assert objects[0] == {"type": "preparation", "text": "preparing"}
    told = [each["text"] for each in objects if each["type"] == "announcement"]
    assert told == pair.companion.announced
    times = [each["time_s"] for each in objects if each["type"] == "snapshot"]
    assert times[1:] == pytest.approx(range(1, len(times)), abs=0.05)
    assert times[-1] == pytest.approx(pair.time_s, abs=1.0)


def test_the_terminal_has_its_lines_and_one_status_in_place(
    lines: tuple[Pair, list[str], str, str],
) -> None:
    pair, _, terminal, pipe = lines
    plain = re.sub(r"\x1b\[[0-9;?]*[a-zA-Z]", "", terminal).replace("\r", "\n")
    assert plain.splitlines()[0] == pipe.splitlines()[0] == "preparing"
    for sentence in pair.companion.announced:
        assert plain.count(f" s  {sentence}") == pipe.count(f" s  {sentence}") == 1
    assert "\x1b" not in pipe
    assert "\x1b[2K" in terminal  # a line erased to be written again
    assert re.search(r"s  track  error 0\.0\d\d m  link age \d+ ms  OFFBOARD", plain)
    assert terminal.rindex("\x1b[?25h") > terminal.rindex("\x1b[?25l")  # cursor shown again


def test_a_status_leaves_out_what_is_not_known() -> None:
    now = hover().companion.snapshot()
    assert status(now).strip() == "-- s  connect  unknown"
    shown = {"phase": "track", "position_error_m": 12.3456}
    vars(now).update(shown, failsafe="hold", failsafe_row="link")
    assert status(now).strip() == "-- s  track  error 12.346 m  unknown  hold: link"
