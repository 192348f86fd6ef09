"""The loop of a flight: passes received bytes to the flight, or to the service, and its frames to
link and log. The telemetry of the vehicle paces it."""

from __future__ import annotations

import gc
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Any, Protocol

from offboard.documents.errors import Unavailable, located
from offboard.flight.flight import Flight
from offboard.flight.phases import BEFORE_FLIGHT, WAITING, ExitCode, Outcome
from offboard.link import clock
from offboard.link.interface import Chunk, Link
from offboard.link.stop import StopRequests
from offboard.run.sitl import Ending, InMemorySimulator, SimulatorProcess
from offboard.supervisor.supervisor import Supervisor

POLL_S = 0.02  # longest wait for telemetry in a turn
SEND_WITHIN_S = 0.2  # after the beginning of a turn; later its frames are dropped
FAILING_S = 0.3  # the loop ends after this time without a successful turn
SIMULATOR_S = 180.0  # longest wait (wall time) for the bundled simulator, which may compile
UNGUARDED = "the supervisor ended: nobody lands the vehicle if this process dies"
UNANSWERED = "the supervisor does not answer: nobody lands the vehicle if this process dies"
ANSWERS = "the supervisor answers again"
RESTART_S = 10.0  # between two attempts to start another supervisor


class Flown(Protocol):
    """A flight, or the flights of a service; `current` is the one that waits or flies."""

    @property
    def current(self) -> Flight: ...
    def turn(self, chunks: Sequence[Chunk], now_s: float) -> tuple[bytes, ...]: ...
    def has_ended(self) -> bool: ...
    def request_stop(self, why: str = ...) -> None: ...


class Log(Protocol):
    """What the loop needs from a log. Only `close` may wait."""

    @property
    def problem(self) -> str: ...
    @property
    def lost(self) -> int: ...
    @property
    def descriptor(self) -> int: ...
    def write(self, unix_us: int, frame: bytes) -> None: ...
    def close(self) -> None: ...


