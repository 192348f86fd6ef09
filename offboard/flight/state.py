"""Flight state: all that one flight knows. `Flight` owns it; the functions of the other
modules take it.

Facts come in by `VehicleState`, `Authority`, `GroundContact` and `VehicleClock`, each with the
time when it was heard. What follows from them is in `transitions` and `failsafe`.
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

LEVEL_DIRECTION = (0.0, 0.0, 1.0)  # of the thrust: the third body axis in NED
COMMANDS_KEPT = 7  # as long as an attitude may take to follow
THRUSTS_KEPT = 40  # as long as a setpoint may be on its way, or the next ones be lost
# Setpoints count as missing so long before the autopilot's timeout, at most a third of it: the
# newest may be on its way or lost
MISSING_EARLY_S = 0.3
HEARTBEAT_AWAITED_S = 1.2  # HEARTBEAT comes at 1 Hz
MISSING_KNOWN_S = 3.0  # HEARTBEAT, at 1 Hz, shows the failsafe


# of the flight before, with the same vehicle
KEPT = (
    "vehicle", "contact", "clock", "hover", "jumps", "reading", "other_datagrams", "host_s",
    "heard_s", "guarded", "announced", "announcements",
)  # fmt: skip


@dataclass(slots=True)
class Failsafe:
    """For how long the conditions of `failsafe.ROWS` have held, by the name of the row, and the
    worst row that is active."""

    held_s: dict[str, float] = field(default_factory=dict)
    judged_s: float = math.inf  # when, on `Session.link_time_s`; infinite before the first time
    row: str = ""
    action: Action = Action.FLY
    reason: str = ""  # why the action is taken, as a sentence, and its cause in a word
    cause: str = ""


@dataclass(slots=True, kw_only=True)
class FlightState(Ground):
    """One flight. `stopwatch` reads host time. `deadline_s` is the wall time that one decision may
    take, None where the vehicle waits for each decision, so that none is late.
    `identification` is None with a controller that cannot use it, `service` in a flight of `fly`.
    """

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
    # the ground where the flight began, without the jumps of the estimate before that
    home_ned_m: Triple = (0.0, 0.0, 0.0)
    took_off: bool = False  # from there; a vehicle that was found in the air has not
    touchdown: Touchdown | None = None  # of the landing
    authority: Authority = field(default_factory=Authority)
    other_datagrams: int = 0  # of other senders, for the log

    phase: Phase = Phase.CONNECT
    began_s: float = 0.0  # of the phase, on `Session.link_time_s`
    setpoint_s: float = math.inf  # when the newest setpoint left; infinite before the first
    setpoints_missed_s: float = -math.inf  # when setpoints may have been missing for long
    rebooted: bool = False
    left_engaged: bool = False  # a flight that was cut short has left the vehicle engaged
    request: Request = Request.NONE  # of the ground station, while it is judged
    obeyed: Request = Request.NONE  # the newest one that changed the phase
    refused_s: float = -math.inf  # when the user was told of one that was refused
    stop_reason: str = ""  # why the flight shall end; empty while it shall not
    outcome: Outcome | None = None

    busyness: Busyness = field(init=False)  # of this computer
    heard_s: float = math.nan  # host time of the newest telemetry, as `Session.elapsed_s`
    telemetry_arrived_s: float = 0.0  # host time at which it arrived
    reported_s: float = -math.inf  # `clock.answered_s` when the newest mode was reported
    bridged_s: float = 0.0  # `silence_s` at the newest setpoint that was sent without telemetry
    ignored: int = 0  # datagrams of others and forged frames between the two newest ticks
    command: Command = field(default_factory=lambda: Command(0.0, LEVEL_DIRECTION, 0.0))  # in force
    newest_setpoint: AttitudeTarget | PositionTarget | None = None  # until it is repeated
    decided: Decided | None = None  # in this turn
    told_radps: tuple[float, ...] = (math.nan, math.nan)  # bandwidth, as the user knows it
    missed: int = 0  # decisions in a row that were not sent
    failure: str = ""  # what prevented the newest of them
    failure_cause: str = ""  # in a word: controller, link or computer
    commands: deque[Command] = field(default_factory=lambda: deque(maxlen=COMMANDS_KEPT))
    thrusts: deque[float] = field(default_factory=lambda: deque(maxlen=THRUSTS_KEPT))
    announced: list[str] = field(default_factory=list)  # newest for the user, oldest first
    announcements: int = 0  # how many there were
    told: set[str] = field(default_factory=set)  # of those that are announced once in a flight
    queue: list[Outgoing] = field(default_factory=list)  # to be sent
    records: list[Record] = field(default_factory=list)  # to be logged
    # requests of this phase: link time (`now_s`) and host time at which each was sent
    requested_s: dict[CommandLong, tuple[float, float]] = field(default_factory=dict)
    text_id: int = 0
    awaits_link: bool = False  # while landing
    follows_others: bool = False  # the newest ThrustReport is of none of `thrusts`
    start_hover_thrust: float = math.nan  # normalised; the greatest at a start of the reference
    predictions: deque[PredictedState] = field(default_factory=lambda: deque(maxlen=8))

    def __post_init__(self, before: FlightState | None) -> None:
        self.busyness = Busyness(self.period_s)
        self.contact = GroundContact(self.vehicle)
        if before is not None:
            self._follow(before)

    def _follow(self, before: FlightState) -> None:
        """Continue after another flight with the same vehicle: what is known of vehicle and link
        stays. It begins in STANDBY, or anew while the vehicle is not known well enough: after a
        reboot its parameters are read again."""
        for name in KEPT:
            setattr(self, name, getattr(before, name))
        self.clock.growth = LinkGrowth()
        # of a taken vehicle nothing was asked: no reply is missing in `note_missing_setpoints`
        self.vehicle.heard_s.pop(TimesyncReply, None)
        self.authority = before.authority.renewed()
        if not before.in_end_phase:  # nothing was flown: what the pilot did before counts
            self.pilot, self.phase, self.began_s = before.pilot, before.phase, before.began_s
            return
        prepared = before.phase not in (Phase.CONNECT, Phase.HEALTH) and not before.rebooted
        self.phase = Phase.STANDBY if prepared and self.authority.engage_mode else Phase.CONNECT
        self.began_s = before.now_s
        self.pilot = before.pilot
        if before.ends_engaged:
            self.pilot = PilotSwitch.FOUND
        elif before.pilot is PilotSwitch.ENGAGED:
            # a switch while the flight ended is answered by hold
            self.pilot = PilotSwitch.TOO_SOON if before.taken else PilotSwitch.IDLE
        elif before.pilot is PilotSwitch.FOUND:
            self.pilot = PilotSwitch.IDLE

    @property
    def now_s(self) -> float:
        """`Session.link_time_s` at the newest event, or at the present turn."""
        return self.vehicle.now_s

    @property
    def silence_s(self) -> float:
        """Host time since the newest telemetry; 0 before the first turn. In lockstep the turn in
        which some arrives is later than `host_s`, its beginning."""
        return max(0.0, self.host_s - self.heard_s)

    @property
    def in_the_air(self) -> bool:
        return self.contact.in_the_air

    @property
    def origin_missing(self) -> bool:
        unseen = self.in_the_air and self.contact.rest_ned_m is None
        return unseen and self.service is not None and self.service.anchor == "origin"

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
        """The vehicle shows the mode in which it follows setpoints."""
        return self.authority.mode == self.authority.engage_mode

    @property
    def track_time_s(self) -> float:
        """Time since the start of the track, without pauses; NaN before it."""
        return self.plan.track_time_s(self.time_s)

    @property
    def from_takeoff_m(self) -> Triple:
        """North, east and height of the newest position relative to the take-off point; 0 without
        a reference."""
        position = self.vehicle.position
        if position is None or self.plan.reference is None:
            return 0.0, 0.0, 0.0
        place_ned_m = self.jumps.without(position.position_ned_m)
        north, east, down = map(operator.sub, place_ned_m, self.home_ned_m)
        return north, east, -down

    @property
    def position_error_m(self) -> float:
        """Distance of the reported position from the reference; NaN without one of them."""
        position = self.vehicle.position
        sample = self.plan.sample(position.time_s) if position else None
        if position is None or sample is None:
            return math.nan
        return float(np.linalg.norm(np.array(position.position_ned_m) - sample.position_ned_m))

    @property
    def taken(self) -> bool:
        """Someone else changed the vehicle's mode, and that ended the flight in the air."""
        return self.authority.standing is Standing.LOST and self.phase is Phase.YIELDED

    @property
    def shown_since_lost(self) -> bool:
        """A HEARTBEAT has come since the vehicle was lost: only it shows whether a failsafe took
        it, and whether it is armed. PX4 shows the mode by CURRENT_MODE up to a second earlier, and
        leaves its landing mode when it disarms."""
        return self.now_s - self.vehicle.age_s(Heartbeat) > self.authority.lost_s

    @property
    def awaits_heartbeat(self) -> bool:
        """The vehicle was taken, and no HEARTBEAT since then shows whether by a failsafe. False
        while it shows the mode of setpoints again: the pilot may want the next flight."""
        if not self.taken or self.in_engage_mode:
            return False
        return not self.shown_since_lost and self.in_phase_s < HEARTBEAT_AWAITED_S

    @property
    def ends_engaged(self) -> bool:
        """Whether the flight ends with a vehicle that nobody has seen in another mode than that of
        setpoints: it was not heard any more, or has rebooted."""
        unheard = self.authority.standing is Standing.OURS
        return unheard or (self.rebooted and self.pilot is PilotSwitch.FOUND)

    @property
    def time_s(self) -> float:
        """Vehicle time of the newest telemetry."""
        return self.vehicle.time_s

    @property
    def takes_off_by_command(self) -> bool:
        """The autopilot takes off on a command, without setpoints."""
        return self.dialect is not None and self.dialect.takes_off_by_command

    @property
    def unreached_s(self) -> float:
        """For how long no telemetry, or no report of the mode, has arrived; 0 while both do."""
        silent_s = self.silence_s if self.silence_s > self.limits.silence_s else 0.0
        return max(silent_s, self.authority.unheard_s(self.now_s))

    def note_missing_setpoints(self) -> None:
        """Note when the vehicle may have been without setpoints for so long that its failsafe acts:
        none was sent, nothing was heard, or no TIMESYNC was answered."""
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
        """Whether `note_missing_setpoints` found this within the last MISSING_KNOWN_S."""
        return self.host_s - self.setpoints_missed_s < MISSING_KNOWN_S

    def not_landed(self) -> str:
        """Why the vehicle has not landed; empty if it has."""
        if self.touchdown is None:
            return "it was not told to land"
        if not self.contact.position_known:
            return "no LOCAL_POSITION_NED shows it"
        return self.touchdown.not_landed(on_ground=self.contact.detected == "on_ground")

    def delays_begin_s(self, time_s: float) -> float:
        """The vehicle time at which the vehicle model's delays begin for a command of the tick
        `time_s`: later by what the link has added to its delay since take-off."""
        return time_s + self.clock.growth.added_s

    @property
    def age_s(self) -> float:
        """Age of the newest telemetry at the present turn, beyond the least delay of the link; 0
        before the first."""
        return self.telemetry_age_s(self.host_s) if self.vehicle.has_state else 0.0

    def telemetry_age_s(self, host_s: float) -> float:
        """Age of the newest telemetry at `host_s`, beyond the least delay of the link."""
        return self.clock.age_s(self.time_s, host_s)
