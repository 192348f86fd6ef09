"""What a firmware personality consists of: data the core of the simulator runs on.

The core (`simulator.autopilot`, `simulator.server`) never asks which firmware it is: modes, the
transition table, texts, numbers, timeouts, stream rates, parameters and the reading of setpoints
all come from one `Firmware` value. A further personality is one more module that builds one.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from enum import Enum, IntEnum
from typing import Any, Literal

from simulator.battery import BatteryState
from simulator.sticks import Handling

Triple = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]  # w, x, y, z; FRD -> NED
ReadParameter = Callable[[str], float]
NAN3: Triple = (math.nan, math.nan, math.nan)
AT_LAST = ", at last"  # ends the event of a failsafe that was put off


class Result(IntEnum):
    """MAV_RESULT."""

    ACCEPTED = 0
    TEMPORARILY_REJECTED = 1
    DENIED = 2
    UNSUPPORTED = 3
    FAILED = 4
    CANCELLED = 6


class Severity(IntEnum):
    """MAV_SEVERITY, those in use."""

    EMERGENCY = 0
    CRITICAL = 2
    WARNING = 4
    INFO = 6
    DEBUG = 7


class Behaviour(Enum):
    """What the vehicle does in a mode."""

    HOLD = "holds position"
    TAKEOFF = "climbs to the takeoff height"
    LAND = "descends where it is and lands"
    RETURN = "flies home and lands"
    MISSION = "flies the mission"
    DESCEND = "sinks slowly, as sticks that are not there ask for"
    LEVEL = "level, least throttle: sticks that are down"
    COAST = "goes on as last demanded: sticks that are not there"
    SETPOINT = "obeys setpoints"


@dataclass(frozen=True, slots=True)
class Mode:
    """One flight mode. `base_mode`: MAV_MODE_FLAG bits without the armed bit."""

    name: str
    title: str  # in texts
    custom_mode: int
    base_mode: int
    behaviour: Behaviour
    arms: bool = True  # the vehicle may be armed in it
    remembered: bool = True  # comes back after an automatic disarm
    needs_sticks: bool = False
    needs_position: bool = False


@dataclass(frozen=True, slots=True)
class Say:
    """A STATUSTEXT."""

    severity: Severity
    text: str


@dataclass(frozen=True, slots=True)
class Rule:
    """One row of the state table: the first row that fits an event decides.

    event: name of what happened. mode: name of the mode it happened in, or "*".
    when: names of guards that must all hold; "NAME=2" compares a parameter, "not X" negates,
        "since X" is a failsafe because of event X.
    to: next mode, "*" none, "requested" the mode asked for, "remembered" the last one chosen.
    do: actions ("arm", "disarm", "failsafe", "await", "recover", "take off", "hold", "level",
        "latch", "restart").
    result: what a command is answered with. say, also: texts. send: messages to every link.
    """

    event: str
    mode: str = "*"
    when: tuple[str, ...] = ()
    to: str = "*"
    do: tuple[str, ...] = ()
    result: Result = Result.ACCEPTED
    say: Say | None = None
    also: tuple[Say, ...] = ()
    send: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class ParameterSpec:
    """One parameter. Any value is taken by the wire; the vehicle obeys [minimum, maximum]."""

    name: str
    kind: Literal["int8", "int16", "int32", "real32"]
    default: float
    minimum: float
    maximum: float
    meaning: str


class Heads(Enum):
    """Course of an automatic flight."""

    ALONG = "the way that it flies"
    AS_HOME = "the course at home"


Role = str | float | tuple[str, float]
"""What fills a role: a parameter, a constant, or a parameter and the factor to SI."""


@dataclass(frozen=True, slots=True)
class AttitudeSetpoint:
    """What the firmware makes of a SET_ATTITUDE_TARGET. None: keep what was demanded before.

    `climb_mps` not None: the autopilot's own vertical loop makes the thrust. `event` happens when
    the setpoint is taken, for what a firmware does about values that it should have refused.
    """

    attitude: Quaternion | None
    rates_frd_radps: Triple | None
    thrust: float  # 0 .. 1
    climb_mps: float | None = None
    event: str = ""


@dataclass(frozen=True, slots=True)
class MotionSetpoint:
    """Position, velocity, acceleration (NED, SI), yaw (rad), yaw rate; NaN where not demanded."""

    position_ned_m: Triple = NAN3
    velocity_ned_mps: Triple = NAN3
    acceleration_ned_mps2: Triple = NAN3
    yaw_rad: float = math.nan
    yaw_rate_radps: float = math.nan
    faces_way: bool = False  # with neither yaw nor its rate demanded, the course is the way wanted
    turn_radps: float = math.inf  # no faster


@dataclass(frozen=True, slots=True)
class ModeRequest:
    """What a mode command asks for: a mode's name, or the result to refuse it with."""

    mode: str | None
    refusal: Result = Result.DENIED
    say: Say | None = None


