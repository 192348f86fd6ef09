"""`Dialect`: the differences between autopilots at the MAVLink boundary, as data.

px4.py and ardupilot.py have the instances. No other code branches on the name of the autopilot.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

from pymavlink.dialects.v20 import all as mavlink

from offboard.mavlink.outgoing import CommandLong

SET_MODE, TAKEOFF = 176, 22  # MAV_CMD
_CUSTOM_MODE_ENABLED = 1.0  # MAV_MODE_FLAG_CUSTOM_MODE_ENABLED
# names of fields of `Vehicle`
ACCELERATION_LIMIT, RATE_LIMIT = "angular_acceleration_limit_radps2", "angular_rate_limit_radps"
TYPE_ONBOARD_CONTROLLER, TYPE_GCS = 18, 6  # MAV_TYPE
FRAME_BYTES = 12  # header and checksum of a MAVLink 2 frame


def id_of(message: str) -> int:
    """The id of the message with this name."""
    return int(getattr(mavlink, f"MAVLink_{message.lower()}_message").id)


@dataclass(frozen=True, slots=True)
class WantedMessage:
    """A telemetry message and the rate to request. An optional message that does not arrive, or
    arrives too slowly although its rate was changed, is requested at most twice. `unchanged_hz` is
    the rate of a message that is sent at `rate_hz` only while its content changes."""

    name: str
    rate_hz: float
    optional: bool = False
    unchanged_hz: float | None = None

    @property
    def message_id(self) -> int:
        return id_of(self.name)

    @property
    def arrives_hz(self) -> float:
        """Lowest rate at which it arrives if the vehicle sends it as requested."""
        return self.rate_hz if self.unchanged_hz is None else self.unchanged_hz

    @property
    def bytes_ps(self) -> float:
        """Bytes per second of its frames at `arrives_hz`."""
        payload_bytes: int = mavlink.mavlink_map[self.message_id].unpacker.size
        return self.arrives_hz * (FRAME_BYTES + payload_bytes)


class ParameterFault(NamedTuple):
    """What is wrong with a parameter's value, and the line that sets another one."""

    found: str
    fix: str


@dataclass(frozen=True, slots=True)
class Valid:
    """Valid values of a parameter: `lowest` to `highest`, with `bits` set.

    `why` says what any other value means, if the meaning of the parameter does not say so. `set_to`
    is the suggested value (with `bits`: the value with these bits set). `applies` gets all known
    parameters and whether a radio is received, and returns whether the advice is given.
    """

    why: str = ""
    set_to: float = math.nan
    lowest: float = -math.inf
    highest: float = math.inf
    bits: int = 0
    applies: Callable[[Mapping[str, float], bool], bool] = lambda known, radio: True


@dataclass(frozen=True, slots=True)
class WatchedParameter:
    """A parameter of the autopilot that is read before flight.

    A flight is refused if the value is not as `required`, or if a parameter with `must_answer` has
    no reply. `advice` is for `offboard doctor`; a parameter with `advice_only` is read only there.
    `values` names the values of an enumeration. `replaces` is the name of the parameter in the
    oldest release, if it has changed.
    """

    name: str
    meaning: str
    required: Valid = Valid()
    must_answer: bool = False
    advice: tuple[Valid, ...] = ()
    advice_only: bool = False
    values: tuple[str, ...] = ()
    replaces: str = ""

    @property
    def oldest(self) -> str:
        """The name of the parameter in the oldest release."""
        return self.replaces or self.name

    def fault(self, value: float) -> ParameterFault | None:
        """Why a vehicle with this `value` is not flown, or None if it is."""
        return self._fault(value, self.required)

    def advised(
        self, value: float, known: Mapping[str, float], radio: bool
    ) -> ParameterFault | None:
        """Why `value` is not recommended, or None. `known` has all known parameters; `radio`:
        whether a radio is received."""
        applying = (each for each in self.advice if each.applies(known, radio))
        return next(filter(None, (self._fault(value, each) for each in applying)), None)

    def shown(self, value: float) -> str:
        """The value as text, with its name if it has one."""
        named = 0 <= value < len(self.values) and value == int(value)
        return f"{value:g} ({self.values[int(value)]})" if named else f"{value:g}"

    def _fault(self, value: float, valid: Valid) -> ParameterFault | None:
        bits = int(value)
        if valid.lowest <= value <= valid.highest and bits & valid.bits == valid.bits:
            return None
        found = f"{self.name} is {self.shown(value)}: {valid.why or self.meaning}"
        set_to = bits | valid.bits if valid.bits else valid.set_to
        return ParameterFault(found, f"param set {self.name} {set_to:g}")


