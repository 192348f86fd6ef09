"""The loop on real sockets: link -> companion -> link and log, paced by the vehicle's telemetry."""

from __future__ import annotations

import gc
from collections.abc import Callable, Hashable

from offboard.flight import clock
from offboard.flight.companion import Companion, Outcome, Output
from offboard.flight.link import Link
from offboard.flight.log import FlightLog
from offboard.flight.phases import BEFORE_FLIGHT, ExitCode
from offboard.flight.sitl import Ending
from offboard.flight.stop import StopRequests

POLL_S = 0.02


class Loop:
    """Moves bytes between one link, one companion and one log until the flight ends.

    `lockstep` makes the vehicle's time the link's time: then nothing that is sent depends on the
    wall clock, and two flights with one seed send the same bytes.
    """

    def __init__(
        self,
        companion: Companion,
        link: Link,
        log: FlightLog,
        *,
        stops: StopRequests,
        lockstep: bool,
        progress: Callable[[Companion], None],
        vehicle_process_ended: Callable[[], Ending | None] = lambda: None,
    ) -> None:
        self._companion = companion
        self._link = link
        self._log = log
        self._stops = stops
        self._lockstep = lockstep
        self._machine = progress
        self._vehicle_process_ended = vehicle_process_ended
        self._log_error: str | None = None
        self._ended_early: Outcome | None = None

    def run(self) -> Outcome:
        """Fly to the end. A stop request lands; who insists leaves."""
        self._stops.in_flight = True
        gc.collect()
        gc.freeze()
        self._fly()
        self._show()
        if self._ended_early:
            return self._ended_early
        outcome = self._companion.outcome
        if outcome is None:
            return Outcome(
                ExitCode.ABORTED,
                "interrupted twice: the stream stopped and the vehicle is left to its own failsafe",
            )
        if self._log_error:
            return Outcome(outcome.exit_code or ExitCode.ABORTED, self._log_error)
        return outcome

    def _fly(self) -> None:
        companion, link = self._companion, self._link
        link.receive(0.0)  # what waited while we prepared is old
        heard_s = polled_s = clock.monotonic_s()
        while not (companion.has_ended() or self._stops.insisted or self._ended_early):
            if self._stops.asked:
                companion.request_stop()
            chunks = link.receive(POLL_S)
            now_s = clock.monotonic_s()
            for data, peer in chunks:
                output = companion.receive(data, peer, self._time_s(now_s))
                if output.alive:
                    heard_s = now_s
                self._deliver(output, peer)
                self._show()
                if companion.has_ended():
                    break
            if not chunks or now_s - polled_s > POLL_S:
                polled_s = now_s
                self._deliver(companion.poll(self._time_s(now_s), now_s - heard_s), companion.peer)
                self._show()
                self._check_process()

    def _time_s(self, now_s: float) -> float:
        return self._companion.view.time_s if self._lockstep else now_s

    def _deliver(self, output: Output, peer: Hashable | None) -> None:
        target = self._companion.peer or peer
        for frame in output.send:
            self._link.send(frame, target)
        if self._log_error:
            return
        try:
            stamp = clock.unix_us()
            for frame in output.log:
                self._log.write(stamp, frame)
        except OSError as error:
            self._log_error = f"the log {self._log.path} cannot be written ({error.strerror})"
            self._companion.request_stop(self._log_error)

    def _show(self) -> None:
        """Tell the user. A closed pipe or a lost terminal ends the showing, not the flight."""
        try:
            self._machine(self._companion)
        except (Exception, SystemExit):
            self._machine = lambda companion: None

    def _check_process(self) -> None:
        """A simulator that ended will not be waited for."""
        ended = None if self._companion.has_ended() else self._vehicle_process_ended()
        if ended is None:
            return
        code = ExitCode.ABORTED
        if self._companion.phase in BEFORE_FLIGHT:
            code = ExitCode.USAGE if ended.unusable else ExitCode.REFUSED
        self._ended_early = Outcome(code, ended.sentence)
