"""What users and displays are told about a flight beside its phases: what it waits for, pauses of
this computer, and the present values.
"""

from __future__ import annotations

import math
import re

from offboard.documents.errors import Repeated
from offboard.flight.phases import TRACKING, Phase
from offboard.flight.starting import found_engaged, unfit
from offboard.flight.state import FlightState

PAUSED = (
    "this computer paused for {most:.2f} s{times}: no setpoint until the vehicle reports its mode "
    "again"
)
MESSAGES_DROPPED = (
    "{total:.0f} of our messages to the vehicle were not sent: this computer was too busy, and "
    "they became too old"
)
# Time in a phase before the first reason is announced: telemetry has only just been requested,
# checks are running, the vehicle has not reported its hardware number yet
FIRST_S = {Phase.CONNECT: 2.5, Phase.HEALTH: 5.0, Phase.STANDBY: 1.0}
HELD_S = 0.5  # a reason that holds for less is not announced: a new message is slow at first
AGAIN_S = 10.0  # interval at which the same reason is announced again, with new figures
FIGURES = re.compile("[0-9]+")


class News:
    """Announcements of one flight beside its phases: pauses of this process and dropped messages
    (`add` reports one), each at most once a second, and why the flight does not begin yet. In
    HEALTH the reason is repeated every AGAIN_S if its figures have changed; in CONNECT and STANDBY
    it is announced once."""

    def __init__(self) -> None:
        self.paused, self.dropped = Repeated(PAUSED), Repeated(MESSAGES_DROPPED)
        self._kind = self._said = ""  # present reason, without figures, and newest announced
        self._since_s = self._said_s = -math.inf

    def due(self, state: FlightState, now_s: float) -> list[str]:
        """Return the sentences to announce now, at host time `now_s`."""
        told = [self.paused.news(now_s), self.dropped.news(now_s), self._waiting(state)]
        return list(filter(None, told))

    def _waiting(self, state: FlightState) -> str:
        if state.phase not in FIRST_S:
            self._kind = self._said = ""
            return ""
        now_s = state.now_s
        why = {Phase.CONNECT: _unheard, Phase.HEALTH: unfit, Phase.STANDBY: _left_alone}
        reason = why[state.phase](state)
        kind = FIGURES.sub("", reason)
        if kind != self._kind:
            self._kind, self._since_s = kind, now_s
        if state.in_phase_s < FIRST_S[state.phase] or now_s - self._since_s < HELD_S:
            return ""
        again = state.phase is Phase.HEALTH and now_s - self._said_s >= AGAIN_S
        if reason in ("", self._said) or (kind == FIGURES.sub("", self._said) and not again):
            return ""
        self._said, self._said_s = reason, now_s
        return f"waiting: {reason}"


def _left_alone(state: FlightState) -> str:
    """The sentence that the vehicle was found in the mode of setpoints and is left alone; empty if
    it was not found so."""
    if state.left_engaged or not found_engaged(state):
        return ""
    return (
        f"the vehicle was found in {state.vehicle.mode} in the air, and this service has not "
        "engaged it: it is left alone; switch to another mode and back"
    )


def _unheard(state: FlightState) -> str:
    """The sentence that says what is received instead of a vehicle."""
    session, received = state.session, state.session.splitter
    if not received.bytes_received:
        return "nothing is heard on this link"
    if not received.frames:
        return f"{received.bytes_received} bytes are heard that are not MAVLink"
    known = session.senders.why_none()
    return known or "MAVLink is heard, but no heartbeat of an autopilot"


TEXTS_KEPT = 8


class Snapshot:
    """The present values of a flight, for displays outside the loop (terminal, live page, metrics).
    It has no references to the flight, so that it can be passed to another thread. SI, NED, vehicle
    time; NaN or None for what is not known yet. The attributes are the fields of the JSON objects.

    `flights`: number of flights that the service has begun.
    """

    def __init__(self, state: FlightState, flights: int = 0) -> None:
        vehicle, command, link = state.vehicle, state.command, state.clock.delay
        position, attitude = vehicle.position, vehicle.attitude
        sample = (
            state.plan.sample(position.time_s) if position and state.phase in TRACKING else None
        )
        charge = vehicle.health.battery_remaining if vehicle.health else None
        age_s = state.telemetry_age_s(state.host_s) if vehicle.has_state else math.nan
        self.time_s = state.time_s  # of the newest telemetry
        self.phase = state.phase.value
        self.in_phase_s = state.in_phase_s
        self.track_time_s = state.track_time_s  # since the start of the track
        self.mode = vehicle.mode  # reported by the vehicle
        self.armed = vehicle.armed
        # a name of `authority.Standing` in lower case; "unknown" before the first mode
        self.authority = (
            state.authority.standing.name.lower() if state.authority.engage_mode else "unknown"
        )
        self.failsafe = state.failsafe.action.name.lower()
        self.failsafe_row = state.failsafe.row  # the row that demands this action
        self.position_ned_m = position.position_ned_m if position else None
        self.velocity_ned_mps = position.velocity_ned_mps if position else None
        self.attitude = attitude.attitude if attitude else None  # (w, x, y, z), FRD to NED
        # reference and error are known from the climb to the landing
        self.reference_ned_m = sample.position_ned_m.tolist() if sample else None
        self.position_error_m = state.position_error_m if sample else math.nan
        self.thrust_mps2 = command.thrust_mps2  # of the command in force, as are the next two
        self.thrust_direction_ned = command.thrust_direction_ned
        self.heading_rad = command.heading_rad
        self.hover_thrust = state.model.hover_thrust  # of the vehicle model in use, 0 to 1
        # beyond the least delay of the last 5 s
        self.telemetry_age_s = age_s if math.isfinite(age_s) else math.nan
        self.link_delay_s = link.value if link else math.nan  # telemetry and setpoint together
        self.link_delay_sd_s = link.sd if link else math.nan
        self.link_growth_s = state.clock.growth.added_s  # since takeoff
        self.missed_decisions = state.missed_decisions  # in a row
        self.skipped_ticks = state.busyness.skipped  # in pauses of this process, since takeoff
        self.computer = state.busyness.sentence  # if it is too busy; empty if it keeps up
        self.battery = math.nan if charge is None else charge  # remaining charge, 0 .. 1
        self.other_datagrams = state.other_datagrams  # of other senders, since the start
        # frames that signing refused, since the start
        self.forged = state.session.senders.forged.total()
        self.texts = tuple(state.announced[-TEXTS_KEPT:])  # the newest announcements, oldest first
        self.flights = flights