@dataclass(frozen=True, slots=True)
class SetpointLoss:
    """What an autopilot does by itself when setpoints stop: after `after_s` it enters one of
    `modes` and reports a failsafe (HEARTBEAT.system_status). Without `modes` it levels and stays
    in its mode."""

    after_s: float
    modes: tuple[str, ...] = ()


NEVER = SetpointLoss(math.inf)


@dataclass(frozen=True)
class Dialect:
    """One autopilot. Modes have names; `modes` maps HEARTBEAT.custom_mode to the name."""

    name: str
    mav_autopilot: int
    modes: Mapping[int, str]
    # custom_mode -> parameters 2 and on of MAV_CMD_DO_SET_MODE
    mode_parameters: Callable[[int], tuple[float, ...]]
    engage_mode: str
    hold_mode: str
    land_mode: str
    return_mode: str
    takes_off_by_command: bool  # whether it takes off by MAV_CMD_NAV_TAKEOFF, else by setpoints
    unused_parameter: float  # value of a COMMAND_LONG parameter that means "not given"
    divides_by_tilt: bool  # whether it divides the thrust of a setpoint by the cosine of its tilt
    integers_bytewise: bool  # whether PARAM_VALUE has the four bytes of an integer, else its value
    watched_parameters: tuple[WatchedParameter, ...]
    wanted: tuple[WantedMessage, ...]
    hover_parameter: str  # normalised thrust that holds the weight
    tilt_parameters: Mapping[str, float]  # greatest tilt of its own modes -> its unit in rad
    # parameter with the greatest angular acceleration or rate of roll or pitch -> field of
    # `Vehicle`, and the parameter's unit in rad/s^2 or rad/s; a value of 0 means no limit
    tilting_parameters: Mapping[str, tuple[str, float]]
    estimator_message: str  # the message that becomes an EstimatorReport
    slow_hint: str  # what to do if telemetry arrives more slowly than requested
    unsaid: str  # where the user finds a reason that no STATUSTEXT tells us
    oldest: tuple[int, int]  # oldest version that this dialect is made for
    # parameters -> what the vehicle does when setpoints stop; a missing one may have any value
    setpoint_loss: Callable[[Mapping[str, float]], SetpointLoss]
    # part of a STATUSTEXT that names a problem -> what the user should do about it
    remedies: Mapping[str, str] = field(default_factory=dict)
    # modes that a pilot flies by sticks while the autopilot holds the height
    assisted_modes: tuple[str, ...] = ()
    without_gps: str = ""  # what else the vehicle needs to fly without GPS, as an imperative
    # known defects of its firmware -> the version that fixes each, as (major, minor)
    defects: Mapping[str, tuple[int, int]] = field(default_factory=dict)

    def mode_name(self, custom_mode: int) -> str:
        return self.modes.get(custom_mode) or f"UNKNOWN(0x{custom_mode:08x})"

    def remedy(self, texts: Iterable[str]) -> str:
        """What to do about these texts of the vehicle; empty if they say it, or it is not known."""
        told = "\n".join(texts)
        return next((fix for part, fix in self.remedies.items() if part in told), "")

    def without_reply(self, known: Mapping[str, float]) -> list[WatchedParameter]:
        """The watched parameters for which no name of any release has had a reply."""
        replied = {each.oldest for each in self.watched_parameters if each.name in known}
        return [each for each in self.watched_parameters if each.oldest not in replied]

    def set_mode(self, name: str) -> CommandLong:
        """MAV_CMD_DO_SET_MODE. Raises KeyError for an unknown mode."""
        numbers = {known: custom_mode for custom_mode, known in self.modes.items()}
        return CommandLong(SET_MODE, (_CUSTOM_MODE_ENABLED, *self.mode_parameters(numbers[name])))

    def engage(self) -> CommandLong:
        return self.set_mode(self.engage_mode)

    def hold(self) -> CommandLong:
        return self.set_mode(self.hold_mode)

    def take_off(self, altitude_m: float) -> CommandLong:
        """MAV_CMD_NAV_TAKEOFF at the present position. `altitude_m` is above home on ArduCopter,
        above mean sea level on PX4."""
        unused = self.unused_parameter
        return CommandLong(TAKEOFF, (0.0, 0.0, 0.0, unused, unused, unused, altitude_m))


TRACKING_TELEMETRY = (
    WantedMessage("ATTITUDE_QUATERNION", 100.0),
    WantedMessage("LOCAL_POSITION_NED", 100.0),
    WantedMessage("EXTENDED_SYS_STATE", 5.0),
    WantedMessage("SYS_STATUS", 2.0),
    WantedMessage("ATTITUDE_TARGET", 8.0, optional=True),  # the autopilot's thrust, before ours
    WantedMessage("GPS_RAW_INT", 5.0, optional=True),
)
