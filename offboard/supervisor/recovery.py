"""Recovery: what the supervisor asks of a vehicle that has lost its controller. No I/O, no clock.

Hold, and after some seconds land. Both are asked for only while the vehicle shows a mode that is
ours or that we asked for, and at most once for each report of the mode. Any other mode is the
decision of a pilot or of the vehicle's own failsafe, and final, whatever is reported after it. So
is hold that was reported before our request, that the vehicle has not acknowledged, or that comes
after the landing mode.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from offboard.mavlink.dialects.base import Dialect
from offboard.mavlink.events import CommandAck, Event, Heartbeat, ModeReport
from offboard.mavlink.outgoing import CommandLong

REPEAT_S = 0.3  # between two requests
UNHEARD_MAX = 3  # requests to a vehicle of which nothing is heard
HOLD_S = 5.0  # then land
ACKNOWLEDGED_S = 1.0  # after hold is reported: an acknowledgement that comes later was lost
FRESH_S = 2.5  # an older report of the mode is no reason for a command
LONGEST_S = 120.0


@dataclass(frozen=True, slots=True)
class Request:
    """A command, and what it asks for in a word."""

    command: CommandLong
    word: str


class Recovery:
    """Begins at `began_s`; `holding`: the vehicle was asked to hold before. `ended` says how it
    ended; empty until then."""

    def __init__(self, dialect: Dialect, began_s: float, *, holding: bool = False) -> None:
        self._dialect = dialect
        self._holding = holding
        self._began_s = began_s
        self._mode: str | None = None
        self._reported_s = -math.inf
        self._armed = True
        self._begun = False  # all that had waited was seen
        self._first_s = math.inf  # time of the first request
        self._asked_s = -math.inf
        self._acknowledged = False
        self._landing = False  # the landing mode was shown
        self._left_for = ""  # the mode that nobody of us has asked for
        self._left_s = -math.inf
        self._heartbeat_s = -math.inf
        self._requests = 0
        self._held_s = math.inf  # since when it holds
        self.refusal = ""  # of the newest request
        self.ended = ""

    def see(self, event: Event, at_s: float) -> None:
        """An event of the vehicle that arrived at `at_s` at the latest, which may be before
        `began_s`."""
        match event:
            case Heartbeat(mode, armed):
                self._armed, self._heartbeat_s = armed, at_s
                self._on_mode(mode, at_s)
            case ModeReport(mode):
                self._on_mode(mode, at_s)
            case CommandAck(_, result) if result not in ("ACCEPTED", "IN_PROGRESS"):
                self.refusal = result
            case CommandAck(command) if command == self._dialect.hold().command:
                self._acknowledged |= at_s > self._first_s

    def _on_mode(self, mode: str, at_s: float) -> None:
        self._mode, self._reported_s = mode, at_s
        ours = mode in (self._dialect.engage_mode, self._dialect.land_mode)
        if mode == self._dialect.hold_mode and not self._landing:
            ours = self._holding or at_s > self._first_s
        self._landing |= mode == self._dialect.land_mode
        if not ours and not self._left_for:
            self._left_for, self._left_s = mode, at_s
        elif ours and not self._begun:  # of the reports that have waited the newest decides
            self._left_for = ""

    def due(self, now_s: float) -> Request | None:
        """What to ask for now."""
        self._begun = True
        self._conclude(now_s)
        if self.ended or self._left_for or now_s - self._asked_s < REPEAT_S:
            return None
        request = self._wanted(now_s)
        if request:
            self._first_s, self._asked_s = min(self._first_s, now_s), now_s
            self._requests += 1
        return request

    def _conclude(self, now_s: float) -> None:
        """Note when it holds, and when this is over."""
        holds = self._mode == self._dialect.hold_mode
        self._held_s = min(self._held_s, now_s) if holds else math.inf
        ours = self._holding or self._acknowledged
        # PX4 leaves its landing mode when it disarms, which HEARTBEAT shows later
        shown = not self._landing or self._heartbeat_s >= self._left_s
        if not self._armed:
            self.ended = "the vehicle is disarmed"
        elif self._left_for and shown:
            self.ended = f"the vehicle shows {self._left_for}: its pilot or its failsafe has it"
        elif not ours and now_s - self._held_s > ACKNOWLEDGED_S:
            self.ended = (
                f"the vehicle shows {self._mode}, and has not acknowledged the request: its pilot "
                "or its failsafe has it"
            )
        elif now_s - self._began_s > LONGEST_S:
            self.ended = f"not landed after {LONGEST_S:.0f} s"

    def _wanted(self, now_s: float) -> Request | None:
        if self._mode is None:
            return self._hold() if self._requests < UNHEARD_MAX else None
        answered = self._reported_s > self._asked_s and now_s - self._reported_s < FRESH_S
        if not answered or self._mode == self._dialect.land_mode:
            return None
        if self._mode == self._dialect.engage_mode:
            return self._hold() if now_s - self._began_s < HOLD_S else self._land()
        return self._land() if now_s - self._held_s >= HOLD_S else None

    def _hold(self) -> Request:
        return Request(self._dialect.hold(), "hold")

    def _land(self) -> Request:
        return Request(self._dialect.land(), "land")