@dataclass(frozen=True, slots=True)
class ArmWish:
    """What an arm or disarm command asks for: an event, or what it is refused with."""

    event: str = ""
    refusal: Result | None = None  # None: no answer
    say: Say | None = None


@dataclass(frozen=True, slots=True)
class MissionItem:
    """One item as it was uploaded: x and y in 1e-7 deg, z in m, of `frame` (MAV_FRAME)."""

    frame: int
    command: int  # MAV_CMD
    params: tuple[float, float, float, float]
    x: int
    y: int
    z: float


@dataclass(frozen=True, slots=True)
class MissionRules:
    """What a firmware takes of lists of items, by MAV_MISSION_TYPE, and how it shows them.

    `strict`: they go down in order alone, and are asked for in the kind that came last.
    `home_first`: the first item of a mission, there or not, is home. `guides`: an item marked
    current = 2 is where to go now. `refusal`: MAV_MISSION_RESULT and text of an item that is not
    taken. `texts` follow an upload. `frame_shown`: of an item in whole 1e-7 degrees, or in
    degrees. `stopping`: types whose items are shown without autocontinue.
    """

    strict: bool
    home_first: bool
    guides: bool
    refusal: Callable[[int, MissionItem], tuple[int, Say | None] | None]
    unknown_kind: int  # MAV_MISSION_RESULT of a MAV_MISSION_TYPE that it has not
    texts: Mapping[int, Say]
    frame_shown: Callable[[MissionItem, bool], int]
    stopping: frozenset[int]


@dataclass(frozen=True, slots=True)
class Condition:
    """What a heartbeat depends on."""

    mode: Mode
    reached: frozenset[str]  # boot events so far
    armed: bool
    landed: bool
    healthy: bool
    failsafe: bool
    faulty: bool
    setpoint: AttitudeSetpoint | MotionSetpoint | None  # in force


@dataclass(frozen=True, slots=True)
class Streams:
    """Telemetry on request: what is refused and how, and the groups of REQUEST_DATA_STREAM.

    Texts may name the message's {id}; an empty text says nothing.
    """

    fixed: frozenset[str]  # messages whose interval cannot be changed
    by_itself: frozenset[str]  # said when it happens, and not on request
    idle: frozenset[int]  # ids of which an interval is taken, and nothing ever said
    groups: Mapping[int, tuple[str, ...]]  # MAV_DATA_STREAM -> messages
    rate_max_hz: float
    refusal: Result  # of an interval
    refusal_text: str
    too_fast_text: str
    request_refusal: Result  # of MAV_CMD_REQUEST_MESSAGE


@dataclass(frozen=True, slots=True)
class Sensors:
    """SYS_STATUS: MAV_SYS_STATUS_SENSOR bits once GPS has a fix, and when that is."""

    present: int
    enabled: int
    health: int
    first_fix_s: float


@dataclass(frozen=True, slots=True)
class PositionGains:
    """Cascaded position loop: P on position, PID on velocity (acceleration out), and limits."""

    position_xy_ps: float
    position_z_ps: float
    velocity_xy: Triple  # P 1/s, I 1/s^2, D -
    velocity_z: Triple
    speed_xy_mps: float
    speed_up_mps: float
    speed_down_mps: float
    tilt_max_rad: float
    thrust_max: float
    derivative_cutoff_hz: float
    turn_radps: float  # of automatic flight, no faster
    facing_mps: float  # wanted across the ground, from which on it faces its way


@dataclass(frozen=True, slots=True)
class Landing:
    """How the land detector finds out. Shares are between the least and the hover thrust."""

    low_thrust_share: float  # no more than this can be a landing
    idle_thrust_share: float  # more than this is a takeoff
    sinking_mps: float  # told to go down at this is told to land
    speed_down_mps: float  # estimated, of a vehicle that stands
    speed_across_mps: float
    rate_radps: float  # roll and pitch together
    place_below_is_descent: bool


def as_given(values: Mapping[str, Any], _: Triple, __: Quaternion) -> Mapping[str, Any]:
    """Setpoints in any frame are taken as they are."""
    return values


def no_complaint(message: str, frame: int | None) -> Say | None:
    """Nothing is said of a setpoint's frame."""
    return None


