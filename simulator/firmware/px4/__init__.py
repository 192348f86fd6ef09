"""PX4 1.16 multicopter as data; each part is in the file of its name.

Measured on PX4 1.16.1 SITL where MAVLink shows it. Knows no simulator core and no socket.
"""

from __future__ import annotations

from simulator.firmware.base import Firmware
from simulator.firmware.px4.commands import COMMANDS
from simulator.firmware.px4.flight import FLIGHT
from simulator.firmware.px4.health import HEALTH
from simulator.firmware.px4.link import LINK
from simulator.firmware.px4.missions import MISSIONS
from simulator.firmware.px4.modes import MODES, heartbeat
from simulator.firmware.px4.parameters import PARAMETERS, ROLES
from simulator.firmware.px4.rules import RULES
from simulator.firmware.px4.setpoints import SETPOINTS
from simulator.firmware.px4.streams import STREAMS

PX4 = Firmware(
    name="px4",
    vehicle="px4_sih",
    scenario="px4_like",
    mav_autopilot=12,
    version=0x011001FF,  # 1.16.1, release
    # float parameters, missions and commands in integers, bytewise parameters, targets of attitude,
    # local and global position, MAVLink 2
    capabilities=0x21DE,
    origin=(47.397742, 8.545594, 489.4),
    modes=MODES,
    boot_mode="AUTO.LOITER",
    hold_mode="AUTO.LOITER",
    heartbeat=heartbeat,
    rules=RULES,
    parameters=PARAMETERS,
    parameter_roles=ROLES,
    system_parameter="MAV_SYS_ID",
    commands=COMMANDS,
    setpoints=SETPOINTS,
    missions=MISSIONS,
    streams=STREAMS,
    link=LINK,
    health=HEALTH,
    flight=FLIGHT,
)
