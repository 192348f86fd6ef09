"""Loop and links under failures of terminal, pipe and cable, and under signals."""

from __future__ import annotations

import os
import pty
import select
import signal
import socket
import time
import tty
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import Any, cast

import pytest
from pymavlink.dialects.v20 import common as mavlink

from offboard.flight.flight import Flight, Outcome, Output
from offboard.flight.phases import Phase
from offboard.link import clock
from offboard.link import log as log_module
from offboard.link.connection import open_link
from offboard.link.interface import Chunk, Link, LinkReport, LinkUnavailable
from offboard.link.log import FlightLog
from offboard.link.stop import StopRequests
from offboard.mavlink.counters import Counters
from offboard.mavlink.framing import FrameSplitter
from offboard.run.loop import UNGUARDED, Loop
from offboard.supervisor.supervisor import Supervisor, SupervisorError


class Wire:
    """A link without traffic."""

    is_stream = False

    def __init__(self) -> None:
        self.report = LinkReport()

    def wait(self, timeout_s: float) -> None: ...

    def receive(self, timeout_s: float) -> list[Chunk]:
        return []

    def send(self, data: bytes, peer: object) -> None: ...

    def follow(self, peer: object) -> None: ...

    def descriptors(self) -> tuple[int, ...]:
        return ()

    def close(self) -> None: ...


class Brief:
    """A companion whose flight lasts `turns`, and which counts stop requests."""

    peer = None
    phase = Phase.TRACK
    lands_without_log = True
    guarded = True

    def __init__(self, turns: int, during: Callable[[int], object], log: bytes = b"") -> None:
        self.turns, self.during = turns, during
        self.log: Sequence[bytes] = (log,) if log else ()
        self.stops = 0
        self.outcome: Outcome | None = None
        self.announced: list[str] = []

    def has_ended(self) -> bool:
        return self.outcome is not None

    def request_stop(self, why: str = "") -> None:
        self.stops += 1

    @property
    def current(self) -> Brief:
        return self

    def announce(self, sentence: str) -> None:
        self.announced.append(sentence)

    def on_dropped(self, frames: int) -> None:
        self.dropped = frames

    def overhear(self, datagrams: Sequence[bytes]) -> None: ...

    def guard(self, guarded: bool) -> None:
        self.guarded = guarded

    def turn(self, chunks: Sequence[Chunk], now_s: float) -> Output:
        self.turns -= 1
        self.during(self.turns)
        if self.turns == 0:
            self.outcome = Outcome(0, "flown and landed")
        return Output()

    def finish_turn(self, sent_s: float) -> Sequence[bytes]:
        return self.log


def fly(flight: Brief, directory: Path, progress: Callable[[Any], None]) -> Outcome:
    with FlightLog(directory / "flight", "") as log, StopRequests() as stops:
        companion = cast(Flight, flight)
        return Loop(companion, Wire(), log, stops=stops, progress=progress).run()


@pytest.mark.parametrize("failure", [SystemExit(1), BrokenPipeError(), OSError(5, "lost")])
def test_a_closed_terminal_does_not_end_the_flight(tmp_path: Path, failure: BaseException) -> None:
    shown = 0

    def progress(companion: Any) -> None:
        nonlocal shown
        shown += 1
        raise failure

    flight = Brief(5, lambda left: None)
    assert fly(flight, tmp_path, progress).sentence == "flown and landed"
    assert (flight.turns, shown, flight.stops) == (0, 1, 0)


