"""Events that the session reports to the flight: one frozen value per received message or change.

All values are in NED, FRD, SI and vehicle time (`time_boot_ms` in seconds), finite and in range. A
message with any other value is dropped.
"""

from __future__ import annotations

from collections.abc import Hashable
from dataclasses import dataclass

Triple = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]  # w, x, y, z; FRD -> NED
BOOTS = 1  # MAV_STATE_BOOT: sent by an ArduCopter while it starts
CRITICAL = 5  # MAV_STATE: a failsafe; 6 is an emergency
WARNING, NOTICE = 4, 5  # MAV_SEVERITY; more severe is a lower number
# longest age of a report of the mode that allows a setpoint or a command; HEARTBEAT comes at 1 Hz
MODE_KNOWN_S = 2.5
GOOD_RESULTS = ("ACCEPTED", "IN_PROGRESS")  # MAV_RESULT
HORIZONTAL = "velocity", "horizontal position"  # measurements of an EstimatorReport
MOTION = (*HORIZONTAL, "height")
ESTIMATE = ("attitude", "horizontal velocity", "horizontal position", "height")  # parts needed


class Event:
    """Base class of all events."""

    __slots__ = ()


@dataclass(frozen=True, slots=True)
class VehicleFound(Event):
    """The first HEARTBEAT of an autopilot. From now on the session accepts only this vehicle."""

    system_id: int
    component_id: int
    autopilot: str  # a key of senders.DIALECTS: "px4", "ardupilot"


@dataclass(frozen=True, slots=True)
class Heartbeat(Event):
    """HEARTBEAT of our vehicle."""

    mode: str  # the dialect's name of custom_mode: "OFFBOARD", "AUTO.LOITER", ...
    armed: bool
    system_status: int  # MAV_STATE: 3 standby, 4 active, 5 critical, 6 emergency
    vehicle_type: int  # MAV_TYPE


@dataclass(frozen=True, slots=True)
class ModeReport(Event):
    """CURRENT_MODE of our vehicle."""

    mode: str  # as in `Heartbeat`


@dataclass(frozen=True, slots=True)
class OtherSender(Event):
    """A frame that shows a second controller of our vehicle on this link: a setpoint that is not
    ours, or a mode command from another companion computer of the vehicle's system."""

    system_id: int
    component_id: int


@dataclass(frozen=True, slots=True)
class OtherCompanion(Event):
    """HEARTBEAT of another companion computer of our vehicle, which may use our own ids."""

    system_id: int
    component_id: int
    custom_mode: int  # if it is another `offboard`: the code of its phase


@dataclass(frozen=True, slots=True)
class CommandRequest(Event):
    """COMMAND_LONG or COMMAND_INT to our own component, forwarded by the vehicle or a router.
    Parameters may be NaN; of a COMMAND_INT only the first four are used."""

    command: int
    parameters: tuple[float, ...]
    system_id: int  # ids of the sender
    component_id: int


@dataclass(frozen=True, slots=True)
class LocalPosition(Event):
    """LOCAL_POSITION_NED."""

    time_s: float
    position_ned_m: Triple
    velocity_ned_mps: Triple


@dataclass(frozen=True, slots=True)
class Attitude(Event):
    """ATTITUDE_QUATERNION."""

    time_s: float
    attitude: Quaternion
    rates_frd_radps: Triple


@dataclass(frozen=True, slots=True)
class ThrustReport(Event):
    """ATTITUDE_TARGET: the collective thrust that the autopilot demands from its motors in any
    mode; on ArduCopter before the tilt compensation (ATC_ANGLE_BOOST)."""

    thrust: float  # normalised, 0 .. 1


@dataclass(frozen=True, slots=True)
class GpsFix(Event):
    """GPS_RAW_INT with a position fix in three dimensions."""


@dataclass(frozen=True, slots=True)
class NoFix(Event):
    """GPS_RAW_INT without a 3D fix."""

    fix_type: int  # GPS_FIX_TYPE: 0 no GPS, 1 no fix, 2 2D fix


