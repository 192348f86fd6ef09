"""The preflight list: what must be true of a vehicle before it is flown, one row for a condition.

`fly` and `daemon` decide by it on the ground, and `doctor` prints it. Nothing here does I/O: a row
is a function of a `Ground`. What an autopilot requires of its parameters is in its dialect;
`findings` adds it to the list.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from enum import IntEnum

from offboard.estimation.observer import LATEST_S
from offboard.flight.phases import Limits, ServiceOptions
from offboard.flight.timing import VehicleClock
from offboard.flight.vehicle_state import ARMED_KNOWN_S, VehicleState
from offboard.mavlink import senders
from offboard.mavlink.dialects.base import Dialect
from offboard.mavlink.events import Attitude, GpsFix, Heartbeat, LocalPosition, NoFix
from offboard.mavlink.outgoing import ParamRead
from offboard.mavlink.session import Session
from offboard.model.vehicle import Vehicle

TELEMETRY = {"LOCAL_POSITION_NED": LocalPosition, "ATTITUDE_QUATERNION": Attitude}
MINIMUM_TELEMETRY_HZ = 10.0
REPEAT_S = 0.5  # between two requests for a parameter
REPLY_TIMEOUT_S = 2.0  # for parameters
STARTING_S = 90.0  # vehicle time after boot: ArduCopter uses a GPS 30 s after its first 3D fix
UNANSWERED_S = 3.0  # without a reply to TIMESYNC requests, which are sent at each tick


class Level(IntEnum):
    """How severe a finding is. WAIT may clear by itself; BLOCKS prevents a flight."""

    OK = 0
    WARN = 1
    WAIT = 2
    BLOCKS = 3


@dataclass(frozen=True, slots=True)
class Finding:
    """`found` is what was observed and `hint` is what to do about it; they are separate, so that a
    program can use either. `about` is the parameter that the finding is about, if there is one."""

    level: Level
    found: str
    hint: str = ""
    about: str = ""

    @property
    def sentence(self) -> str:
        """What is wrong and what to do."""
        return f"{self.found}. Fix: {self.hint}" if self.hint else self.found


class ParameterReading:
    """Progress of reading the watched parameters of one vehicle.

    `advice`: whether to read also the parameters that only `doctor` gives advice on."""

    def __init__(self, *, advice: bool = False) -> None:
        self._advice = advice
        self._began_s = math.nan
        self._requested_s = -math.inf

    def due(self, dialect: Dialect, vehicle: VehicleState) -> list[ParamRead]:
        """Return the requests to send now, one for every watched parameter without a reply."""
        if math.isnan(self._began_s):
            self._began_s = vehicle.now_s
        if vehicle.now_s - self._requested_s < REPEAT_S - 1e-6:
            return []
        self._requested_s = vehicle.now_s
        return [ParamRead(name) for name in self._missing(dialect, vehicle)]

    def complete(self, dialect: Dialect, vehicle: VehicleState) -> bool:
        """Whether every parameter has a reply, or there was time enough for one."""
        timeout = vehicle.now_s - self._began_s >= REPLY_TIMEOUT_S
        return timeout or not self._missing(dialect, vehicle)

    def _missing(self, dialect: Dialect, vehicle: VehicleState) -> list[str]:
        unanswered = dialect.without_reply(vehicle.parameters)
        return [each.name for each in unanswered if self._advice or not each.advice_only]


@dataclass(slots=True, kw_only=True)
class Ground:
    """What is known about a vehicle on the ground, by `doctor` or by a flight (`FlightState` is a
    subclass). `model` is the vehicle model in use, which scales the thrust of setpoints."""

    limits: Limits
    session: Session
    model: Vehicle
    vehicle: VehicleState = field(default_factory=VehicleState)
    clock: VehicleClock = field(default_factory=VehicleClock)
    host_s: float = math.nan  # host time of the present turn; in lockstep simulated time
    guarded: bool = True  # whether a supervisor lands the vehicle if this process ends
    rates_requested: bool = True  # whether telemetry rates were requested; else slow ones are fine
    service: ServiceOptions | None = None  # of `daemon`, for which the pilot arms and engages
    reading: ParameterReading = field(default_factory=ParameterReading)

    @property
    def dialect(self) -> Dialect | None:
        """The dialect of the vehicle; None before it is found."""
        return self.session.dialect

    @property
    def known_dialect(self) -> Dialect:
        """The dialect of the vehicle, which must have been found."""
        assert self.session.dialect is not None
        return self.session.dialect

    @property
    def in_the_air(self) -> bool:
        """Whether the vehicle may be in the air; True in doubt."""
        return self.vehicle.armed

    @property
    def origin_missing(self) -> bool:
        """Whether the reference is relative to a takeoff point that is not known."""
        return False

    @property
    def outside_volume(self) -> str:
        """Where the vehicle is, if that is beyond the limits of height or distance; else empty."""
        return ""


@dataclass(frozen=True, slots=True)
class Row:
    """One condition: `problem` returns what is wrong, empty if nothing is; `fix` says what to do, a
    text with values of the ground in braces.

    `at_once`: whether `fly` refuses without waiting `limits.health_s` for the problem to clear.
    `fly_only`: whether `daemon`, which waits for its pilot, leaves the condition out."""

    check: str
    level: Level | Callable[[Ground], Level]
    problem: Callable[[Ground], str]
    fix: str | Callable[[Ground], str] = ""
    at_once: bool = False
    fly_only: bool = False


def findings(ground: Ground) -> Iterator[tuple[str, bool, Finding]]:
    """Yield what is wrong with a vehicle that was found, in the order of the list, then with its
    parameters. Each item has the name of the check, whether `fly` refuses the vehicle at once, and
    the finding. For a vehicle of an unfit type all other rows and the parameters mean something
    else."""
    if unfit := unfit_type(ground):
        yield "vehicle", True, Finding(Level.BLOCKS, unfit, _UNFIT)
        return
    for row in PREFLIGHT:
        found = "" if row.fly_only and ground.service else row.problem(ground)
        if found:
            level = row.level if isinstance(row.level, Level) else row.level(ground)
            fix = row.fix.format(ground=ground) if isinstance(row.fix, str) else row.fix(ground)
            yield row.check, row.at_once, Finding(level, found, fix)
    for parameter in ground.known_dialect.watched_parameters:
        name, value = parameter.name, ground.vehicle.parameters.get(parameter.name)
        fault = None if value is None else parameter.fault(value)
        if fault:
            yield "parameters", True, Finding(Level.BLOCKS, fault.found, fault.fix, name)
        elif value is None and parameter.must_answer:
            missing = f"no reply for parameter {name}"
            fix = "check the link; a firmware without this parameter is not flown"
            yield "parameters", False, Finding(Level.BLOCKS, missing, fix, name)


def refusals(ground: Ground) -> list[str]:
    """Why this vehicle is refused at once: a sentence for each reason."""
    return [found.sentence for _, at_once, found in findings(ground) if at_once]


def awaited(ground: Ground) -> str:
    """Why it cannot be flown yet, in one sentence; empty if nothing is to be waited for."""
    waiting = (found.sentence for _, at_once, found in findings(ground) if not at_once)
    return next(waiting, "")


def only_mode_is_unfit(ground: Ground) -> bool:
    """Whether only the pre-arm checks of the mode that PX4 shows do not pass, and PX4 uses no GPS:
    without a global position AUTO.LOITER fails them, and OFFBOARD may pass."""
    return _without_gps(ground) and {check for check, _, _ in findings(ground)} == {"prearm"}


# --- conditions ---


def unfit_type(ground: Ground) -> str:
    """Why a vehicle of this MAV_TYPE, whose modes are not known here, is not flown; else empty."""
    heartbeat = ground.vehicle.heartbeat
    if heartbeat is None:
        return ""
    helicopter = ground.model.airframe == "helicopter"
    return senders.unfit_type(heartbeat.vehicle_type, helicopter=helicopter)


def armed_already(ground: Ground) -> str:
    """The vehicle is armed already, and `limits.begin_armed` is False."""
    armed = ground.vehicle.armed and not ground.limits.begin_armed
    return "the vehicle is armed already, by another controller or a pilot" if armed else ""


def _flown_by_another(ground: Ground) -> str:
    vehicle = ground.vehicle
    engaged = vehicle.armed and vehicle.mode == ground.known_dialect.engage_mode
    if not engaged or ground.limits.begin_engaged:
        return ""
    return (
        f"the vehicle is armed and in {vehicle.mode} already: another controller flies it "
        "(limits.begin_engaged=true takes it over)"
    )


def _flown_by_failsafe(ground: Ground) -> str:
    flown = ground.vehicle.in_failsafe and ground.in_the_air
    if not flown or ground.limits.begin_in_failsafe:
        return ""
    return (
        f"a failsafe flies the vehicle, in {ground.vehicle.mode} "
        "(limits.begin_in_failsafe=true takes it over)"
    )


def _several_vehicles(ground: Ground) -> str:
    """Several vehicles are heard, and none was chosen."""
    session = ground.session
    systems = session.senders.candidates(session.link_time_s)
    return systems and f"several vehicles are heard, systems {systems}"


def other_sender(ground: Ground) -> str:
    """Another program sends setpoints or commands modes on this link, or says in its HEARTBEAT
    that it flies the vehicle."""
    vehicle, limits = ground.vehicle, ground.limits
    return "" if limits.begin_with_other_sender else vehicle.other_sender_named


def _same_system_id(ground: Ground) -> str:
    if not (ground.session.time.mixed or ground.vehicle.arming_alternates):
        return ""
    return (
        "two vehicles with the same system id send on this link, or its telemetry comes twice, "
        "seconds apart"
    )


def twin(ground: Ground) -> str:
    """An autopilot with the vehicle's system id is heard from a second address."""
    return ground.session.senders.twin(ground.session.link_time_s)


