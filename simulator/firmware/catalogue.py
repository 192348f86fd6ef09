"""The firmwares by name."""

from __future__ import annotations

from simulator.firmware.ardupilot import ARDUPILOT
from simulator.firmware.base import Firmware
from simulator.firmware.px4 import PX4

FIRMWARES: dict[str, Firmware] = {firmware.name: firmware for firmware in (PX4, ARDUPILOT)}