@dataclass(frozen=True, slots=True)
class EstimatorReport(Event):
    """ESTIMATOR_STATUS (PX4) or EKF_STATUS_REPORT (ArduPilot).

    `ratios` has a pair (measurement, innovation divided by its test limit) for each measurement in
    use; the estimator rejects a measurement whose ratio is above 1.
    """

    valid: frozenset[str]  # parts of ESTIMATE; horizontal position: that relative to the origin
    ratios: tuple[tuple[str, float], ...]
    # horizontal standard deviation; None: not reported, or not finite
    accuracy_m: float | None = None
    by_gps: bool = True  # whether it uses positions of a GPS; only PX4 reports that it does not

    @property
    def horizontal_ratios(self) -> list[float]:
        return [ratio for name, ratio in self.ratios if name in HORIZONTAL]

    @property
    def worst(self) -> tuple[str, float]:
        """The measurement with the largest ratio, and that ratio; ("", 0.0) if there are none."""
        return max(self.ratios, key=lambda each: each[1], default=("", 0.0))

    @property
    def problem(self) -> str:
        """Why the vehicle cannot be flown with this estimate; empty if it can."""
        missing = [part for part in ESTIMATE if part not in self.valid]
        if missing:
            return f"its estimator has no valid {', '.join(missing)}"
        return self._rejects(*self.worst)

    @property
    def rejects_motion(self) -> str:
        """What it rejects of MOTION, whose estimate then drifts; may be empty. A heading that a
        magnet disturbs does not count."""
        motion = [each for each in self.ratios if each[0] in MOTION]
        return self._rejects(*max(motion, key=lambda each: each[1], default=("", 0.0)))

    def _rejects(self, name: str, ratio: float) -> str:
        if ratio <= 1.0:
            return ""
        return f"its estimator rejects {name} (innovation ratio {ratio:.2f}, limit 1)"


@dataclass(frozen=True, slots=True)
class FirmwareVersion:
    """AUTOPILOT_VERSION.flight_sw_version."""

    major: int
    minor: int
    patch: int
    kind: int  # FIRMWARE_VERSION_TYPE: 0 development to 255 release


@dataclass(frozen=True, slots=True)
class VehicleIdentity(Event):
    """AUTOPILOT_VERSION: the hardware's unique id, 0 if it has none, and the firmware version."""

    uid: int
    version: FirmwareVersion


@dataclass(frozen=True, slots=True)
class SystemHealth(Event):
    """SYS_STATUS: whether the vehicle's own pre-arm checks pass, and its battery."""

    prearm_ok: bool
    battery_remaining: float | None  # 0 .. 1
    radio_ok: bool = False  # a remote control is present and received
    unhealthy: tuple[str, ...] = ()  # MAV_SYS_STATUS_SENSOR that are enabled and not healthy


@dataclass(frozen=True, slots=True)
class Landed(Event):
    """EXTENDED_SYS_STATE.landed_state: "unknown", "on_ground", "in_air", "takeoff", "landing"."""

    state: str


@dataclass(frozen=True, slots=True)
class CommandAck(Event):
    """COMMAND_ACK addressed to us. `result` is the name without prefix: "ACCEPTED", "DENIED" ..."""

    command: int
    result: str


@dataclass(frozen=True, slots=True)
class StatusText(Event):
    """STATUSTEXT, all chunks joined, trailing tab and NUL removed."""

    severity: int  # MAV_SEVERITY, 0 emergency .. 7 debug
    text: str


@dataclass(frozen=True, slots=True)
class Parameter(Event):
    """PARAM_VALUE, decoded as the dialect packs it."""

    name: str
    value: float


@dataclass(frozen=True, slots=True)
class PeerChanged(Event):
    """The vehicle now sends from another address, for example after a restart of mavlink-router."""

    peer: Hashable


@dataclass(frozen=True, slots=True)
class ClockBehind(Event):
    """A HEARTBEAT with a valid signature but too old a time stamp, before a vehicle is found."""

    system_id: int
    armed: bool


@dataclass(frozen=True, slots=True)
class TimesyncReply(Event):
    """TIMESYNC reply: the stamp of our request, and the vehicle time when the request arrived."""

    request_ns: int
    vehicle_ns: int


@dataclass(frozen=True, slots=True)
class Rebooted(Event):
    """The vehicle was rebooted: several time stamps in a row are far behind the earlier ones."""
