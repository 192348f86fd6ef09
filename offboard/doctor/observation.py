"""Observation: what one listening pass and one look at this computer found, as one value.

Checks are functions of it. Units are in the names; times are host seconds where nothing else is
said.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from offboard.flight.phases import Limits
from offboard.flight.preflight import Ground
from offboard.flight.vehicle_state import VehicleState
from offboard.identification.uncertainty import Estimate
from offboard.mavlink.decode import Identity
from offboard.mavlink.dialects.base import TYPE_GCS, Dialect, WantedMessage
from offboard.mavlink.senders import is_vehicle
from offboard.run.configuration import FlightConfig


@dataclass(slots=True)
class Sender:
    """One MAVLink sender. `vehicle_type` and `autopilot` are those of its HEARTBEAT, None without
    one; `places` are the addresses that it sends from."""

    system_id: int
    component_id: int
    vehicle_type: int | None = None
    autopilot: int | None = None
    places: set[str] = field(default_factory=set)
    frames: int = 0
    lost: int = 0  # by gaps of its sequence numbers
    times: int = 0  # TIMESYNC and SYSTEM_TIME

    @property
    def is_autopilot(self) -> bool:
        if self.vehicle_type is None or self.autopilot is None:
            return False
        return is_vehicle(Identity(self.vehicle_type, self.autopilot))

    @property
    def name(self) -> str:
        kind = "ground station" if self.vehicle_type == TYPE_GCS else "component"
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
    measures_delay: bool = False  # it is not measured well enough
    round_trip_s: float | None = None  # of TIMESYNC, median
    late_s: float = 0.0  # greatest age of telemetry beyond the least
    foreign_timesync: int = 0  # replies of the vehicle to requests that are not ours
    commands_sent: int = 0  # different commands to which an acknowledgement is due
    acknowledged: Mapping[int, str] = field(default_factory=dict)  # MAV_CMD -> MAV_RESULT


@dataclass(frozen=True, slots=True)
class ClockMeasures:
    """The vehicle's clock."""

    rate: float | None = None  # seconds of vehicle time per second
    jumped_s: float = 0.0
    rebooted: bool = False


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
    the planned flight; `config_problem` says why its reference cannot be flown by its vehicle.
    """

    connection: str = ""
    listened_s: float = 0.0
    link_error: str = ""
    not_found: str = ""  # why no vehicle was found, as far as dropped frames tell
    holders: tuple[str, ...] = ()  # other processes that have the port
    surroundings: str = ""  # "WSL", "container" or empty
    senders: tuple[Sender, ...] = ()  # the most talkative first
    systems: str = ""  # of several vehicles, none of which was chosen
    vehicle: VehicleState = field(default_factory=VehicleState)
    dialect: Dialect | None = None
    fix_type: int | None = None  # GPS_FIX_TYPE
    link: LinkMeasures = field(default_factory=LinkMeasures)
    clock: ClockMeasures = field(default_factory=ClockMeasures)
    computer: Computer = field(default_factory=Computer)
    config: FlightConfig | None = None
    config_problem: str = ""
    tilt_rad: float | None = None  # greatest tilt of the reference

    @property
    def limits(self) -> Limits:
        return self.config.limits if self.config else Limits()

    @property
    def ground(self) -> Ground:
        """What the preflight list judges."""
        vehicle, link = self.vehicle, self.link
        return Ground(
            vehicle,
            self.limits,
            self.dialect,
            helicopter=self.config is not None and self.config.vehicle.airframe == "helicopter",
            rates_hz=link.rates_hz if link.requested else None,
            delay=link.delay,
            measures_delay=link.measures_delay,
            systems=self.systems,
            other_sender=vehicle.other_sender is not None,
            in_the_air=vehicle.armed,
            fix_type=self.fix_type,
        )
