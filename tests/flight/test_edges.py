"""The loop, the log and its background writer when terminal, pipe, disk or supervisor fails, and
under signals. No failure blocks the caller, and lost entries are counted."""

from __future__ import annotations

import os
import re
import signal
import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from pymavlink.dialects.v20 import common as mavlink

from offboard.documents.errors import Unavailable
from offboard.flight.phases import ExitCode, Limits, Outcome, Phase
from offboard.link import clock
from offboard.link import log as log_module
from offboard.link.background import BackgroundWriter
from offboard.link.interface import LinkReport
from offboard.link.log import FlightLog
from offboard.link.stop import StopRequests
from offboard.run.loop import ANSWERS, UNANSWERED, UNGUARDED, Loop

FLOWN = Outcome(0, "flown and landed")
UNIX_US = 1_767_225_600_000_000
TIMEOUT_S = 20.0


class Silent:
    """An object on which every method call returns nothing."""

    def __getattr__(self, name: str) -> Any:
        return lambda *arguments: ()


class Wire(Silent):
    """A link without traffic from the vehicle. `sent` are the frames that were sent; `waits` is
    called while the loop waits for telemetry; `read` counts how often the link was read."""

    is_stream, read = False, 0

    def __init__(self, waits: Callable[[], object] = lambda: None) -> None:
        self.report = LinkReport()
        self.sent: list[bytes] = []
        self.waits = waits

    def wait(self, timeout_s: float) -> None:
        self.waits()

    def receive(self) -> list[Any]:
        self.read += 1
        return []

    def send(self, data: bytes, peer: object) -> None:
        self.sent.append(data)


class Brief(Silent):
    """A companion whose flight lasts `turns` turns, and which counts stop requests. `during` is
    called in each turn; `sends` are the frames that a turn sends, `log` those that it logs."""

    session, outcome = SimpleNamespace(peer=None), None
    in_end_phase = False
    ends_with = FLOWN
    guarded = True
    limits = Limits()
    stops = dropped = 0
    sends: Sequence[bytes] = ()

    def __init__(
        self,
        turns: int,
        during: Callable[[int], object] = lambda left: None,
        *,
        phase: Phase = Phase.TRACK,
        log: Sequence[bytes] = (),
    ) -> None:
        self.turns, self.during, self.phase, self.log = turns, during, phase, log
        self.current = self
        self.supervised = None
        self.announced: list[str] = []
        self.announce = self.announced.append

    def turn(self, chunks: Sequence[Any], now_s: float) -> tuple[bytes, ...]:
        self.turns -= 1
        self.during(self.turns)
        if self.turns == 0:
            self.outcome = self.ends_with
        return tuple(self.sends)

    def finish_turn(self, sent_s: float) -> Sequence[bytes]:
        return self.log

    def has_ended(self) -> bool:
        return self.outcome is not None

    def request_stop(self, why: str = "") -> None:
        self.stops += 1

    def on_dropped(self, frames: int) -> None:
        self.dropped += frames

    def guard(self, guarded: bool) -> None:
        self.guarded = guarded


class Watcher(Silent):
    """A supervisor that takes over if `taken` is set, and does not answer if `answers` is unset."""

    loaded, taken, lost, answers, restarts = True, False, False, True, 0
    said = ("taking over: the controller has not answered for 0.6 s", "it is disarmed")

    @property
    def guards(self) -> bool:
        return self.answers and not self.lost

    def restart(self) -> None:
        self.restarts += 1
        self.lost = self.restarts < 2
        if self.lost:
            raise Unavailable("no memory")

    def has_taken_over(self) -> bool:
        return self.taken

    def await_end(self, timeout_s: float) -> bool:
        return True


def fly(
    flight: Any,
    directory: Path,
    progress: Callable[[Any], None] = lambda companion: None,
    *,
    link: Any = None,
    supervisor: Any = None,
    simulator: Any = None,
    **options: Any,
) -> Outcome:
    with FlightLog(directory / "flight", "", **options) as log, StopRequests() as stops:
        return Loop(
            flight,
            link or Wire(),
            log,
            stops=stops,
            progress=progress,
            supervisor=supervisor,
            simulator=simulator,
        ).run()


