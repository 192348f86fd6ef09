"""What the simulator has to know about a firmware: fields with data, and methods that interpret
messages.

The autopilot and the MAVLink server never compare firmware names; they read one `Firmware`. Its
subclasses are in `simulator.firmware.px4` and `simulator.firmware.ardupilot`. Knows the state
estimate, but no autopilot, no message builder and no socket.
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
Refusal = tuple[int, StatusText | None]  # MAV_MISSION_RESULT and text
Role = str | float | tuple[str, float] | Callable[[ParameterValues], float]
"""Where a value comes from: a parameter, a constant, a parameter and a factor, or a function of
parameters. `simulator.firmware.px4_tables.ROLES` says what each role means."""


RANGES = {"int8": (-128, 127), "int16": (-32768, 32767), "int32": (-(2**31), 2**31 - 1)}
"""The least and greatest value of each kind of whole parameter."""


@dataclass(frozen=True, slots=True)
class ParameterSpec:
    """One parameter. PARAM_SET may store any value; the vehicle uses it limited to its range."""

    name: str
    kind: Literal["int8", "int16", "int32", "real32"]
    default: float
    minimum: float
    maximum: float


AFTER_DELAY = " after delay"
"""Ends the event of a failsafe whose action was delayed."""


@dataclass(frozen=True, slots=True)
class ByParameter:
    """A next mode that the value of a parameter selects."""

    parameter: str
    modes: Mapping[int, str]


@dataclass(frozen=True, slots=True)
class Rule:
    """One row of the state table: the first row that fits an event decides.

    Args:
        event: name of the event; `Firmware.boot_events_s` has the events of the start.
        mode: names of the modes in which the row applies, separated by spaces; "*": any mode.
        when: conditions that must all hold: those of `simulator.autopilot.commander.CONDITIONS`
            and those that the README explains; "not X" negates X.
        to: name of the next mode; "*": no change; "requested": the mode that the command names;
            "remembered": the last chosen mode with `Mode.remembered`; `ByParameter`: the row fits
            only its values.
        do: actions (`simulator.autopilot.commander.ACTIONS`).
        result: acknowledgement of a command.
        texts: STATUSTEXTs, in which {name} is one of `simulator.autopilot.commander.TEXT_VALUES`.
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
    """One firmware. The comment of a bool says what holds if it is True."""

    name: str
    vehicle: str  # default vehicle
    scenario: str  # default scenario
    mav_autopilot: int
    version: int  # AUTOPILOT_VERSION.flight_sw_version
    capabilities: int  # MAV_PROTOCOL_CAPABILITY
    origin: Triple  # origin of the local frame: latitude, longitude deg, AMSL m
    modes: Mapping[str, Mode]
    boot_mode: str
    hold_mode: str  # mode in which the vehicle stops and holds its position
    rules: tuple[Rule, ...]
    parameters: tuple[ParameterSpec, ...]
    parameter_roles: Mapping[str, Role]  # name of a value that the simulator needs -> its source
    system_parameter: str  # parameter with the system id

    # commands
    mode_acked_twice: bool = False  # the MAVLink receiver, too, acknowledges MAV_CMD_DO_SET_MODE
    set_mode_acked_as: int | None = None  # MAV_CMD in the answer to SET_MODE; None: no answer
    force_codes: Mapping[str, float]  # param2 of MAV_CMD_COMPONENT_ARM_DISARM that forces it
    reposition_mode: str  # mode that MAV_CMD_DO_REPOSITION enters
    # True: commands and missions as in ArduPilot. MAV_CMD_DO_REPOSITION needs a frame and a place,
    # and its yaw and speed are ignored; the height of MAV_CMD_NAV_TAKEOFF is above home;
    # MAV_CMD_MISSION_START must not name an item. Item 0 of a mission is home, a takeoff item does
    # not make the vehicle descend, disarming resets the mission, and a MISSION_ITEM with current =
    # 2 is a place to fly to at once. A mission under way cannot be cleared.
    # False: as in PX4. The height of MAV_CMD_NAV_TAKEOFF is above mean sea level; a landing item
    # counts as reached already above its place
    ardupilot_commands: bool = False
    # result of MAV_CMD_DO_CHANGE_SPEED without a speed, and of MAV_CMD_GET_MESSAGE_INTERVAL of an
    # unknown message
    empty_refusal: Result
    vertical_speeds: tuple[float, ...] = ()  # SPEED_TYPEs of climb and descent; others: horizontal
    no_interval_us: int = -1  # MESSAGE_INTERVAL.interval_us of a message that is not streamed
    # Result of each MAV_CMD that is acknowledged without being carried out; None: no
    # acknowledgement. Any other command without a handler is UNSUPPORTED
    command_answers: Mapping[int, Result | None]

    # setpoints
    global_frames: frozenset[int]  # MAV_FRAMEs accepted in SET_POSITION_TARGET_GLOBAL_INT
    # True: setpoints as in ArduPilot. Speed and turn rate limits are those of automatic flight;
    # with attitude setpoints any thrust counts as flight, and no landing is detected.
    # False: as in PX4. They are taken in any mode, and kept when the mode changes; without a stream
    # the pre-arm checks of their mode fail
    ardupilot_setpoints: bool = False

    # missions
    requests_kind_of_peer: bool = False  # requests items with or without _INT, as the peer last did
    # MAV_FRAME of a downloaded item, by its message and the MAV_FRAME of the upload
    item_frames: Mapping[str, Mapping[int, int]]
    frameless_items: frozenset[int] = frozenset()  # MAV_CMDs of items downloaded in frame 0
    mission_text: StatusText | None = None  # text after an upload
    # MAV_CMD -> name in the texts about the progress of a mission; without names there are none
    item_titles: Mapping[int, str] = field(default_factory=dict)
    turning_items: frozenset[int] = frozenset()  # MAV_CMDs of items whose param4 is a yaw

    # telemetry
    companion_rates_hz: Mapping[str, float]  # rates of the messages sent without a request
    ground_rates_hz: Mapping[str, float]
    messages: ModuleType  # builders in addition to `simulator.mavlink.messages`, or in their place
    withheld_until: Mapping[str, str] = field(default_factory=dict)  # message -> boot event
    # message -> function that returns the version of its content; a message that is due waits
    # until the version is a new one
    message_versions: Mapping[str, Callable[[Any], Hashable]] = field(default_factory=dict)
    estimates_airspeed: bool = False  # VFR_HUD has an airspeed: the speed over ground, without wind
    position_grid_steps: int  # number of steps from one new position estimate to the next
    fixed_streams: frozenset[str]  # messages whose interval cannot be changed
    not_on_request: frozenset[str]  # messages that MAV_CMD_REQUEST_MESSAGE refuses
    never_sent: frozenset[int]  # ids of messages that are not sent, but accept an interval
    stream_groups: Mapping[int, tuple[str, ...]] = field(default_factory=dict)  # by MAV_DATA_STREAM
    rate_max_hz: float = math.inf
    interval_refusal: Result
    interval_refusal_text: str = ""  # STATUSTEXT, may contain {id}; "": none
    too_fast_text: str = ""  # the same for a rate above `rate_max_hz`
    request_refusal: Result  # of MAV_CMD_REQUEST_MESSAGE, MAV_CMD_DO_FLIGHTTERMINATION with 0

    # link
    ground_station_parameter: str = ""  # has its system id; "": recognised by MAV_TYPE
    target_component_checked: bool = False  # messages for another component are not handled
    ignored: frozenset[str] = frozenset()  # messages that are not handled
    # first words of the names of messages that are ignored if their target is all systems (0)
    never_to_all: frozenset[str] = frozenset()
    text_suffix: str = ""  # appended to each STATUSTEXT
    text_to_ground_stations_only: bool = False  # STATUSTEXTs wait for a ground station
    # parameters as in PX4: PARAM_VALUE has the bytes of an integer, not its value; a list begins
    # with _HASH_CHECK; param_index is set also outside a list
    px4_parameters: bool = False
    accepted_unsigned: frozenset[int]  # ids of messages that need no signature
    stamps_follow_clock: bool = False  # of signatures; False: they only count

    # health
    # Seconds after boot, by event: "fix" (first GPS fix), "ready" and "ready without position"
    # (from then on the pre-arm checks pass in modes that need a position, and in the others), and
    # events in this firmware's rules
    boot_events_s: Mapping[str, float]
    sensor_bits: tuple[int, int, int]  # SYS_STATUS with a fix: present, enabled, healthy
    fails_where_unarmable: bool = False  # while disarmed, checks fail in a mode that does not arm
    battery_events: tuple[str, ...]  # events of the battery levels 1, 2, ...

    # flight
    return_faces_way: bool = False  # during a return the nose points in the direction of flight
    # the position loop integrates on the ground during the takeoff ramp; False: only after it
    integrates_on_ramp: bool = False
    place_below_is_descent: bool = False  # land detector: a place below is a demand to descend
    # pulse widths of the RC channels that no client overrides: roll, pitch, throttle, yaw, mode
    # switch and others; 0: no input
    default_sticks_us: tuple[int, ...] = (0,) * 8

    def mode_named(self, name: str) -> Mode | None:
        """Return the mode of this name, in which "AUTO." may be left out, or None."""
        return self.modes.get(name) or self.modes.get(f"AUTO.{name}")

    @abstractmethod
    def command_mode(self, params: tuple[float, ...]) -> Asked:
        """Return what MAV_CMD_DO_SET_MODE (176) with these param1 .. param7 requests."""

    @abstractmethod
    def set_mode(self, base_mode: int, custom_mode: int) -> Asked:
        """Return what the deprecated message SET_MODE requests."""

    @abstractmethod
    def arm_request(self, param: float) -> Asked:
        """Return what MAV_CMD_COMPONENT_ARM_DISARM with this param1 requests."""

    @abstractmethod
    def attitude_setpoint(
        self, values: Mapping[str, Any], parameters: ParameterValues
    ) -> AttitudeSetpoint | MotionSetpoint | None:
        """Return the setpoint of SET_ATTITUDE_TARGET; None: the message is ignored without an
        answer."""

    @abstractmethod
    def motion_setpoint(self, values: Mapping[str, Any]) -> MotionSetpoint | None:
        """Return the setpoint of SET_POSITION_TARGET_LOCAL_NED in MAV_FRAME 1; None: it demands
        nothing."""

    @abstractmethod
    def in_local_frame(
        self, values: Mapping[str, Any], estimate: StateEstimate
    ) -> Mapping[str, Any]:
        """Convert fields of SET_POSITION_TARGET_LOCAL_NED from another frame to MAV_FRAME 1."""

    def setpoint_rejection(self, message: str, frame: int | None) -> StatusText | None:
        """Return the text about a setpoint message in an unknown MAV_FRAME, or (`frame` None) with
        no demand."""
        return None

    @abstractmethod
    def mission_refusal(self, item: MissionItem, kind: int, *, whole: bool) -> Refusal | None:
        """Return MAV_MISSION_RESULT and text of the refusal of an item of MAV_MISSION_TYPE `kind`;
        None: it is accepted.
        `whole`: whether it came as MISSION_ITEM_INT."""

    def is_ground_station(self, kind: int, system: int, parameters: ParameterValues) -> bool:
        """Whether a heartbeat with this MAV_TYPE and system id comes from a ground station."""
        name = self.ground_station_parameter
        return system == parameters[name] if name else kind == _MAV_TYPE_GCS

    @abstractmethod
    def takes_sticks_from(self, sender: int, parameters: ParameterValues) -> bool:
        """Whether stick input from the system id `sender` is used."""

    def obeys_system(self, sender: int, own: int, parameters: ParameterValues) -> bool:
        """Whether messages from the system id `sender` are handled."""
        return True

    @abstractmethod
    def battery_level(self, battery: BatteryState, parameters: ParameterValues) -> int:
        """Return the battery level: 0 is good, each other one has an event in `battery_events`."""

    @abstractmethod
    def return_height_m(self, distance_m: float, parameters: ParameterValues) -> float:
        """Return the height above home at which a return from this distance flies."""