def other_vehicle(ground: Ground) -> str:
    """Several vehicles are heard and none was chosen with --system, or two of them have the same
    system id."""
    return _same_system_id(ground) or twin(ground) or _several_vehicles(ground)


def signs(ground: Ground) -> str:
    """The vehicle has a key, and ignores our messages, which are not signed."""
    return senders.SIGNS if ground.session.senders.signs else ""


def _no_telemetry(ground: Ground) -> str:
    vehicle, session = ground.vehicle, ground.session
    if vehicle.age_s(Heartbeat) > ARMED_KNOWN_S:  # then earlier reports explain nothing
        return f"no HEARTBEAT arrives{session.senders.others(session.link_time_s)}"
    missing = [name for name, kind in TELEMETRY.items() if vehicle.age_s(kind) > ARMED_KNOWN_S]
    if not missing:
        return ""
    unused = any(session.telemetry.rates_hz.get(name) for name in missing)
    how = f" except repeated or over {LATEST_S:g} s late" if unused else ""
    problem = vehicle.estimator.problem if vehicle.estimator else ""
    why = (problem and f": {problem}") + vehicle.explanation(ground.known_dialect.unsaid)
    return f"no {' and no '.join(missing)} arrives{how}{why}"


def _unguarded(ground: Ground) -> str:
    if ground.guarded:
        return ""
    return "the supervisor, which lands it if this process ends, does not answer"


