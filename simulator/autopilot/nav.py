"""What the flight stack flies by: its clock, the estimate, and what feet and range finder feel.

Knows the plant alone, and of that what it shows; knows no modes, no parameters and no messages.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from simulator.firmware.values import Quaternion, Triple
from simulator.steps import STEP_S, STEP_US
from simulator.vehicle.plant import Plant, Truth


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


class Senses:
    """The present step of one plant, looked at when somebody asks and once only."""

    def __init__(self, plant: Plant) -> None:
        self._plant = plant
        self.steps = 0  # of STEP_S since boot
        self.gps_healthy = True  # no fault takes the fixes away
        self._truth: Truth | None = None
        self._nav: Nav | None = None

    @property
    def time_s(self) -> float:
        """Vehicle time since boot."""
        return self.steps * STEP_S

    @property
    def time_us(self) -> int:
        """The same in whole microseconds; no fault turns it back."""
        return self.steps * STEP_US

    def step(self) -> None:
        """The plant has moved by one step."""
        self.steps += 1
        self.forget()

    def forget(self) -> None:
        """Look again when asked next: the plant or its estimate has changed."""
        self._truth = self._nav = None

    @property
    def truth(self) -> Truth:
        """Where the vehicle really is now; the flight stack itself reads the battery alone."""
        if self._truth is None:
            self._truth = self._plant.truth
        return self._truth

    def look(self) -> Nav:
        """The estimate now, and whether the feet touch the ground."""
        if self._nav is None:
            plant = self._plant
            (north, east, down, v_north, v_east, v_down, w, x, y, z, p, q, r) = (
                plant.report().tolist()
            )
            self._nav = Nav(
                (north, east, down),
                (v_north, v_east, v_down),
                (w, x, y, z),
                (p, q, r),
                plant.on_ground,
                plant.reset_counter,
                plant.height_m,
            )
        return self._nav
