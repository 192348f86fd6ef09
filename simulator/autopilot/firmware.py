"""What a firmware consists of: data as fields, and how it reads and answers as methods.

The autopilot and the MAVLink server never ask which firmware they run; they read one `Firmware`.
`simulator.firmware.px4` and `simulator.firmware.ardupilot` are its two subclasses. Knows
the state estimate, but no autopilot, no message builder and no socket.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Hashable, Mapping
from dataclasses import dataclass, field
from types import ModuleType
from typing import Any, Literal

from simulator.autopilot.state import StateEstimate
from simulator.autopilot.values import (
    Asked,
    AttitudeSetpoint,
    MissionItem,
    Mode,
    MotionSetpoint,
    ParameterValues,
    Result,
    StatusText,
    Triple,
)
from simulator.vehicle.conditions import BatteryState

_MAV_TYPE_GCS = 6
Role = str | float | tuple[str, float] | Callable[[ParameterValues], float]
"""Where a value comes from: a parameter, a constant, a parameter and a factor, or a function of
parameters. `simulator.firmware.px4_tables.ROLES` says what each role means."""


RANGES = {"int8": (-128, 127), "int16": (-32768, 32767), "int32": (-(2**31), 2**31 - 1)}
"""The least and greatest value of each kind of whole parameter."""


@dataclass(frozen=True, slots=True)
class ParameterSpec:
    """One parameter. PARAM_SET may set any value; the vehicle obeys [minimum, maximum]."""

    name: str
    kind: Literal["int8", "int16", "int32", "real32"]
    default: float
    minimum: float
    maximum: float


AFTER_DELAY = " after delay"
"""Ends the event of a failsafe whose action was delayed."""


@dataclass(frozen=True, slots=True)
class ByParameter:
    """The next mode by the value of a parameter."""

    parameter: str
    modes: Mapping[int, str]


@dataclass(frozen=True, slots=True)
class Rule:
    """One row of the state table: the first row that fits an event decides.

    Args:
        event: its name; those of the start are in `Firmware.boot_events_s`.
        mode: names of the modes in which it happened, with spaces between, or "*".
        when: conditions that must all hold (`simulator.autopilot.commander.CONDITIONS`). "not X"
            negates, "NAME=1,2" holds if parameter NAME is 1 or 2, "since X" is a failsafe because
            of event X, "reached X" a boot event that has come, "latched X" an event that only a
            reboot clears, "requests X" a request of mode X.
        to: next mode by name, "*" none, "requested" by the command, "remembered" the last chosen;
            or `ByParameter`; then the row fits only the values listed there.
        do: actions (`simulator.autopilot.commander.ACTIONS`).
        result: acknowledgement of a command.
        texts: STATUSTEXTs; they may name {mode} and `simulator.autopilot.commander.TEXT_VALUES`.
        send: messages to send on every link.
    """

    event: str
    mode: str = "*"
    when: tuple[str, ...] = ()
    to: str | ByParameter = "*"
    do: tuple[str, ...] = ()
    result: Result = Result.ACCEPTED
    texts: tuple[StatusText, ...] = ()
    send: tuple[str, ...] = ()


@dataclass(frozen=True, kw_only=True)
class Firmware(ABC):
    """One firmware."""

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
    rules: tuple[Rule, ...]
    parameters: tuple[ParameterSpec, ...]
    parameter_roles: Mapping[str, Role]  # what the simulator needs -> where it comes from
    system_parameter: str  # holds the system id

    # commands
    mode_acked_twice: bool = False  # by the receiver before the commander does
    set_mode_acked_as: int | None = None  # MAV_CMD in the answer to SET_MODE; None: no answer
    force_codes: Mapping[str, float]  # param2 of MAV_CMD_COMPONENT_ARM_DISARM: arm, disarm
    reposition_mode: str  # mode for MAV_CMD_DO_REPOSITION
    # True: MAV_CMD_DO_REPOSITION needs a frame and a place, and its yaw and speed are ignored; the
    # height of MAV_CMD_NAV_TAKEOFF is above home; MAV_CMD_MISSION_START must not name an item.
    # False: that height is above mean sea level
    strict_places: bool = False
    empty_refusal: Result  # of a MAV_CMD_DO_CHANGE_SPEED without a speed, an interval of no message
    vertical_speeds: tuple[float, ...] = ()  # SPEED_TYPE of climb and descent; others are across
    no_interval_us: int = -1  # MESSAGE_INTERVAL of a message that is not streamed
    # MAV_CMD acknowledged and not carried out: result, None: no acknowledgement. Any other command
    # without a handler is UNSUPPORTED
    command_answers: Mapping[int, Result | None]

    # setpoints
    global_frames: frozenset[int]  # MAV_FRAME accepted in SET_POSITION_TARGET_GLOBAL_INT
    setpoint_mode_needs_stream: bool = False  # its pre-arm checks fail without a stream
    setpoints_as_automatic: bool = False  # flown with the speeds and turn rates of automatic flight
    setpoints_outlive_modes: bool = False  # taken in any mode; else in the setpoint mode only
    setpoints_imply_flight: bool = False  # any thrust is flight: no land detector

    # missions
    requests_kind_of_peer: bool = False  # items of a mission in the kind that came last
    # MAV_FRAME of a downloaded item, by its message and the uploaded one
    item_frames: Mapping[str, Mapping[int, int]]
    home_item_first: bool = False  # item 0 of a mission is home
    takeoff_items_climb: bool = False  # and never descend
    guided_items: bool = False  # an item with current = 2 is a place to fly to now
    mission_text: StatusText | None = None  # after an upload
    reached_above_landing: bool = False  # a landing is "item reached" above its place, too
    turning_items: frozenset[int] = frozenset()  # MAV_CMD whose fourth parameter is a yaw

    # telemetry
    companion_rates_hz: Mapping[str, float]  # without a request, by link
    ground_rates_hz: Mapping[str, float]
    messages: ModuleType  # builders beside those of `simulator.mavlink.messages`, or in their place
    withheld_until: Mapping[str, str] = field(default_factory=dict)  # by message: boot event
    # message -> version of its content: a message that is due waits until it is a new one
    message_versions: Mapping[str, Callable[[Any], Hashable]] = field(default_factory=dict)
    estimates_airspeed: bool = False  # in VFR_HUD, without wind
    position_grid_steps: int  # the estimator's position is new at every such step
    fixed_streams: frozenset[str]  # messages whose interval cannot be changed
    not_on_request: frozenset[str]
    never_sent: frozenset[int]  # ids of which an interval is accepted
    stream_groups: Mapping[int, tuple[str, ...]] = field(default_factory=dict)  # by MAV_DATA_STREAM
    rate_max_hz: float = math.inf
    interval_refusal: Result
    interval_refusal_text: str = ""  # may name {id}; "": none
    too_fast_text: str = ""
    request_refusal: Result  # of MAV_CMD_REQUEST_MESSAGE, and a termination that terminates nothing

    # link
    ground_station_parameter: str = ""  # its system id; "": known by its MAV_TYPE
    target_component_checked: bool = False
    ignored: frozenset[str] = frozenset()  # messages
    # kinds of messages, as their names begin, that are ignored if they are sent to all systems (0)
    never_to_all: frozenset[str] = frozenset()
    text_suffix: str = ""
    text_to_ground_stations_only: bool = False
    parameters_bytewise: bool = False  # PARAM_VALUE holds the bytes of an integer, not its value
    parameters_hashed: bool = False  # a list begins with _HASH_CHECK
    parameters_numbered: bool = False  # PARAM_VALUE.param_index is set also outside a list
    accepted_unsigned: frozenset[int]  # messages that need no signature
    stamps_follow_clock: bool = False  # else they only count, and follow those of others

    # health
    # Seconds after boot, by event: "fix" (first GPS fix), "ready" and "ready without position"
    # (from then on the pre-arm checks pass, in modes with and without need of a position), and
    # events in this firmware's rules
    boot_events_s: Mapping[str, float]
    sensor_bits: tuple[int, int, int]  # SYS_STATUS with a fix: present, enabled, healthy
    fails_where_unarmable: bool = False  # disarmed in a mode that does not arm, its checks fail
    velocity_ratio_squared: bool = False  # as it reports the innovation ratio of the velocity
    battery_events: tuple[str, ...]  # of battery levels 1 on

    # flight
    return_faces_way: bool = False  # a return faces the direction of flight
    # the position loop integrates during the takeoff ramp; else on the ground only after it
    integrates_on_ramp: bool = False
    place_below_is_descent: bool = False  # land detector: a place below is a demand to descend
    flown_by_sticks: bool = False

    def mode_named(self, name: str) -> Mode | None:
        """Mode by its name, of which "AUTO." may be left out; None where there is none."""
        return self.modes.get(name) or self.modes.get(f"AUTO.{name}")

    @abstractmethod
    def command_mode(self, params: tuple[float, ...]) -> Asked:
        """The request of MAV_CMD_DO_SET_MODE (176)."""

    @abstractmethod
    def set_mode(self, base_mode: int, custom_mode: int) -> Asked:
        """The request of SET_MODE, the deprecated message."""

    @abstractmethod
    def arm_request(self, param: float) -> Asked:
        """The request of MAV_CMD_COMPONENT_ARM_DISARM with this param1."""

    @abstractmethod
    def attitude_setpoint(
        self, values: Mapping[str, Any], parameters: ParameterValues
    ) -> AttitudeSetpoint | MotionSetpoint | None:
        """SET_ATTITUDE_TARGET as the firmware reads it; None: ignored without an answer."""

    @abstractmethod
    def motion_setpoint(self, values: Mapping[str, Any]) -> MotionSetpoint | None:
        """SET_POSITION_TARGET_LOCAL_NED in MAV_FRAME 1; None where nothing is demanded."""

    @abstractmethod
    def in_local_frame(
        self, values: Mapping[str, Any], estimate: StateEstimate
    ) -> Mapping[str, Any]:
        """Fields of SET_POSITION_TARGET_LOCAL_NED in another frame, as those in MAV_FRAME 1."""

    def setpoint_rejection(self, message: str, frame: int | None) -> StatusText | None:
        """Text about this message in an unknown MAV_FRAME, or (None) without any demand."""
        return None

    @abstractmethod
    def mission_refusal(self, item: MissionItem) -> tuple[int, StatusText | None] | None:
        """MAV_MISSION_RESULT and text with which an item is refused; None: it is taken."""

    def is_ground_station(self, kind: int, system: int, parameters: ParameterValues) -> bool:
        """Whether a heartbeat with this MAV_TYPE and system id is a ground station's."""
        name = self.ground_station_parameter
        return system == parameters[name] if name else kind == _MAV_TYPE_GCS

    def obeys_system(self, sender: int, own: int, parameters: ParameterValues) -> bool:
        """Whether messages of this system id are handled."""
        return True

    @abstractmethod
    def battery_level(self, battery: BatteryState, parameters: ParameterValues) -> int:
        """0: good; each further level has an event in `battery_events`."""

    @abstractmethod
    def return_height_m(self, distance_m: float, parameters: ParameterValues) -> float:
        """Height of a return above home, by the distance to it."""
