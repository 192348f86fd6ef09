"""Flight state: everything that one flight knows. `Flight` is a subclass of it; the functions of
the other modules take it as an argument.

`VehicleState`, `Authority`, `GroundContact` and `VehicleClock` hold what was received, with its
time. `transitions` and `failsafe` decide what follows from it. README.md defines
vehicle time, host time (`Session.elapsed_s`) and link time (`Session.link_time_s`).
"""

from __future__ import annotations

import math
import operator
from collections import deque
from collections.abc import Callable
from dataclasses import InitVar, dataclass, field

import numpy as np

from offboard.control.base import Controller
from offboard.estimation.observer import Observer
from offboard.flight.authority import Authority, PilotSwitch, Standing
from offboard.flight.estimates import HoverEstimate, Positioning, PositionJumps
from offboard.flight.flight_plan import FlightPlan
from offboard.flight.ground_contact import GroundContact, Touchdown
from offboard.flight.phases import (
    ENDS,
    OPERATOR_STOP,
    Action,
    Outcome,
    Phase,
    Request,
)
from offboard.flight.preflight import Ground
from offboard.flight.record import Decided
from offboard.flight.timing import Busyness, LinkGrowth
from offboard.identification.learner import Learner
from offboard.mavlink.events import Heartbeat, TimesyncReply, Triple
from offboard.mavlink.outgoing import (
    AttitudeTarget,
    CommandLong,
    Outgoing,
    PositionTarget,
    Record,
)
from offboard.model.command import Command, PredictedState

LEVEL_DIRECTION = (0.0, 0.0, 1.0)  # thrust direction of level flight: third body axis in NED
COMMANDS_KEPT = 7  # the attitude may still follow the oldest of them
THRUSTS_KEPT = 40  # the vehicle may still follow the oldest: later ones are on their way or lost
# Setpoints count as missing this long before the autopilot's timeout, but at most a third of it,
# because the newest one may be on its way or lost
MISSING_EARLY_S = 0.3
HEARTBEAT_AWAITED_S = 1.2  # longest wait for a HEARTBEAT, which comes at 1 Hz
MISSING_KNOWN_S = 3.0  # time in which HEARTBEAT, at 1 Hz, shows the failsafe for missing setpoints


# attributes that continue those of the flight before, with the same vehicle
KEPT = (
    "vehicle", "contact", "clock", "hover", "jumps", "reading", "other_datagrams", "host_s",
    "telemetry_host_s", "guarded", "announced", "announcements",
)  # fmt: skip


@dataclass(slots=True)
class Failsafe:
    """For how long the conditions of `failsafe.ROWS` have held, by the name of the row, and the
    active row with the most severe action."""

    held_s: dict[str, float] = field(default_factory=dict)
    judged_s: float = math.inf  # link time of the newest judgement; infinite before the first
    row: str = ""
    action: Action = Action.FLY
    reason: str = ""  # why the action is taken, in a sentence
    cause: str = ""  # the same in a word