def _slow(ground: Ground) -> str:
    counts = ground.rates_requested and ground.vehicle.has_state
    return rare_telemetry(ground, MINIMUM_TELEMETRY_HZ) if counts else ""


def rare_telemetry(ground: Ground, least_hz: float) -> str:
    """Position or attitude arrives at less than `least_hz`, measured over 2 s."""
    rates_hz = ground.session.telemetry.rates_hz
    for name in TELEMETRY:
        if rates_hz.get(name, 0.0) < least_hz:
            return (
                f"{name} arrives at {rates_hz.get(name, 0.0):.1f} Hz, at least {least_hz:g} Hz "
                "are needed"
            )
    return ""


def _landed_unknown(ground: Ground) -> str:
    unknown = ground.vehicle.landed == "unknown"
    return "it does not report whether it flies (EXTENDED_SYS_STATE)" if unknown else ""


def _reading(ground: Ground) -> str:
    read = ground.reading.complete(ground.known_dialect, ground.vehicle)
    return "" if read else "its parameters are still being read"


def _origin(ground: Ground) -> str:
    unseen = "its takeoff point is not known, as it was not seen on the ground (--anchor origin)"
    return unseen if ground.origin_missing else ""


def _prearm(ground: Ground) -> str:
    vehicle = ground.vehicle
    if vehicle.prearm_ok or vehicle.armed:
        return ""
    if vehicle.health is None:
        return "SYS_STATUS does not arrive: it is unknown whether the vehicle can arm"
    if _needs_setpoints(ground):
        return ""
    unsaid = f"{vehicle.unhealthy()} ({ground.known_dialect.unsaid})"
    told = vehicle.explanation(unsaid) if vehicle.texts else unsaid
    return f"its pre-arm checks do not pass in {vehicle.mode}{told}"


def _needs_setpoints(ground: Ground) -> str:
    """PX4 in OFFBOARD refuses to arm while no setpoints arrive, whatever the vehicle's state."""
    vehicle, dialect = ground.vehicle, ground.known_dialect
    if dialect.takes_off_by_command or vehicle.health is None:
        return ""
    if vehicle.mode != dialect.engage_mode or vehicle.prearm_ok or vehicle.armed:
        return ""
    return f"its pre-arm checks pass in {vehicle.mode} only while setpoints arrive"


def _remedy(ground: Ground) -> str:
    return ground.known_dialect.remedy(ground.vehicle.texts)


def _without_gps(ground: Ground) -> bool:
    """Whether a PX4 has a valid estimate without GPS."""
    px4 = not ground.known_dialect.takes_off_by_command
    return px4 and ground.vehicle.without_gps and not _no_estimate(ground)


def _prearm_fix(ground: Ground) -> str:
    dialect = ground.known_dialect
    if not _without_gps(ground):
        return _remedy(ground)
    return (
        f"`offboard fly` also tries {dialect.engage_mode}, which needs no global position; it "
        f"lands the vehicle if {dialect.hold_mode} is refused in flight"
    )


