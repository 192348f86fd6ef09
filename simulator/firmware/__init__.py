"""The firmwares by name. An autopilot is handed one, and never asks which it is."""

from __future__ import annotations

from simulator.autopilot.firmware import Firmware
from simulator.firmware.ardupilot import ARDUPILOT
from simulator.firmware.px4 import PX4

FIRMWARES: dict[str, Firmware] = {firmware.name: firmware for firmware in (PX4, ARDUPILOT)}