class Loop:
    """Moves bytes between one link, one flight (or the service) and one log until the flight ends.

    `progress` is called often, to show the flight's announcements to the user; it must not wait.
    A flight in the bundled `simulator` ends after SIMULATOR_S without a datagram. All other
    vehicles have a `supervisor`, a process that outlives this one.
    """

    def __init__(
        self,
        flown: Flown,
        link: Link,
        log: Log,
        *,
        stops: StopRequests,
        progress: Callable[[Any], None],
        simulator: SimulatorProcess | InMemorySimulator | None = None,
        supervisor: Supervisor | None = None,
    ) -> None:
        self._flown = flown
        self._link = link
        self._log = log
        self._stops = stops
        self._progress = progress
        self._simulator = simulator
        self._supervisor = supervisor
        self._warned: set[str] = set()
        self._unguarded = ""  # UNGUARDED or UNANSWERED once announced; empty while it guards
        self._error = ""  # the first exception of this flight, as a sentence
        self._restarted_s = -RESTART_S
        self._succeeded_s = self._heard_s = clock.monotonic_s()
        self._ended_early: Outcome | None = None

    def run(self) -> Outcome:
        """Run until the flight ends. The first stop request lands the vehicle, the second one ends
        the loop immediately."""
        self._stops.in_flight = self._stops.interruptible = True
        gc.collect()
        if not gc.get_freeze_count():  # an earlier flight in this process may have done this
            gc.freeze()
        self._succeeded_s = self._heard_s = clock.monotonic_s()
        while not (self._flown.has_ended() or self._stops.repeated or self._ended_early):
            try:
                self._turn()
                self._succeeded_s = clock.monotonic_s()
                if self._flown.current.phase in WAITING:
                    self._error = ""  # the flight that the error ended is over
            except BaseException as error:  # a control law may even raise SystemExit
                is_usual = isinstance(error, Exception | SystemExit | KeyboardInterrupt)
                if self._simulator and not is_usual:
                    raise  # a test runner ends its test (pytest-timeout)
                if not self._stops.repeated:  # a third signal interrupts a law that hangs
                    self._hand_back(error)
        self._stops.interruptible = False  # another signal must not lose log and outcome
        self._show()
        return self._outcome()

    def _turn(self) -> None:
        """Receive, decide, send and log once.

        The operating system may have stopped this process, most likely while it waited. Therefore
        nothing is read before it is known whether the supervisor, which reads the same link, has
        taken over.
        """
        self._link.wait(POLL_S)
        if self._taken_over():
            return
        if self._stops.requested:
            self._flown.request_stop()
        chunks = self._link.receive()
        began_s = clock.monotonic_s()
        if chunks:
            self._heard_s = began_s
        frames = self._flown.turn(chunks, began_s)
        if self._taken_over():
            return
        dropped = self._send(frames, began_s)
        stamp = clock.unix_us()
        for frame in self._flown.current.finish_turn(clock.monotonic_s()):
            if frame not in dropped:
                self._log.write(stamp, frame)
        report = self._link.report
        self._flown.current.other_datagrams = report.ignored
        self._flown.current.overhear(report.overheard)
        report.overheard = []
        for sentence in report.news():
            self._flown.current.announce(sentence)
        self._check_log()
        self._check_supervisor()
        self._show()
        self._check_simulator(began_s - self._heard_s)

    def _send(self, frames: Sequence[bytes], began_s: float) -> list[bytes]:
        """Send the frames of a turn that began at host time `began_s`. With a supervisor, drop and
        return those that are more than SEND_WITHIN_S late, because this process was stopped."""
        peer = self._flown.current.session.peer
        dropped: list[bytes] = []
        for frame in frames:
            if self._supervisor and clock.monotonic_s() - began_s > SEND_WITHIN_S:
                dropped.append(frame)
            else:
                self._link.send(frame, peer)
        if dropped:
            self._flown.current.on_dropped(len(dropped))
        if peer is not None:
            self._link.follow(peer)
            if self._supervisor and (supervised := self._flown.current.supervised):
                self._supervisor.beat(supervised, peer, self._link, self._log.descriptor)
        return dropped

    # --- the supervisor ---

    def _check_supervisor(self) -> None:
        """Announce whether the supervisor guards the flight. Restart one that has ended, but only
        in a phase in `WAITING`: a restart blocks the loop for some milliseconds."""
        supervisor, current = self._supervisor, self._flown.current
        if supervisor is None or supervisor.has_taken_over():  # it may have during this turn
            return
        guards = supervisor.guards
        current.guard(guards)
        if supervisor.loaded:
            unguarded = "" if guards else UNGUARDED if supervisor.lost else UNANSWERED
            if unguarded != self._unguarded:
                self._unguarded = unguarded
                current.announce(unguarded or ANSWERS)
        now_s = clock.monotonic_s()
        waits = current.phase in WAITING and now_s - self._restarted_s >= RESTART_S
        if supervisor.lost and waits:
            self._restarted_s = now_s
            with suppress(Unavailable):
                supervisor.restart()

    def _taken_over(self) -> bool:
        """Whether the supervisor has taken over; if so, wait until it has finished."""
        supervisor = self._supervisor
        if supervisor is None or not supervisor.has_taken_over():
            return False
        ended = False
        while not (ended or self._stops.requested):
            ended = supervisor.await_end(POLL_S)
            for sentence in supervisor.said:
                self._warn(f"supervisor: {sentence}")
            self._show()
        self._ended_early = Outcome(ExitCode.ABORTED, f"supervisor: {'; '.join(supervisor.said)}")
        return True

    # --- what may go wrong ---

    def _hand_back(self, error: BaseException) -> None:
        """Request a landing after an exception in a turn. End the loop if turns keep failing: then
        setpoints stop and the supervisor takes over. With the bundled simulator end it at once,
        because the simulator waits for the reply that this turn did not send."""
        sentence = f"internal error: {located(error)}"
        self._error = self._error or sentence
        with suppress(BaseException):
            self._flown.request_stop(self._error)
        if self._simulator or clock.monotonic_s() - self._succeeded_s > FAILING_S:
            self._ended_early = Outcome(ExitCode.ABORTED, f"{self._error}; setpoints stopped")

    def _check_log(self) -> None:
        problem = self._log.problem
        if problem:
            self._warn(problem)
            if self._flown.current.limits.log_lost == "land":
                self._flown.request_stop(problem)

    def _warn(self, sentence: str) -> None:
        """Announce `sentence`, once in the life of this loop."""
        if sentence not in self._warned:
            self._warned.add(sentence)
            self._flown.current.announce(sentence)

    def _show(self) -> None:
        """Call `progress`. If it fails, it is not called again, and the flight goes on."""
        try:
            self._progress(self._flown)
        except (Exception, SystemExit):
            self._progress = lambda flight: None

    def _check_simulator(self, silent_s: float) -> None:
        """End the flight if the bundled simulator has ended, or has not sent for SIMULATOR_S."""
        if self._simulator is None or self._flown.has_ended():
            return
        ending = self._simulator.ending()
        if ending is None and silent_s > SIMULATOR_S:
            ending = Ending(f"the bundled simulator has not answered for {silent_s:.1f} s", False)
        if ending is None:
            return
        code = ExitCode.ABORTED
        if self._flown.current.phase in BEFORE_FLIGHT:
            code = ExitCode.USAGE if ending.unusable else ExitCode.REFUSED
        self._ended_early = Outcome(code, ending.sentence)

    # --- the end ---

    def _outcome(self) -> Outcome:
        """Close the log, so that the number of lost entries is final, and return the outcome."""
        self._log.close()
        outcome = self._ended_early or self._flown.current.outcome
        ended = self._flown.has_ended() or self._flown.current.in_end_phase
        if outcome is None or not (self._ended_early or ended):
            outcome = self._interrupted(outcome)
        code, sentence = outcome.exit_code, outcome.sentence
        if self._error:
            code = code or ExitCode.ABORTED
            sentence = sentence if self._error in sentence else f"{self._error}; {sentence}"
        if self._log.problem:
            lands = self._flown.current.limits.log_lost == "land"
            code = code or (ExitCode.ABORTED if lands else ExitCode.FLOWN)
            problem = self._log.problem
            lost = f"{problem}: {self._log.lost} entries lost"
            named = sentence.startswith(problem)  # the log's problem was the reason to land
            sentence = lost + (sentence.removeprefix(problem) if named else f"; {sentence}")
        return Outcome(code, sentence, self._log.problem)

    def _interrupted(self, before: Outcome | None) -> Outcome:
        follows = "the supervisor lands the vehicle" if self._supervisor else "the simulation ends"
        sentence = f"interrupted twice: setpoints stopped, {follows}"
        said = f"{before.sentence}; {sentence}" if before else sentence
        return Outcome(ExitCode.ABORTED, said)