def _no_estimate(ground: Ground) -> str:
    report = ground.vehicle.estimator
    return report.problem if report else ""


def _estimate_level(ground: Ground) -> Level:
    """WAIT while the vehicle starts, because a missing part of the estimate may come; BLOCKS later,
    or if the estimator rejects a measurement."""
    vehicle = ground.vehicle
    fixed = vehicle.age_s(GpsFix) < vehicle.age_s(NoFix)
    starts = not fixed or vehicle.time_s < STARTING_S
    rejects = vehicle.estimator is not None and vehicle.estimator.worst[1] > 1.0
    return WAIT if starts and not rejects else BLOCKS


def _outside_volume(ground: Ground) -> str:
    limits, where = ground.limits, ground.outside_volume
    if not (where and ground.in_the_air):  # a vehicle on the ground is at its takeoff point
        return ""
    named = f"limits.ceiling_m is {limits.ceiling_m:g}, limits.radius_m is {limits.radius_m:g}"
    return f"{where} ({named})"


def _empty_battery(ground: Ground) -> str:
    charge, least = ground.vehicle.battery, ground.limits.battery
    if charge >= least:
        return ""
    return f"its battery has {charge:.0%} left, limits.battery is {least:.0%}"


def no_reply_for(for_s: float) -> str:
    """The sentence that no TIMESYNC request was answered for `for_s`; empty for a short time."""
    if for_s < UNANSWERED_S:
        return ""
    return f"no TIMESYNC request was answered for {for_s:.0f} s: does the vehicle receive them?"


def _measuring(ground: Ground) -> str:
    clock, host_s = ground.clock, ground.host_s
    if clock.delay_is_measured(host_s):
        return ""
    return no_reply_for(clock.unanswered_s(host_s)) or "the delay of the link is being measured"


def _late(ground: Ground) -> str:
    delay, limits = ground.clock.delay, ground.limits
    if delay is None or (delay.value <= limits.link_delay_s and delay.sd <= limits.link_jitter_s):
        return ""
    return (
        f"the delay of the link is {1e3 * delay.value:.0f} +- {1e3 * delay.sd:.0f} ms, at most "
        f"{1e3 * limits.link_delay_s:.0f} +- {1e3 * limits.link_jitter_s:.0f} ms can be flown "
        "(limits.link_delay_s, limits.link_jitter_s)"
    )


_ESTIMATOR = (
    "wait for a GPS fix, or check that external vision arrives (PX4: EKF2_EV_CTRL), keep the "
    "vehicle still and away from metal; then calibrate"
)
_UNFIT = (
    "check MAV_TYPE or FRAME_CLASS, and airframe in the vehicle file; if they are right, fly it "
    "with its own autopilot"
)
_FAILSAFE = "let the pilot take over first"
_OTHER_MODE = "select {ground.known_dialect.hold_mode}, as `offboard fly` does first"
_CHOOSE = "choose one with --system, or give each vehicle its own port"
_SAME_ID = "switch one off, or change its system id"
_ONE_WAY = f"{_SAME_ID}; send the telemetry of one vehicle over one link only"


WARN, WAIT, BLOCKS = Level.WARN, Level.WAIT, Level.BLOCKS
PREFLIGHT = (
    Row("state", BLOCKS, _flown_by_another, "stop that controller", at_once=True, fly_only=True),
    Row("state", BLOCKS, _flown_by_failsafe, _FAILSAFE, at_once=True, fly_only=True),
    Row("state", BLOCKS, armed_already, "disarm it", at_once=True, fly_only=True),
    Row("senders", BLOCKS, other_sender, "stop it", at_once=True, fly_only=True),
    Row("senders", BLOCKS, _several_vehicles, _CHOOSE, at_once=True),
    Row("senders", BLOCKS, _same_system_id, _SAME_ID, at_once=True),
    Row("senders", BLOCKS, twin, _ONE_WAY),
    Row("senders", BLOCKS, signs, senders.GIVE_KEY),
    Row("rates", WAIT, _no_telemetry, _remedy),
    Row("supervisor", WAIT, _unguarded),
    Row("rates", BLOCKS, _slow, "{ground.known_dialect.slow_hint}"),
    Row("state", BLOCKS, _landed_unknown),
    Row("parameters", WAIT, _reading),
    Row("origin", WAIT, _origin),
    Row("estimator", _estimate_level, _no_estimate, _ESTIMATOR),
    Row("prearm", WAIT, _prearm, _prearm_fix, fly_only=True),
    Row("prearm", WARN, _needs_setpoints, _OTHER_MODE, fly_only=True),
    Row("battery", BLOCKS, _empty_battery, "charge the battery"),
    Row("volume", BLOCKS, _outside_volume, "fly nearer to that point, or raise the limits"),
    Row("delay", WAIT, _measuring),
    Row("delay", BLOCKS, _late, "use a faster link"),
)