@pytest.mark.parametrize(
    ("number", "apart_s", "turns_left"),
    [
        (signal.SIGHUP, 1.1, 0),
        (signal.SIGINT, 1.1, 3),
        (signal.SIGTERM, 1.1, 3),
        (signal.SIGTERM, 0.001, 0),  # GNU timeout signals its child and the group
        (signal.SIGINT, 0.9, 0),
    ],
)
def test_two_signals(
    number: int, apart_s: float, turns_left: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The first one lands, a second one after a second exits immediately, except SIGHUP."""
    now_s = 100.0
    monkeypatch.setattr(clock, "monotonic_s", lambda: now_s)

    def signalled(left: int) -> None:
        nonlocal now_s
        if left >= 3:
            os.kill(os.getpid(), number)
            now_s += apart_s

    flight = Brief(5, signalled)
    outcome = fly(flight, tmp_path, lambda companion: None)
    assert flight.turns == turns_left
    assert flight.stops
    assert (outcome.exit_code == 0) is (turns_left == 0)


class Watcher:
    """A supervisor that never takes over."""

    said: tuple[str, ...] = ()
    loaded = True

    def __init__(self, *, lost: bool = False) -> None:
        self.lost, self.restarts = lost, 0

    @property
    def guards(self) -> bool:
        return not self.lost

    def restart(self) -> None:
        self.restarts += 1
        self.lost = self.restarts < 2
        if self.lost:
            raise SupervisorError("no memory")

    def has_taken_over(self) -> bool:
        return False

    def beat(self, *arguments: object) -> None: ...


def test_what_a_turn_decided_is_dropped_when_it_became_too_old(tmp_path: Path) -> None:
    """As when the process is stopped between the decision and its sending. What was announced is in
    the log as an event record, which is never sent."""
    sent: list[bytes] = []

    class Recording(Wire):
        def send(self, data: bytes, peer: object) -> None:
            sent.append(data)

    class Deciding(Brief):
        def turn(self, chunks: Sequence[Chunk], now_s: float) -> Output:
            frame, text = setpoint(self.turns), said(self.turns)
            super().turn(chunks, now_s)
            if self.turns == 1:
                time.sleep(0.25)
            self.log = [frame, text]
            return Output(send=(frame, text))

    flight = Deciding(3, lambda left: None)
    directory = tmp_path / "flight"
    with FlightLog(directory, "") as log, StopRequests() as stops:
        Loop(
            cast(Flight, flight),
            cast(Link, Recording()),
            log,
            stops=stops,
            progress=lambda companion: None,
            supervisor=cast(Supervisor, Watcher()),
        ).run()
    assert sent == [setpoint(3), said(3), setpoint(1), said(1)]
    assert flight.dropped == 2
    assert flight.announced == []  # the companion sums them up
    logged = (directory / "flight.tlog").read_bytes()
    assert (logged.count(setpoint(2)), logged.count(said(2))) == (0, 0)


def test_what_a_turn_decided_does_not_leave_after_a_take_over(tmp_path: Path) -> None:
    """The process was stopped within the turn, and the supervisor has the vehicle."""
    sent: list[bytes] = []

    class Recording(Wire):
        def send(self, data: bytes, peer: object) -> None:
            sent.append(data)

    class Taking(Watcher):
        said = ("taking over: the controller has not answered for 0.6 s", "it is disarmed")
        taken = False

        def has_taken_over(self) -> bool:
            return self.taken

        def await_end(self, timeout_s: float) -> bool:
            return True

    watcher = Taking()

    class Deciding(Brief):
        def turn(self, chunks: Sequence[Chunk], now_s: float) -> Output:
            super().turn(chunks, now_s)
            watcher.taken = self.turns == 1
            return Output(send=(setpoint(self.turns),))

    flight = Deciding(3, lambda left: None)
    with FlightLog(tmp_path / "flight", "") as log, StopRequests() as stops:
        outcome = Loop(
            cast(Flight, flight), cast(Link, Recording()), log, stops=stops,
            progress=lambda companion: None, supervisor=cast(Supervisor, watcher),
        ).run()  # fmt: skip
    assert sent == [setpoint(2)]
    assert outcome == Outcome(4, f"supervisor: {'; '.join(watcher.said)}")


def test_an_ignored_sighup_stays_ignored(tmp_path: Path) -> None:
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        flight = Brief(5, lambda left: os.kill(os.getpid(), signal.SIGHUP))
        assert fly(flight, tmp_path, lambda companion: None).exit_code == 0
    finally:
        signal.signal(signal.SIGHUP, before)
    assert flight.stops == 0


@pytest.mark.parametrize(
    ("lands", "exit_code", "stops"), [(True, 4, True), (False, 0, False)], ids=["land", "go_on"]
)
def test_a_log_that_cannot_be_written_is_said_at_once(
    lands: bool, exit_code: int, stops: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """`limits.log_lost`: a full disk in flight."""

    def full(descriptor: int, entries: list[bytes]) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(log_module, "append", full)
    says = (
        f"the log {tmp_path / 'flight' / 'flight.tlog'} cannot be written (No space left on device)"
    )
    flight = Brief(100_000, lambda left: setattr(flight, "turns", min(left, 3 * bool(left)))
                    if flight.announced else None, log=b"frame")  # fmt: skip
    flight.lands_without_log = lands
    with FlightLog(tmp_path / "flight", "", real_time=True) as log, StopRequests() as stops_:
        outcome = Loop(
            cast(Flight, flight), Wire(), log, stops=stops_,
            progress=lambda companion: None,
        ).run()  # fmt: skip
    assert flight.announced == [says]
    assert bool(flight.stops) is stops
    assert outcome.exit_code == exit_code
    assert outcome.sentence.startswith(f"{says}: ")
    assert outcome.sentence.endswith(" entries lost; flown and landed")


def failing(turns: range, error: BaseException) -> Callable[[int], None]:
    def during(left: int) -> None:
        if left in turns:
            raise error

    return during


@pytest.mark.parametrize("error", [ZeroDivisionError("no"), SystemExit(3), MemoryError()])
def test_an_exception_lands_and_ends_with_4(error: BaseException, tmp_path: Path) -> None:
    flight = Brief(5, failing(range(3, 5), error))
    outcome = fly(flight, tmp_path, lambda companion: None)
    assert (flight.turns, flight.stops, outcome.exit_code) == (0, 2, 4)
    says = " ".join(f"internal error: {type(error).__name__}: {error} ({__file__}:".split())
    assert outcome.sentence.startswith(says)
    assert outcome.sentence.endswith("; flown and landed")


def test_an_exception_is_over_when_the_service_waits_again(tmp_path: Path) -> None:
    """The flight that it ended has its own exit code; that of the service is another."""
    flight = Brief(5, failing(range(3, 5), ZeroDivisionError("no")))
    flight.phase = Phase.STANDBY
    assert fly(flight, tmp_path, lambda companion: None) == Outcome(0, "flown and landed")
    assert flight.stops == 2


@pytest.mark.parametrize(("phase", "restarts"), [(Phase.STANDBY, [4.0, 16.0]), (Phase.TRACK, [])])
def test_another_supervisor_is_started_but_not_in_flight(
    phase: Phase, restarts: list[float], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Every ten seconds, until it succeeds."""
    now_s = 0.0
    restarted_s: list[float] = []
    monkeypatch.setattr(clock, "monotonic_s", lambda: now_s)

    def later(left: int) -> None:
        nonlocal now_s
        now_s += 4.0

    class Starting(Watcher):
        def restart(self) -> None:
            restarted_s.append(now_s)
            super().restart()

    flight, watcher = Brief(6, later), Starting(lost=True)
    flight.phase = phase
    with FlightLog(tmp_path / "flight", "") as log, StopRequests() as stops:
        Loop(
            cast(Flight, flight), Wire(), log, stops=stops,
            progress=lambda companion: None, supervisor=cast(Supervisor, watcher),
        ).run()  # fmt: skip
    assert restarted_s == restarts
    assert flight.guarded is bool(restarts)
    assert flight.announced == [UNGUARDED, "another supervisor is started"][: 1 + bool(restarts)]


def test_an_exception_in_every_turn_ends_in_silence(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    now_s = 100.0
    monkeypatch.setattr(clock, "monotonic_s", lambda: now_s)

    def fails(left: int) -> None:
        nonlocal now_s
        now_s += 0.04
        raise ValueError("again")

    flight = Brief(1000, fails)
    outcome = fly(flight, tmp_path, lambda companion: None)
    assert (1000 - flight.turns, outcome.exit_code) == (8, 4)  # 0.3 s
    assert outcome.sentence.endswith("; setpoints stopped")


def framed(message: mavlink.MAVLink_message, number: int) -> bytes:
    sender = mavlink.MAVLink(None, srcSystem=1, srcComponent=191)
    sender.seq = number % 256
    return bytes(message.pack(sender))


def setpoint(number: int) -> bytes:
    message = mavlink.MAVLink_set_attitude_target_message(number, 1, 1, 7, [0] * 4, 0, 0, 0, 0)
    return framed(message, number)


def said(number: int) -> bytes:
    return framed(mavlink.MAVLink_statustext_message(number, b""), number)


@contextmanager
def connection() -> Iterator[tuple[Link, Callable[[], bytes]]]:
    with socket.create_server(("127.0.0.1", 0)) as server:
        link = open_link(f"tcp:127.0.0.1:{server.getsockname()[1]}")
        theirs, _ = server.accept()
    theirs.settimeout(10.0)
    yield link, lambda: theirs.recv(65536)
    link.close()
    theirs.close()


@contextmanager
def cable() -> Iterator[tuple[Link, Callable[[], bytes]]]:
    theirs, ours = pty.openpty()
    tty.setraw(ours)
    link = open_link(f"serial:{os.ttyname(ours)}:57600")

    def read() -> bytes:
        assert select.select([theirs], [], [], 10.0)[0], "silent"
        return os.read(theirs, 65536)

    yield link, read
    link.close()
    os.close(ours)
    os.close(theirs)


@pytest.mark.parametrize(
    ("ends", "count"), [(connection, 200_000), (cable, 5_000)]
)  # 10 MB and 250 kB, more than the buffers hold
def test_a_full_stream_does_not_block_and_sends_the_newest_setpoint(
    ends: Callable[[], AbstractContextManager[tuple[Link, Callable[[], bytes]]]], count: int
) -> None:
    heartbeat = framed(mavlink.MAVLink_heartbeat_message(18, 8, 0, 0, 4, 3), 7)
    setpoints = [setpoint(number) for number in range(count)]
    with ends() as (link, read):  # TCP breaks 5 s after the first byte that nobody reads
        for each in setpoints:
            link.send(each, None)
        link.send(heartbeat, None)
        link.send(setpoint(count), None)
        splitter, frames = FrameSplitter(True, Counters()), []
        while not frames or frames[-1].raw != setpoint(count):
            link.receive(0.0)
            frames += splitter.split(read())
    numbers = [int.from_bytes(f.payload[:4], "little") for f in frames if f.message_id == 82]
    assert all(frame.verified for frame in frames)
    assert numbers == sorted(numbers)
    assert len(numbers) < count  # queued ones were replaced
    assert numbers[-2] < count - 1  # by the last one
    assert frames[-2].raw == heartbeat


def test_a_serial_port_is_opened_once() -> None:
    """Two readers would each get a part of the telemetry."""
    ours, theirs = pty.openpty()
    address = f"serial:{os.ttyname(theirs)}:57600"
    link = open_link(address)
    with pytest.raises(LinkUnavailable, match="exclusively lock"):
        open_link(address)
    link.close()
    open_link(address).close()
    os.close(ours)
    os.close(theirs)


def test_an_unplugged_serial_link_is_silent() -> None:
    ours, theirs = pty.openpty()
    link = open_link(f"serial:{os.ttyname(theirs)}:57600")
    os.write(ours, b"abc")
    assert [(chunk.data, chunk.peer) for chunk in link.receive(0.5)] == [(b"abc", "serial")]
    os.close(theirs)
    os.close(ours)
    assert link.receive(0.01) == []
    assert link.receive(0.02) == []
    link.send(b"x", None)
    link.close()