@dataclass(slots=True, kw_only=True)
class FlightState(Ground):
    """The state of one flight. `stopwatch` returns monotonic host time. `deadline_s` is the host
    time that one decision may take; it is None if the vehicle waits for each decision, so that none
    is late. `identification` is None with a controller that cannot use it, and `service` is None in
    a flight of `fly`."""

    plan: FlightPlan
    observer: Observer
    controller: Controller
    period_s: float
    stopwatch: Callable[[], float]
    deadline_s: float | None = None
    identification: Learner | None = None
    before: InitVar[FlightState | None] = None
    hover: HoverEstimate = field(default_factory=HoverEstimate)
    jumps: PositionJumps = field(default_factory=PositionJumps)
    positioning: Positioning = field(default_factory=Positioning)
    failsafe: Failsafe = field(default_factory=Failsafe)
    contact: GroundContact = field(init=False)
    pilot: PilotSwitch = PilotSwitch.FOUND
    # takeoff point, or for a vehicle that was found in the air the place where it last rested (if
    # unknown, the point below it); a place as in `PositionJumps`, without jumps of the estimate
    home_ned_m: Triple = (0.0, 0.0, 0.0)
    took_off: bool = False  # in this flight; a vehicle that was found in the air did not
    touchdown: Touchdown | None = None  # of the landing
    authority: Authority = field(default_factory=Authority)
    other_datagrams: int = 0  # number of datagrams from other senders, for the log

    phase: Phase = Phase.CONNECT
    began_s: float = 0.0  # link time at which the phase began
    setpoint_s: float = math.inf  # host time of the newest setpoint; infinite before the first
    setpoints_missed_s: float = -math.inf  # newest host time with setpoints possibly missing
    rebooted: bool = False
    returns_to: str = ""  # the pilot's mode, in which a refused vehicle is handed back
    left_engaged: bool = False  # whether an earlier flight, cut short, left the vehicle engaged
    request: Request = Request.NONE  # of the ground station, while `transitions.obey` runs
    obeyed: Request = Request.NONE  # the newest request that changed the phase
    refused_s: float = -math.inf  # link time of the newest announcement of a refused request
    stop_reason: str = ""  # why a stop was requested; empty without a request
    outcome: Outcome | None = None

    busyness: Busyness = field(init=False)  # of this computer
    # host time of the turn in which the newest telemetry arrived
    telemetry_host_s: float = math.nan
    telemetry_arrived_s: float = 0.0  # monotonic host time of that arrival, in lockstep too
    # `clock.answered_s` at the newest report of the mode: the vehicle had received what was sent
    # until then when it sent this report
    mode_after_s: float = -math.inf
    bridged_s: float = 0.0  # `silence_s` at the newest setpoint that was sent without telemetry
    ignored: int = 0  # datagrams of others and forged frames between the two newest ticks
    command: Command = field(default_factory=lambda: Command(0.0, LEVEL_DIRECTION, 0.0))  # in force
    newest_setpoint: AttitudeTarget | PositionTarget | None = None  # None once it was repeated
    decided: Decided | None = None  # the decision of this turn
    told_radps: tuple[float, ...] = (math.nan, math.nan)  # the bandwidth that was announced last
    missed_decisions: int = 0  # in a row that were not sent
    failure: str = ""  # what prevented the newest of them
    failure_cause: str = ""  # in a word: controller, link or computer
    # attitude setpoints, and their thrusts, since the newest position setpoint
    commands: deque[Command] = field(default_factory=lambda: deque(maxlen=COMMANDS_KEPT))
    thrusts: deque[float] = field(default_factory=lambda: deque(maxlen=THRUSTS_KEPT))
    announced: list[str] = field(default_factory=list)  # newest sentences, oldest first
    announcements: int = 0  # number of all sentences announced so far
    told: set[str] = field(default_factory=set)  # sentences that are not announced again
    queue: list[Outgoing] = field(default_factory=list)  # to be sent
    records: list[Record] = field(default_factory=list)  # to be logged
    # requests of this phase: link time and host time at which each was sent
    requested_s: dict[CommandLong, tuple[float, float]] = field(default_factory=dict)
    text_id: int = 0
    awaits_link: bool = False  # whether a landing waits until the vehicle is heard again
    follows_others: bool = False  # whether the newest ThrustReport equals none of `thrusts`
    start_hover_thrust: float = math.nan  # normalised; the greatest at a start of the reference
    predictions: deque[PredictedState] = field(default_factory=lambda: deque(maxlen=8))

    def __post_init__(self, before: FlightState | None) -> None:
        self.busyness = Busyness(self.period_s)
        self.contact = GroundContact(self.vehicle)
        if before is not None:
            self._follow(before)

    def _follow(self, before: FlightState) -> None:
        """Take over what `before`, a flight with the same vehicle, knows about vehicle and link. If
        `before` has ended, this flight begins in STANDBY, or in CONNECT after a reboot, so that the
        parameters of the vehicle are read again."""
        for name in KEPT:
            setattr(self, name, getattr(before, name))
        self.clock.growth = LinkGrowth()
        # an ended flight requests no TIMESYNC: an old reply shows no missing setpoints
        self.vehicle.heard_s.pop(TimesyncReply, None)
        self.authority = before.authority.renewed()
        if not before.in_end_phase:  # it has only waited: what the pilot did meanwhile counts
            self.pilot, self.phase, self.began_s = before.pilot, before.phase, before.began_s
            return
        known = self.authority.engage_mode and not before.rebooted
        self.phase = Phase.STANDBY if known else Phase.CONNECT
        self.began_s = before.now_s
        self.pilot = before.pilot
        if before.ends_engaged:
            self.pilot = PilotSwitch.FOUND
        elif before.pilot is PilotSwitch.ENGAGED:
            # a vehicle that was taken and is engaged again already is put on hold (TOO_SOON)
            self.pilot = PilotSwitch.TOO_SOON if before.taken else PilotSwitch.IDLE
        elif before.pilot is PilotSwitch.FOUND:
            self.pilot = PilotSwitch.IDLE

    @property
    def now_s(self) -> float:
        """Link time at the newest event, or at the present turn."""
        return self.vehicle.now_s

    @property
    def silence_s(self) -> float:
        """Host time since the newest telemetry; 0 before the first turn. In lockstep
        `telemetry_host_s` may be later than `host_s`, because simulated time advances within the
        turn."""
        return max(0.0, self.host_s - self.telemetry_host_s)

    @property
    def silent_since_health(self) -> bool:
        """Whether no telemetry has arrived since the present phase, HEALTH, began."""
        return self.phase is Phase.HEALTH and self.in_phase_s <= self.silence_s

    @property
    def holds_in(self) -> str:
        """The mode in which the vehicle is held or handed back."""
        return self.returns_to or self.known_dialect.hold_mode

    @property
    def in_the_air(self) -> bool:
        return self.contact.in_the_air

    @property
    def origin_missing(self) -> bool:
        unseen = self.in_the_air and self.contact.rest_ned_m is None
        return unseen and self.service is not None and self.service.anchor == "origin"

    @property
    def outside_volume(self) -> str:
        north_m, east_m, height_m = self.from_takeoff_m
        distance_m = math.hypot(north_m, east_m)
        if not (height_m > self.limits.ceiling_m or distance_m > self.limits.radius_m):
            return ""
        return f"{height_m:.0f} m above and {distance_m:.0f} m from the takeoff point"

    @property
    def in_phase_s(self) -> float:
        """Seconds since the phase began."""
        return self.now_s - self.began_s

    @property
    def in_end_phase(self) -> bool:
        return self.phase in ENDS

    @property
    def stop_cause(self) -> str:
        """A word for who requested the stop: "operator", or empty for any other reason."""
        return "operator" if self.stop_reason == OPERATOR_STOP else ""

    @property
    def in_engage_mode(self) -> bool:
        """Whether the vehicle shows the mode in which it follows setpoints."""
        return self.authority.mode == self.authority.engage_mode

    @property
    def track_time_s(self) -> float:
        """Time since the start of the track, not counting pauses; NaN before it."""
        return self.plan.track_time_s(self.time_s)

    def last_rest_ned_m(self, place_ned_m: Triple) -> Triple:
        """Where the vehicle last rested. If that was not seen: the point below `place_ned_m` at the
        height of the local origin. Both are without the jumps of the estimate."""
        return self.contact.rest_ned_m or (*place_ned_m[:2], self.contact.rest_down_m)

    @property
    def from_takeoff_m(self) -> Triple:
        """North, east and height of the newest position relative to the takeoff point; without a
        reference relative to the last rest."""
        position = self.vehicle.position
        if position is None:
            return 0.0, 0.0, 0.0
        place_ned_m = self.jumps.without(position.position_ned_m)
        home_ned_m = self.home_ned_m if self.plan.reference else self.last_rest_ned_m(place_ned_m)
        north, east, down = map(operator.sub, place_ned_m, home_ned_m)
        return north, east, -down

    @property
    def position_error_m(self) -> float:
        """Distance of the reported position from the reference; NaN if either is missing."""
        position = self.vehicle.position
        sample = self.plan.sample(position.time_s) if position else None
        if position is None or sample is None:
            return math.nan
        return float(np.linalg.norm(np.array(position.position_ned_m) - sample.position_ned_m))

    @property
    def taken(self) -> bool:
        """Whether the flight ended in the air because someone else changed the vehicle's mode."""
        return self.authority.standing is Standing.LOST and self.phase is Phase.YIELDED

    @property
    def shown_since_lost(self) -> bool:
        """Whether a HEARTBEAT has arrived since authority was lost. Only HEARTBEAT shows whether a
        failsafe took the vehicle and whether it is armed. PX4 shows the mode in CURRENT_MODE up to
        a second earlier, and leaves its landing mode when it disarms."""
        return self.now_s - self.vehicle.age_s(Heartbeat) > self.authority.lost_s

    @property
    def awaits_heartbeat(self) -> bool:
        """Whether the vehicle was taken, and the HEARTBEAT that shows whether a failsafe took it is
        awaited, for at most HEARTBEAT_AWAITED_S. False if the vehicle shows the mode of setpoints
        again, because the pilot may want the next flight."""
        if not self.taken or self.in_engage_mode:
            return False
        return not self.shown_since_lost and self.in_phase_s < HEARTBEAT_AWAITED_S

    @property
    def ends_engaged(self) -> bool:
        """Whether the flight ends with a vehicle that may still be in the mode of setpoints: no
        other mode was reported before the vehicle was lost, or since it was rebooted."""
        unheard = self.authority.standing is Standing.OURS
        return unheard or (self.rebooted and self.pilot is PilotSwitch.FOUND)

    @property
    def time_s(self) -> float:
        """Vehicle time of the newest telemetry."""
        return self.vehicle.time_s

    @property
    def takes_off_by_command(self) -> bool:
        """Whether the autopilot takes off on a command, without setpoints."""
        return self.dialect is not None and self.dialect.takes_off_by_command

    @property
    def unreached_s(self) -> float:
        """Time without telemetry, or without a report of the mode; 0 while both arrive."""
        silent_s = self.silence_s if self.silence_s > self.limits.silence_s else 0.0
        return max(silent_s, self.authority.unheard_s(self.now_s))

    def note_missing_setpoints(self) -> None:
        """Set `setpoints_missed_s` if the vehicle may have been without setpoints for so long that
        its failsafe acts, because none was sent, no telemetry arrived, or no TIMESYNC request was
        answered."""
        unanswered_s = self.vehicle.age_s(TimesyncReply)
        gap_s = max(
            self.host_s - self.setpoint_s,
            self.silence_s,
            unanswered_s if math.isfinite(unanswered_s) else 0.0,
        )
        after_s = self.authority.setpoint_loss.after_s
        if gap_s > max(after_s - MISSING_EARLY_S, after_s * 2.0 / 3.0):
            self.setpoints_missed_s = self.host_s

    @property
    def setpoints_missing(self) -> bool:
        """Whether setpoints may have been missing within the last MISSING_KNOWN_S."""
        return self.host_s - self.setpoints_missed_s < MISSING_KNOWN_S

    def not_landed(self) -> str:
        """Why the vehicle has not landed; empty if it has."""
        if self.touchdown is None:
            return "it was not told to land"
        if not self.contact.position_known:
            return "no new LOCAL_POSITION_NED arrives to show it"
        return self.touchdown.not_landed(on_ground=self.contact.detected == "on_ground")

    def delays_begin_s(self, time_s: float) -> float:
        """Return the vehicle time from which the delays of the vehicle model count for a command of
        the tick `time_s`. It is later than `time_s` by the growth of the link delay since takeoff.
        """
        return time_s + self.clock.growth.added_s

    @property
    def age_s(self) -> float:
        """Age of the newest telemetry at the present turn, beyond the least delay of the last 5 s;
        0 before the first."""
        return self.telemetry_age_s(self.host_s) if self.vehicle.has_state else 0.0

    def telemetry_age_s(self, host_s: float) -> float:
        """Age of the newest telemetry at `host_s`, beyond the least delay of the last 5 s."""
        return self.clock.age_s(self.time_s, host_s)
