"""The firmwares by name. An autopilot is given one of them and never compares its name."""

from __future__ import annotations

from simulator.autopilot.firmware import Firmware
from simulator.firmware.ardupilot import ARDUPILOT
from simulator.firmware.px4 import PX4

FIRMWARES: dict[str, Firmware] = {firmware.name: firmware for firmware in (PX4, ARDUPILOT)}
