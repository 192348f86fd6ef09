"""What the user is told beside the phases: what is waited for, and a computer that is late."""

from __future__ import annotations

import math
import re

from offboard.documents.repeated import Repeated
from offboard.flight import preflight
from offboard.flight.phases import Phase
from offboard.flight.starting import ground_of
from offboard.flight.state import FlightState
from offboard.mavlink.session import Session

PAUSED = "this computer paused for {most:.2f} s{times}: no setpoint before the mode is reported"
DROPPED = (
    "{total:.0f} of our messages to the vehicle dropped: this computer was too busy, and they "
    "became too old"
)
# In a phase, before the first reason: telemetry has only just been requested, checks are running
FIRST_S = {Phase.CONNECT: 2.5, Phase.HEALTH: 5.0}
CHANGED_S = 1.0  # between two reasons
AGAIN_S = 10.0  # the same reason, in other figures too


class Waiting:
    """Says why the flight does not begin: a new reason at most once a second. One that a found
    vehicle has is repeated every ten, with its figures; that none is heard is said once."""

    def __init__(self) -> None:
        self._kind = ""  # of the newest reason: without its figures
        self._said_s = -math.inf

    def news(self, state: FlightState, session: Session, now_s: float) -> str:
        """A sentence to say at `now_s`, of any clock; empty without one."""
        if state.phase not in FIRST_S:
            self._kind = ""
            return ""
        if state.in_phase_s < FIRST_S[state.phase] or now_s - self._said_s < CHANGED_S:
            return ""
        reason = _unheard(session) if state.phase is Phase.CONNECT else _unready(state)
        kind = re.sub(r"[0-9]+", "", reason)
        again = state.phase is Phase.HEALTH and now_s - self._said_s >= AGAIN_S
        if not reason or (kind == self._kind and not again):
            return ""
        self._kind, self._said_s = kind, now_s
        return f"waiting: {reason}"


class News:
    """All that is told of one flight, each kind at most once a second."""

    def __init__(self) -> None:
        self.paused, self.dropped = Repeated(PAUSED), Repeated(DROPPED)
        self._waiting = Waiting()

    def due(self, state: FlightState, session: Session, now_s: float) -> list[str]:
        """The sentences to announce now, at host time `now_s`."""
        late = [each.news(now_s) for each in (self.paused, self.dropped)]
        ended = state.busyness.sentence if state.has_ended and state.service else ""
        told = [*late, self._waiting.news(state, session, state.now_s)]
        return list(filter(None, [*told, "" if ended in state.announced else ended]))


def _unready(state: FlightState) -> str:
    ground = ground_of(state)
    return "; ".join(filter(None, [*preflight.refusals(ground), preflight.not_ready(ground)]))


def _unheard(session: Session) -> str:
    """What is heard instead of a vehicle."""
    counters = session.counters
    if not counters.bytes_received:
        return "nothing is heard on this link"
    if not counters.frames:
        return f"{counters.bytes_received} bytes are heard that are not MAVLink"
    known = session.senders.why_none(counters)
    return known or "MAVLink is heard, but no heartbeat of an autopilot"
