"""What the flight stack flies by: the estimate, and what the feet and the range finder feel."""

from __future__ import annotations

import math
from dataclasses import dataclass

from simulator.firmware.base import Quaternion, Triple


@dataclass(frozen=True, slots=True)
class Nav:
    """The estimate as plain floats; whether the ground carries the vehicle, and how far it is."""

    position_ned_m: Triple
    velocity_ned_mps: Triple
    attitude: Quaternion
    rates_frd_radps: Triple
    on_ground: bool
    reset_counter: int = 0
    ground_m: float = math.inf  # below the feet

    @property
    def yaw_rad(self) -> float:
        w, x, y, z = self.attitude
        return math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