@dataclass(frozen=True, slots=True)
class Firmware:
    """A personality. Roles of parameters: `parameter_roles` maps what the core needs to names."""

    name: str
    vehicle: str  # flown when no other is named
    scenario: str
    mav_autopilot: int
    version: int  # AUTOPILOT_VERSION.flight_sw_version
    capabilities: int  # MAV_PROTOCOL_CAPABILITY
    origin: tuple[float, float, float]  # of the local frame: latitude, longitude deg, AMSL m
    boot_mode: str
    reposition_mode: str  # in which it goes where MAV_CMD_DO_REPOSITION says
    repositions_strictly: bool  # its frame must be told and its place be one; yaw is ignored
    modes: Mapping[str, Mode]
    rules: tuple[Rule, ...]
    parameters: tuple[ParameterSpec, ...]
    parameter_roles: Mapping[str, Role]
    system_parameter: str  # that has the system id
    parameters_hashed: bool  # a list begins with what all values come to
    parameters_bytewise: bool  # INT32 lies in the float's bytes, not as its value
    companion_rates_hz: Mapping[str, float]
    ground_rates_hz: Mapping[str, float]
    streams: Streams
    own_messages: Mapping[str, Callable[[Any], Sequence[Any]]]  # beside `telemetry.BUILDERS`
    unknown_messages: frozenset[str]  # of `telemetry.BUILDERS`
    withheld_until: Mapping[str, str]  # message -> boot event before which it is not sent
    sensors: Sensors
    position_grid_steps: int  # the estimator's position is new at every such step
    boot: Mapping[str, float]  # events of the start, s of vehicle time
    mission_first: int  # item with which a mission begins: before it, home
    missions: MissionRules
    mode_acked_twice: bool  # the receiver acks a mode command before the commander does
    text_to_ground_stations_only: bool
    is_ground_station: Callable[[int, int, ReadParameter], bool]  # MAV_TYPE, system of a heartbeat
    ground_station_stays_s: float  # after its last heartbeat
    obeys_system: Callable[[int, int, ReadParameter], bool]  # sender, own
    text_suffix: str
    target_component_checked: bool
    answers_carry_index: bool  # PARAM_VALUE; else 65535 unless the list was asked for
    takeoff_above_home: bool  # MAV_CMD_NAV_TAKEOFF: else above mean sea level
    force_codes: Mapping[str, float]  # param2 of MAV_CMD_COMPONENT_ARM_DISARM: arm, disarm
    healthy_after_s: float  # boot until the pre-arm checks pass
    healthy_without_position_after_s: float  # the same for modes that need none
    unhealthy_where_unarmable: bool  # the pre-arm checks fail in a mode that does not arm
    setpoint_mode_needs_stream: bool
    setpoints_as_automatic: bool  # they are flown at the speeds and turns of automatic flight
    setpoints_outlive_modes: bool  # else obeyed only in their mode, forgotten on entering it
    setpoint_decides_flight: bool  # any thrust is flight; the land detector rests meanwhile
    setpoint_spool_s: float  # from arming until a setpoint's thrust acts
    stream_reaction_s: float  # from the stream's time-out until it counts as lost
    descend_speed_mps: float  # where sticks are missed
    handling: Handling | None  # by sticks; None: it has none
    landing: Landing
    gains: Callable[[ReadParameter], PositionGains]
    return_height_m: Callable[[float, ReadParameter], float]  # above home, by the distance to it
    # where a return heads at this distance: home, home's own course, or None: as it did
    return_heads: Callable[[float, ReadParameter], Heads | None]
    # how bad the battery is, and the events of becoming so bad, from 1 on
    battery_level: Callable[[BatteryState, ReadParameter], int]
    battery_events: tuple[str, ...]
    heartbeat: Callable[[Condition], tuple[int, int]]  # base_mode but the armed bit, MAV_STATE
    command_mode: Callable[[tuple[float, ...]], ModeRequest]
    set_mode: Callable[[int, int], ModeRequest]  # SET_MODE: base_mode, custom_mode
    speed_refusal: Result  # of MAV_CMD_DO_CHANGE_SPEED to no speed
    set_mode_acked_as: int | None  # what the acknowledgement of SET_MODE names; None: there is none
    arm_wish: Callable[[float], ArmWish]  # param1 of MAV_CMD_COMPONENT_ARM_DISARM
    # MAV_CMD that are not carried out: their answers, None for silence; the rest is UNSUPPORTED
    command_answers: Mapping[int, Result | None]
    attitude_setpoint: Callable[
        [Mapping[str, Any], ReadParameter], AttitudeSetpoint | MotionSetpoint | None
    ]
    motion_setpoint: Callable[[Mapping[str, Any]], MotionSetpoint | None]
    global_frames: frozenset[int]  # MAV_FRAME that SET_POSITION_TARGET_GLOBAL_INT may come in
    position_without_fix_s: float = math.inf  # until the estimate of position is given up
    # a SET_POSITION_TARGET in another local frame, by position and attitude, in MAV_FRAME 1
    in_local_frame: Callable[[Mapping[str, Any], Triple, Quaternion], Mapping[str, Any]] = as_given
    # what is said about the named setpoint message in an unknown MAV_FRAME, or demanding nothing
    motion_complaint: Callable[[str, int | None], Say | None] = no_complaint
