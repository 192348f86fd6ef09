"""ArduCopter 4.6 as data; each part is in the file of its name.

Measured on ArduCopter 4.6.3 SITL where MAVLink shows it. Knows no simulator core and no socket.
"""

from __future__ import annotations

from simulator.firmware.ardupilot.commands import COMMANDS
from simulator.firmware.ardupilot.flight import FLIGHT
from simulator.firmware.ardupilot.health import HEALTH
from simulator.firmware.ardupilot.link import LINK
from simulator.firmware.ardupilot.missions import MISSIONS
from simulator.firmware.ardupilot.modes import MODES, heartbeat
from simulator.firmware.ardupilot.parameters import PARAMETERS, ROLES
from simulator.firmware.ardupilot.rules import RULES
from simulator.firmware.ardupilot.setpoints import SETPOINTS
from simulator.firmware.ardupilot.streams import STREAMS
from simulator.firmware.base import Firmware

ARDUPILOT = Firmware(
    name="ardupilot",
    vehicle="arducopter",
    scenario="ardupilot_like",
    mav_autopilot=3,
    version=0x040603FF,  # 4.6.3, release
    capabilities=64495,
    origin=(-35.3632621, 149.1652374, 584.09),
    modes=MODES,
    boot_mode="STABILIZE",
    hold_mode="BRAKE",
    heartbeat=heartbeat,
    rules=RULES,
    parameters=PARAMETERS,
    parameter_roles=ROLES,
    system_parameter="SYSID_THISMAV",
    commands=COMMANDS,
    setpoints=SETPOINTS,
    missions=MISSIONS,
    streams=STREAMS,
    link=LINK,
    health=HEALTH,
    flight=FLIGHT,
)