@pytest.fixture
def now_s(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """Monotonic time, which stands still until the test changes the only item of this list."""
    now = [100.0]
    monkeypatch.setattr(clock, "monotonic_s", lambda: now[0])
    return now


# -- the terminal, and signals ---------------------------------------------------------------------


@pytest.mark.parametrize("failure", [SystemExit(1), BrokenPipeError()])
def test_a_closed_terminal_does_not_end_the_flight(tmp_path: Path, failure: BaseException) -> None:
    shown: list[Any] = []

    def progress(companion: Any) -> None:
        shown.append(companion)
        raise failure

    flight = Brief(5)
    assert fly(flight, tmp_path, progress) == FLOWN
    assert (flight.turns, len(shown), flight.stops) == (0, 1, 0)


@pytest.mark.parametrize(
    ("number", "apart_s", "turns_left"),
    [
        (signal.SIGHUP, 1.1, 0),
        (signal.SIGTERM, 1.1, 3),
        (signal.SIGTERM, 0.001, 0),  # GNU timeout signals its child and the group
        (signal.SIGINT, 0.9, 0),
    ],
)
def test_second_signal_stops_the_flight_except_sighup(
    number: int, apart_s: float, turns_left: int, tmp_path: Path, now_s: list[float]
) -> None:
    """The first signal lands. A second one a second later exits at once, except SIGHUP."""

    def signalled(left: int) -> None:
        if left >= 3:
            os.kill(os.getpid(), number)
            now_s[0] += apart_s

    flight = Brief(5, signalled)
    outcome = fly(flight, tmp_path)
    assert flight.turns == turns_left
    assert flight.stops
    assert (outcome.exit_code == 0) is (turns_left == 0)


def test_landing_interrupted_by_signals_is_aborted(tmp_path: Path, now_s: list[float]) -> None:
    class Landing(Brief):
        outcome = Outcome(ExitCode.FLOWN, "stop requested")

        def has_ended(self) -> bool:
            return self.turns == 0

    def signalled(left: int) -> None:
        os.kill(os.getpid(), signal.SIGINT)
        now_s[0] += 1.1

    outcome = fly(Landing(5, signalled), tmp_path)
    assert outcome.exit_code == ExitCode.ABORTED
    assert outcome.sentence.startswith("stop requested; interrupted twice: setpoints stopped")


def test_a_third_signal_interrupts_a_law_that_hangs(
    tmp_path: Path, now_s: list[float], monkeypatch: pytest.MonkeyPatch
) -> None:
    def hang(left: int) -> None:
        for _ in range(3):
            os.kill(os.getpid(), signal.SIGINT)
            now_s[0] += 1.1
        pytest.fail("it is not interrupted")

    def close(log: FlightLog) -> None:  # another signal arrives while the log is written
        monkeypatch.setattr(FlightLog, "close", ended)
        os.kill(os.getpid(), signal.SIGINT)
        log.close()

    ended = FlightLog.close
    monkeypatch.setattr(FlightLog, "close", close)
    outcome = fly(Brief(5, hang), tmp_path)
    assert outcome.exit_code == 4
    assert outcome.sentence.startswith("interrupted twice")


def test_an_ignored_sighup_stays_ignored(tmp_path: Path) -> None:
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        flight = Brief(5, lambda left: os.kill(os.getpid(), signal.SIGHUP))
        assert fly(flight, tmp_path) == FLOWN
    finally:
        signal.signal(signal.SIGHUP, before)
    assert flight.stops == 0


# -- the supervisor --------------------------------------------------------------------------------


def test_messages_of_a_slow_turn_are_dropped(tmp_path: Path) -> None:
    """This happens if the process is stopped between the decision and sending. A dropped text stays
    in the log as an event record, which is never sent."""

    def decide(left: int) -> None:
        flight.sends = flight.log = (setpoint(left), said(left))
        if left == 1:
            time.sleep(0.25)

    flight, link = Brief(3, decide), Wire()
    fly(flight, tmp_path, link=link, supervisor=Watcher())
    assert link.sent == [setpoint(2), said(2), setpoint(0), said(0)]
    assert flight.dropped == 2
    assert flight.announced == []  # the companion announces the total of dropped messages
    logged = (tmp_path / "flight" / "flight.tlog").read_bytes()
    assert (logged.count(setpoint(1)), logged.count(said(1))) == (0, 0)


def test_messages_are_not_sent_after_a_supervisor_take_over(tmp_path: Path) -> None:
    """The process was stopped during the turn, and the supervisor has taken over."""

    def decide(left: int) -> None:
        flight.sends = (setpoint(left),)
        watcher.taken = left == 1

    flight, watcher, link = Brief(3, decide), Watcher(), Wire()
    outcome = fly(flight, tmp_path, link=link, supervisor=watcher)
    assert link.sent == [setpoint(2)]
    assert outcome == Outcome(4, f"supervisor: {'; '.join(watcher.said)}")


def test_controller_does_not_read_the_link_after_a_take_over(tmp_path: Path) -> None:
    """The controller was stopped while it waited for telemetry. Both processes read the same link:
    the controller must not take the COMMAND_ACKs for the supervisor's commands."""

    def stopped() -> None:
        watcher.taken = link.read == 2

    watcher, link = Watcher(), Wire(stopped)
    assert fly(Brief(5), tmp_path, link=link, supervisor=watcher).exit_code == 4
    assert link.read == 2


def test_supervisor_that_took_over_is_not_reported_as_silent(tmp_path: Path) -> None:
    """The controller was stopped at the end of a turn."""

    def stopped(sent_s: float) -> Sequence[bytes]:
        watcher.taken, watcher.answers = True, False
        return ()

    flight, watcher = Brief(5), Watcher()
    flight.finish_turn = stopped  # type: ignore[method-assign]
    assert fly(flight, tmp_path, supervisor=watcher).exit_code == 4
    assert UNANSWERED not in flight.announced


def test_supervisor_silence_and_return_are_announced_once(
    tmp_path: Path,
) -> None:
    guarded: list[bool] = []

    def stop_and_continue(left: int) -> None:
        guarded.append(flight.guarded)
        watcher.answers = left not in (6, 5, 4)

    flight, watcher = Brief(9, stop_and_continue), Watcher()
    assert fly(flight, tmp_path, supervisor=watcher) == FLOWN
    assert flight.announced == [UNANSWERED, ANSWERS]
    assert guarded == [True] * 3 + [False] * 3 + [True] * 3


@pytest.mark.parametrize(("phase", "restarts"), [(Phase.STANDBY, [4.0, 16.0]), (Phase.TRACK, [])])
def test_supervisor_is_restarted_only_outside_flight(
    phase: Phase, restarts: list[float], tmp_path: Path, now_s: list[float]
) -> None:
    """A start is tried every ten seconds until it succeeds."""
    restarted_s: list[float] = []

    class Starting(Watcher):
        lost = True

        def restart(self) -> None:
            restarted_s.append(now_s[0] - 100.0)
            super().restart()

    flight = Brief(6, lambda left: now_s.__setitem__(0, now_s[0] + 4.0), phase=phase)
    fly(flight, tmp_path, supervisor=Starting())
    assert restarted_s == restarts
    assert flight.guarded is bool(restarts)
    assert flight.announced == [UNGUARDED, ANSWERS][: 1 + bool(restarts)]


# -- what fails in this process --------------------------------------------------------------------


@pytest.mark.parametrize("lands", [True, False], ids=["land", "go_on"])
def test_log_write_error_is_announced_in_flight(
    lands: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The disk becomes full in flight, with either value of `limits.log_lost`."""

    def full(descriptor: int, entries: list[bytes]) -> None:
        raise OSError(28, "No space left on device")

    def end_soon(left: int) -> None:
        if flight.announced:
            flight.turns = min(left, 3 * bool(left))

    monkeypatch.setattr(log_module, "append", full)
    log = tmp_path / "flight" / "flight.tlog"
    says = f"the log {log} cannot be written (No space left on device)"
    flight = Brief(100_000, end_soon, log=(b"frame",))
    flight.limits = Limits(log_lost="land" if lands else "go_on")
    flight.ends_with = Outcome(0, says if lands else "flown and landed")
    outcome = fly(flight, tmp_path, real_time=True)
    assert flight.announced == [says]
    assert bool(flight.stops) is lands
    assert outcome.exit_code == (4 if lands else 0)
    ends = "entries lost" if lands else "entries lost; flown and landed"
    assert re.fullmatch(f"{re.escape(says)}: [1-9][0-9]* {ends}", outcome.sentence)


@pytest.mark.parametrize("phase", [Phase.TRACK, Phase.STANDBY])
@pytest.mark.parametrize("error", [ZeroDivisionError("no"), SystemExit(3)])
def test_exception_requests_a_landing_and_ends_with_code_4(
    error: BaseException, phase: Phase, tmp_path: Path
) -> None:
    """Except if the service is in standby again: the flight that the exception ended has an exit
    code of its own; and before takeoff, where the flight is refused."""

    def fails(left: int) -> None:
        if left in (3, 4):
            raise error

    flight = Brief(5, fails, phase=phase)
    outcome = fly(flight, tmp_path)
    assert (flight.turns, flight.stops) == (0, 2)
    if phase is Phase.STANDBY:
        assert outcome == FLOWN
    else:
        assert outcome.exit_code == 4
        assert outcome.sentence.startswith(f"internal error: {type(error).__name__}: {error} (")
        assert outcome.sentence.endswith("; flown and landed")
        refused = Brief(5, fails, phase=phase)
        refused.ends_with = Outcome(3, "before takeoff")
        assert fly(refused, tmp_path / "refused").exit_code == 3


@pytest.mark.parametrize(("simulator", "turns"), [(None, 8), (Silent(), 1)])  # 0.3 s
def test_exception_in_every_turn_stops_setpoints(
    simulator: object, turns: int, tmp_path: Path, now_s: list[float]
) -> None:
    """With the simulator the flight ends at once: in lockstep the simulator waits for the answer to
    the failed turn."""

    def fails(left: int) -> None:
        now_s[0] += 0.04
        raise ValueError("again")

    flight = Brief(1000, fails)
    outcome = fly(flight, tmp_path, simulator=simulator)
    assert (1000 - flight.turns, outcome.exit_code) == (turns, 4)
    assert outcome.sentence.endswith("; setpoints stopped")


# -- the background writer -------------------------------------------------------------------------


class Disk:
    """A disk that writes nothing until `free` is set."""

    def __init__(self) -> None:
        self.free, self.asked = threading.Event(), threading.Event()
        self.items: list[int] = []

    def write(self, items: list[int]) -> None:
        self.asked.set()
        assert self.free.wait(TIMEOUT_S)
        self.items += items


def test_background_writer_that_waits_loses_nothing() -> None:
    disk = Disk()
    disk.free.set()
    writer = BackgroundWriter(disk.write, 100, waits=True)
    for number in range(2000):
        writer.put(number)
    writer.close(TIMEOUT_S)
    assert (disk.items, writer.dropped) == ([*range(2000)], 0)


def test_background_writer_stops_after_an_error() -> None:
    """For example of a display: rich raises SystemExit if nobody reads its pipe."""
    failure = SystemExit(1)

    def write(_: list[int]) -> None:
        raise failure

    writer = BackgroundWriter(write, 100)
    writer.put(0)
    writer.close(TIMEOUT_S)
    writer.put(1)
    assert (writer.error, writer.dropped) == (failure, 2)


def test_hung_disk_is_reported_with_all_entries_lost(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    disk = Disk()
    monkeypatch.setattr(log_module, "append", lambda descriptor, entries: disk.write([]))
    monkeypatch.setattr(log_module, "QUEUED_MAX", 100)
    monkeypatch.setattr(log_module, "CLOSE_S", 0.05)
    with FlightLog(tmp_path / "x", "", real_time=True) as log:
        for number in range(300):
            log.write(UNIX_US + number, b"x")
        assert log.problem == f"the log {log.path} cannot be written (the disk is too slow)"
    assert log.lost == 300
    disk.free.set()


# -- frames ----------------------------------------------------------------------------------------


def framed(message: mavlink.MAVLink_message, number: int) -> bytes:
    sender = mavlink.MAVLink(None, srcSystem=1, srcComponent=191)
    sender.seq = number % 256
    return bytes(message.pack(sender))


def setpoint(number: int) -> bytes:
    message = mavlink.MAVLink_set_attitude_target_message(number, 1, 1, 7, [0] * 4, 0, 0, 0, 0)
    return framed(message, number)


def said(number: int) -> bytes:
    return framed(mavlink.MAVLink_statustext_message(number, b""), number)
