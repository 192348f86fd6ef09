"""What a firmware personality consists of: data the core of the simulator runs on.

The core (`simulator.autopilot.autopilot`, `simulator.mavlink.server`) never asks which firmware it
is: it reads one `Firmware` value. What each of its parts is lies in the module of this folder that
is called like it; `px4` and `ardupilot` are folders of the same names. A further personality is one
more folder.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

from simulator.firmware.commands import CommandRules
from simulator.firmware.flight import FlightRules
from simulator.firmware.health import HealthRules
from simulator.firmware.link import LinkRules
from simulator.firmware.missions import MissionRules
from simulator.firmware.modes import Condition, Mode
from simulator.firmware.parameters import ParameterSpec, Role
from simulator.firmware.rules import Rule
from simulator.firmware.setpoints import SetpointRules
from simulator.firmware.streams import Streams


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
    modes: Mapping[str, Mode]
    boot_mode: str
    heartbeat: Callable[[Condition], tuple[int, int]]  # base_mode but the armed bit, MAV_STATE
    rules: tuple[Rule, ...]
    parameters: tuple[ParameterSpec, ...]
    parameter_roles: Mapping[str, Role]
    system_parameter: str  # that has the system id
    commands: CommandRules
    setpoints: SetpointRules
    missions: MissionRules
    streams: Streams
    link: LinkRules
    health: HealthRules
    flight: FlightRules
