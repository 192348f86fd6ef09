"""Observation: what one listening pass and one look at this computer found, as one value.

Checks are functions of it. Units are in the names; times are host seconds where nothing else is
said.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from offboard.flight.vehicle_state import VehicleState
from offboard.identification.uncertainty import Estimate
from offboard.mavlink.autopilots import is_vehicle
from offboard.mavlink.decode import Identity
from offboard.mavlink.dialects.base import TYPE_GCS, Dialect, WantedMessage
from offboard.run.configuration import FlightConfig

FIX_3D = 3  # GPS_FIX_TYPE; also stands for better ones


@dataclass(frozen=True, slots=True)
class Sender:
    """One MAVLink sender. `vehicle_type` and `autopilot` are those of its HEARTBEAT, None without
    one; `places` are the addresses that it sends from."""

    system_id: int
    component_id: int
    vehicle_type: int | None
    autopilot: int | None
    places: tuple[str, ...]
    frames: int
    lost: int  # by gaps of its sequence numbers
    setpoints: int  # SET_ATTITUDE_TARGET and SET_POSITION_TARGET_*
    times: int  # TIMESYNC and SYSTEM_TIME

    @property
    def is_ground_station(self) -> bool:
        return self.vehicle_type == TYPE_GCS

    @property
    def is_autopilot(self) -> bool:
        if self.vehicle_type is None or self.autopilot is None:
            return False
        return is_vehicle(Identity(self.vehicle_type, self.autopilot))

    @property
    def name(self) -> str:
        kind = "ground station" if self.is_ground_station else "component"
        kind = "autopilot" if self.is_autopilot else kind
        return f"{kind} {self.system_id}/{self.component_id}"


@dataclass(frozen=True, slots=True)
class LinkMeasures:
    """What passed over the link."""

    bytes_received: int = 0
    bytes_skipped: int = 0  # that are no MAVLink frame
    bytes_ps: float = 0.0
    wanted_bytes_ps: float = 0.0  # of the telemetry that a flight requests
    capacity_bytes_ps: float | None = None
    messages_bytes_ps: Mapping[str, float] = field(default_factory=dict)  # received, by name
    wanted: tuple[WantedMessage, ...] = ()
    rates_hz: Mapping[str, float] = field(default_factory=dict)
    requested: bool = False  # the rates were requested
    delay: Estimate | None = None  # s: telemetry and setpoint together
    round_trip_s: float | None = None  # of TIMESYNC, median
    late_s: float = 0.0  # greatest age of telemetry beyond the least
    foreign_timesync: int = 0  # replies of the vehicle to requests that are not ours
    commands_sent: int = 0  # different commands that are acknowledged
    acknowledged: Mapping[int, str] = field(default_factory=dict)  # MAV_CMD -> MAV_RESULT


@dataclass(frozen=True, slots=True)
class ClockMeasures:
    """The vehicle's clock."""

    rate: float | None = None  # seconds of vehicle time per second
    jumped_s: float = 0.0
    rebooted: bool = False
    unix_offset_s: float | None = None  # its Unix time less that of this computer


@dataclass(frozen=True, slots=True)
class Computer:
    """This computer. None where it was not measured."""

    directory: str = "."  # in which flights are recorded
    free_bytes: int | None = None
    overshoot_s: float | None = None  # of a short sleep, the longest of many
    not_compiled: int | None = None  # functions without machine code on disk
    decision_s: float | None = None  # the shortest possible decision
    deadline_s: float | None = None
    rehearsal: str = ""  # why the controller cannot be flown here
    clock_step_s: float = 0.0  # of the wall clock, while it listened
    not_measured_s: float | None = None  # in which the measurement did not end


@dataclass(frozen=True, slots=True)
class Observation:
    """Everything that the checks know.

    `vehicle` has the newest telemetry; its `found` is None if no autopilot was heard. `config` is
    the flight that is planned; `config_problem` says why it cannot be flown by any vehicle.
    """

    connection: str = ""
    listened_s: float = 0.0
    link_error: str = ""
    system_id: int | None = None  # of the vehicle, where it was chosen
    not_found: str = ""  # why no vehicle was found, as far as dropped frames tell
    holders: tuple[str, ...] = ()  # other processes that have the port
    surroundings: str = ""  # "WSL", "container" or empty
    senders: tuple[Sender, ...] = ()
    vehicle: VehicleState = field(default_factory=VehicleState)
    dialect: Dialect | None = None
    unanswered: tuple[str, ...] = ()  # parameters
    fix_type: int | None = None  # GPS_FIX_TYPE
    prearm_texts: tuple[str, ...] = ()
    link: LinkMeasures = field(default_factory=LinkMeasures)
    clock: ClockMeasures = field(default_factory=ClockMeasures)
    computer: Computer = field(default_factory=Computer)
    config: FlightConfig | None = None
    config_problem: str = ""
    tilt_rad: float | None = None  # greatest tilt of the reference
