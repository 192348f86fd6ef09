"""What the session reports to the flight: one frozen value per received message or change.

NED, FRD, SI and vehicle time (`time_boot_ms` in seconds) everywhere. All fields are finite and in
range; a message with any other value is dropped and counted.
"""

from __future__ import annotations

from collections.abc import Hashable
from dataclasses import dataclass

from offboard.model.geodesy import Geodetic

Triple = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]  # w, x, y, z; FRD -> NED


@dataclass(frozen=True, slots=True)
class VehicleFound:
    """The first HEARTBEAT of an autopilot. From now on the session accepts only this vehicle."""

    system_id: int
    component_id: int
    autopilot: str  # a key of session.DIALECTS: "px4", "ardupilot"


@dataclass(frozen=True, slots=True)
class Heartbeat:
    """HEARTBEAT of our vehicle."""

    mode: str  # the dialect's name of custom_mode: "OFFBOARD", "AUTO.LOITER", ...
    armed: bool
    system_status: int  # MAV_STATE: 3 standby, 4 active, 5 critical, 6 emergency


@dataclass(frozen=True, slots=True)
class ModeReport:
    """CURRENT_MODE of our vehicle."""

    mode: str  # as in `Heartbeat`


@dataclass(frozen=True, slots=True)
class OtherSender:
    """A frame that shows a second controller of our vehicle on this link: a setpoint that is not
    ours, or a frame with our own ids that we did not send."""

    system_id: int
    component_id: int
    message_id: int


@dataclass(frozen=True, slots=True)
class LocalPosition:
    """LOCAL_POSITION_NED."""

    time_s: float
    position_ned_m: Triple
    velocity_ned_mps: Triple


@dataclass(frozen=True, slots=True)
class Attitude:
    """ATTITUDE_QUATERNION."""

    time_s: float
    attitude: Quaternion
    rates_frd_radps: Triple


@dataclass(frozen=True, slots=True)
class ThrustReport:
    """ATTITUDE_TARGET: the collective thrust that the autopilot demands of its motors, whatever
    flies it. On ArduCopter before it is raised for the tilt."""

    thrust: float  # normalised, 0 .. 1


@dataclass(frozen=True, slots=True)
class GpsFix:
    """GPS_RAW_INT with a 3D fix; `time_s` is None if its stamp is not vehicle time."""

    time_s: float | None
    place: Geodetic
    velocity_ne_mps: tuple[float, float] | None
    accuracy_m: float | None  # horizontal, as the receiver reports it


@dataclass(frozen=True, slots=True)
class Origin:
    """Place of the local frame's origin. `reported` is true for GPS_GLOBAL_ORIGIN; otherwise it is
    computed from HOME_POSITION, which gives one point in both frames."""

    place: Geodetic
    reported: bool


@dataclass(frozen=True, slots=True)
class SystemHealth:
    """SYS_STATUS: whether the vehicle's own pre-arm checks pass, and its battery."""

    prearm_ok: bool
    battery_voltage_v: float | None
    battery_remaining: float | None  # 0 .. 1


@dataclass(frozen=True, slots=True)
class Landed:
    """EXTENDED_SYS_STATE.landed_state: "unknown", "on_ground", "in_air", "takeoff", "landing"."""

    state: str


@dataclass(frozen=True, slots=True)
class CommandAck:
    """COMMAND_ACK addressed to us. `result` is the name without prefix: "ACCEPTED", "DENIED" ..."""

    command: int
    result: str


@dataclass(frozen=True, slots=True)
class StatusText:
    """STATUSTEXT, all chunks joined, trailing tab and NUL removed."""

    severity: int  # MAV_SEVERITY, 0 emergency .. 7 debug
    text: str


@dataclass(frozen=True, slots=True)
class Parameter:
    """PARAM_VALUE, decoded as the dialect packs it."""

    name: str
    value: float


@dataclass(frozen=True, slots=True)
class PeerChanged:
    """The vehicle now sends from another port of its host, for example after a restart of
    mavlink-router."""

    peer: Hashable


@dataclass(frozen=True, slots=True)
class TimesyncReply:
    """TIMESYNC reply of the vehicle: the stamp of our request, and vehicle time on its arrival."""

    request_ns: int
    vehicle_ns: int


@dataclass(frozen=True, slots=True)
class Rebooted:
    """Vehicle time decreased by more than reordering explains: the vehicle was rebooted."""

    time_s: float


Event = (
    VehicleFound
    | Heartbeat
    | ModeReport
    | OtherSender
    | LocalPosition
    | Attitude
    | ThrustReport
    | GpsFix
    | Origin
    | SystemHealth
    | Landed
    | CommandAck
    | StatusText
    | Parameter
    | PeerChanged
    | TimesyncReply
    | Rebooted
)
