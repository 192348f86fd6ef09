"""What a firmware consists of: data and small functions that the rest of the simulator runs on.

The autopilot and the MAVLink server never ask which firmware they run; they read one `Firmware`
value. `px4` and `ardupilot` are folders with the same files, one for each part below. Another
firmware is one more folder. Knows no simulator core, no message builder and no socket.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

from simulator.firmware.values import (
    ArmRequest,
    AttitudeSetpoint,
    Condition,
    MissionItem,
    Mode,
    ModeRequest,
    MotionSetpoint,
    Quaternion,
    ReadParameter,
    Result,
    ReturnYaw,
    StatusText,
    Triple,
)
from simulator.vehicle.battery import BatteryState

# -- parameters --------------------------------------------------------------------------------

Role = str | float | tuple[str, float]
"""Where a value comes from: a parameter, a constant, or a parameter and the factor to SI."""


@dataclass(frozen=True, slots=True)
class ParameterSpec:
    """One parameter. PARAM_SET may set any value; the vehicle obeys [minimum, maximum]."""

    name: str
    kind: Literal["int8", "int16", "int32", "real32"]
    default: float
    minimum: float
    maximum: float
    meaning: str


# -- setpoints ---------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class SetpointRules:
    """How a firmware reads setpoint messages, and when it obeys them."""

    attitude: Callable[[Mapping[str, Any], ReadParameter], AttitudeSetpoint | MotionSetpoint | None]
    motion: Callable[[Mapping[str, Any]], MotionSetpoint | None]
    # fields in another local frame, position and attitude -> the same fields in MAV_FRAME 1
    in_local_frame: Callable[[Mapping[str, Any], Triple, Quaternion], Mapping[str, Any]]
    home_mirrored: bool  # in heights above home, home's own height enters with the wrong sign
    global_frames: frozenset[int]  # MAV_FRAME accepted in SET_POSITION_TARGET_GLOBAL_INT
    # text about this message in an unknown MAV_FRAME, or (None) without any demand
    rejection: Callable[[str, int | None], StatusText | None]
    mode_needs_stream: bool  # pre-arm checks of the setpoint mode fail without a stream
    as_automatic: bool  # flown with the speeds and turn rates of automatic flight
    outlive_modes: bool  # taken in any mode and kept; else in the setpoint mode only
    imply_flight: bool  # any thrust counts as flight; the land detector does not run
    spool_s: float  # from arming until the thrust of a setpoint acts
    reaction_s: float  # from the time-out of the stream until it counts as lost


# -- state table -----------------------------------------------------------------


AFTER_DELAY = " after delay"
"""Ends the event of a failsafe whose action was delayed."""

EVENTS = frozenset({
    # requests: commands, messages, faults that act for a pilot
    "mode", "takeoff", "land", "return", "loiter", "turn", "mission", "reboot",
    "arm", "disarm", "force arm", "force disarm", "checks", "thrust not a number",
    # monitoring
    "stream lost", "stream found", "position lost", "position found",
    "ground station lost", "ground station found",
    "battery low", "battery critical", "battery emergency",
    # flight
    "took off", "landed", "settled", "idle", "climbed", "already higher", "item reached",
    "mission progress", "mission return", "mission finished",
})  # fmt: skip
"""Events of every firmware; `HealthRules.boot` has those of the start."""


@dataclass(frozen=True, slots=True)
class Rule:
    """One row of the state table: the first row that fits an event decides.

    Args:
        event: one of EVENTS, or a boot event.
        mode: name of the mode in which it happened, or "*".
        when: conditions that must all hold (`simulator.autopilot.commander.CONDITIONS`). "not X"
            negates, "NAME=2" compares a parameter, "since X" is a failsafe because of event X,
            "reached X" a boot event that has come, "latched X" an event that only a reboot clears.
        to: next mode by name, "*" none, "requested" by the command, "remembered" the last chosen.
        do: actions (`simulator.autopilot.commander.ACTIONS`).
        result: acknowledgement of a command.
        texts: STATUSTEXTs; they may name {mode} and `simulator.autopilot.commander.TEXT_VALUES`.
        send: messages to send on every link.
    """

    event: str
    mode: str = "*"
    when: tuple[str, ...] = ()
    to: str = "*"
    do: tuple[str, ...] = ()
    result: Result = Result.ACCEPTED
    texts: tuple[StatusText, ...] = ()
    send: tuple[str, ...] = ()


# -- commands ----------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class CommandRules:
    """How a firmware reads commands and acknowledges them."""

    mode: Callable[[tuple[float, ...]], ModeRequest]  # params of MAV_CMD_DO_SET_MODE
    mode_acked_twice: bool  # by the receiver before the commander does
    set_mode: Callable[[int, int], ModeRequest]  # SET_MODE: base_mode, custom_mode
    set_mode_acked_as: int | None  # MAV_CMD in the acknowledgement of SET_MODE; None: there is none
    arm: Callable[[float], ArmRequest]  # param1 of MAV_CMD_COMPONENT_ARM_DISARM
    force_codes: Mapping[str, float]  # its param2: arm, disarm
    takeoff_above_home: bool  # height of MAV_CMD_NAV_TAKEOFF; else above mean sea level
    reposition_mode: str  # mode for MAV_CMD_DO_REPOSITION
    repositions_strictly: bool  # it needs a frame and a place; yaw and speed are ignored
    speed_refusal: Result  # of MAV_CMD_DO_CHANGE_SPEED without a speed
    # MAV_CMD acknowledged and not carried out: result, None: no acknowledgement. Any other command
    # without a handler is UNSUPPORTED
    answers: Mapping[int, Result | None]


# -- missions ----------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class MissionRules:
    """What a firmware takes of missions, fences and rally points, and how it sends them back."""

    strict: bool  # downloads in order only; items are requested in the kind that came last
    home_first: bool  # item 0 of a mission is home
    guided_items: bool  # an item with current = 2 is a place to fly to now
    # MAV_MISSION_TYPE and item -> MAV_MISSION_RESULT and text of a refusal
    refusal: Callable[[int, MissionItem], tuple[int, StatusText | None] | None]
    unknown_kind: int  # MAV_MISSION_RESULT for an unknown MAV_MISSION_TYPE
    texts: Mapping[int, StatusText]  # after an upload, by MAV_MISSION_TYPE
    frame_shown: Callable[[MissionItem, bool], int]  # in whole 1e-7 degrees, or in degrees
    without_autocontinue: frozenset[int]  # MAV_MISSION_TYPE
    turning: frozenset[int]  # MAV_CMD whose fourth parameter is a yaw
    reached_above_landing: bool  # also a landing is "item reached" above its place
    keeps_speed: bool  # of a change-speed item across a pause


# -- link --------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Streams:
    """Messages that a firmware sends periodically and on request."""

    companion_rates_hz: Mapping[str, float]  # without a request, by link
    ground_rates_hz: Mapping[str, float]
    # message -> builder, beside `simulator.mavlink.telemetry.BUILDERS` or in place of one
    messages: Mapping[str, Callable[[Any], Sequence[Any]]]
    withheld_until: Mapping[str, str]  # message -> boot event before which it is not sent
    # message -> version of its content: a message that is due waits until it is a new one
    versions: Mapping[str, Callable[[Any], Hashable]]
    position_grid_steps: int  # the estimator's position is new at every such step
    fixed: frozenset[str]  # messages whose interval cannot be changed
    not_on_request: frozenset[str]
    never_sent: frozenset[int]  # ids of which an interval is accepted
    groups: Mapping[int, tuple[str, ...]]  # REQUEST_DATA_STREAM: MAV_DATA_STREAM -> messages
    rate_max_hz: float
    refusal: Result  # of an interval
    refusal_text: str  # may name {id}; "": none
    too_fast_text: str
    request_refusal: Result  # of MAV_CMD_REQUEST_MESSAGE


@dataclass(frozen=True, slots=True)
class LinkRules:
    """Link behaviour of a firmware."""

    is_ground_station: Callable[[int, int, ReadParameter], bool]  # MAV_TYPE, system of a heartbeat
    ground_station_stays_s: float  # after its last heartbeat
    obeys_system: Callable[[int, int, ReadParameter], bool]  # sender, own
    target_component_checked: bool
    text_suffix: str
    text_to_ground_stations_only: bool
    parameters_bytewise: bool  # PARAM_VALUE holds the bytes of an integer, not its value
    parameters_hashed: bool  # a list begins with _HASH_CHECK
    accepted_unsigned: frozenset[int]  # messages that need no signature
    stamps_follow_clock: bool  # of signatures; else they only count, and follow those of others
    parameters_numbered: bool  # PARAM_VALUE.param_index is set also outside a list


# -- health ------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Sensors:
    """SYS_STATUS: MAV_SYS_STATUS_SENSOR bits once GPS has a fix, and when that is."""

    present: int
    enabled: int
    health: int
    first_fix_s: float


@dataclass(frozen=True, slots=True)
class HealthRules:
    """How a firmware starts, when its checks pass, and when it fails."""

    boot: Mapping[str, float]  # events of the start, s of vehicle time
    sensors: Sensors
    passes_after_s: float  # boot until the pre-arm checks pass
    passes_without_position_after_s: float  # the same for modes that need none
    fails_where_unarmable: bool  # pre-arm checks fail in a mode that does not arm
    position_without_fix_s: float  # until the position estimate is lost
    velocity_ratio: Callable[[float], float]  # error of the velocity in m/s -> innovation ratio
    velocity_ratio_most: Callable[[ReadParameter], float]  # to arm; 0: not checked
    battery_level: Callable[[BatteryState, ReadParameter], int]  # 0: good
    battery_events: tuple[str, ...]  # of levels 1 on


# -- flight ------------------------------------------------------------------------------------


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
    # of automatic flight
    turn_radps: float
    speeding_mps2: float
    braking_mps2: float
    vertical_mps2: float
    facing_mps: float  # wanted across the ground, from which on it faces the direction of flight


@dataclass(frozen=True, slots=True)
class Landing:
    """Land detector. Shares are between the least and the hover thrust."""

    low_thrust_share: float  # no more than this can be a landing
    idle_thrust_share: float  # more than this is a takeoff
    sinking_mps: float  # a demand to descend at this speed is one to land
    speed_down_mps: float  # estimated, of a vehicle that stands
    speed_across_mps: float
    rate_radps: float  # roll and pitch together
    place_below_is_descent: bool


@dataclass(frozen=True, slots=True)
class StickFlight:
    """How a firmware flies by sticks."""

    default_pulses_us: tuple[int, ...]  # without RC: roll, pitch, throttle, yaw, further channels
    climb_mps: float  # at full throttle, and down without
    turn_radps: float
    speed_mps: float
    acceleration_mps2: float  # at full deflection
    braking_mps2: float  # with all sticks centred
    braking_after_s: float


@dataclass(frozen=True, slots=True)
class FlightRules:
    """Automatic flight of a firmware."""

    gains: Callable[[ReadParameter], PositionGains]
    integrates_on_ramp: bool  # position loop, in a takeoff that still stands on the ground
    landing: Landing
    descend_speed_mps: float  # in a manual mode without stick input
    sticks: StickFlight | None  # None: not flown by sticks
    return_height_m: Callable[[float, ReadParameter], float]  # above home, by the distance to it
    return_yaw: Callable[[float, ReadParameter], ReturnYaw | None]  # likewise; None: unchanged


# -- the whole ---------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Firmware:
    """One firmware. `parameter_roles` maps what the simulator needs to parameters."""

    name: str
    vehicle: str  # default vehicle and scenario
    scenario: str
    mav_autopilot: int
    version: int  # AUTOPILOT_VERSION.flight_sw_version
    capabilities: int  # MAV_PROTOCOL_CAPABILITY
    origin: Triple  # of the local frame: latitude, longitude deg, AMSL m
    modes: Mapping[str, Mode]
    boot_mode: str
    hold_mode: str  # in which the vehicle stops and holds its position
    heartbeat: Callable[[Condition], tuple[int, int]]  # base_mode but the armed bit, MAV_STATE
    rules: tuple[Rule, ...]
    parameters: tuple[ParameterSpec, ...]
    parameter_roles: Mapping[str, Role]
    system_parameter: str  # holds the system id
    commands: CommandRules
    setpoints: SetpointRules
    missions: MissionRules
    streams: Streams
    link: LinkRules
    health: HealthRules
    flight: FlightRules

    def mode_named(self, name: str) -> Mode | None:
        """Mode by its name, of which "AUTO." may be left out; None where there is none."""
        return self.modes.get(name) or self.modes.get(f"AUTO.{name}")
