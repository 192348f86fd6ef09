"""The loop: link -> companion -> link and log, paced by the vehicle's telemetry."""

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

    `progress` is called often, to show the companion's announcements to the user.
    `simulator_ended` says how the bundled simulator ended, or None while it runs.
    """

    def __init__(
        self,
        companion: Companion,
        link: Link,
        log: FlightLog,
        *,
        stops: StopRequests,
        progress: Callable[[Companion], None],
        simulator_ended: Callable[[], Ending | None] = lambda: None,
    ) -> None:
        self._companion = companion
        self._link = link
        self._log = log
        self._stops = stops
        self._progress = progress
        self._simulator_ended = simulator_ended
        self._log_error: str | None = None
        self._ended_early: Outcome | None = None

    def run(self) -> Outcome:
        """Fly to the end. The first stop request lands, a second one exits immediately."""
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
                "interrupted twice: setpoints stopped, the vehicle's own failsafe takes over",
            )
        if self._log_error:
            return Outcome(outcome.exit_code or ExitCode.ABORTED, self._log_error)
        return outcome

    def _fly(self) -> None:
        companion, link = self._companion, self._link
        checked_s = clock.monotonic_s()
        while not (companion.has_ended() or self._stops.repeated or self._ended_early):
            if self._stops.requested:
                companion.request_stop()
            chunks = link.receive(POLL_S)
            now_s = clock.monotonic_s()
            self._deliver(companion.turn(chunks, now_s), companion.peer)
            self._show()
            if not chunks or now_s - checked_s > POLL_S:
                checked_s = now_s
                self._check_simulator()

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
        """Show the progress. A closed pipe or a lost terminal does not end the flight."""
        try:
            self._progress(self._companion)
        except (Exception, SystemExit):
            self._progress = lambda companion: None

    def _check_simulator(self) -> None:
        """End the flight if the bundled simulator has ended."""
        ended = None if self._companion.has_ended() else self._simulator_ended()
        if ended is None:
            return
        code = ExitCode.ABORTED
        if self._companion.phase in BEFORE_FLIGHT:
            code = ExitCode.USAGE if ended.unusable else ExitCode.REFUSED
        self._ended_early = Outcome(code, ended.sentence)
