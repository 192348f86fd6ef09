"""State of the vehicle at the present step: time since boot, estimate and truth.

Reads the plant. Knows no modes, no parameters and no messages.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from simulator.autopilot.values import Quaternion, Triple
from simulator.steps import STEP_S, STEP_US
from simulator.vehicle.plant import Plant, Truth


@dataclass(frozen=True, slots=True)
class StateEstimate:
    """The estimate as plain floats (NED, FRD, SI), with ground contact and range finder."""

    time_s: float  # vehicle time since boot
    position_ned_m: Triple
    velocity_ned_mps: Triple
    attitude: Quaternion
    rates_frd_radps: Triple
    on_ground: bool  # whether the ground carries the vehicle (true state)
    reset_counter: int
    ground_m: float  # distance to the ground from the range finder

    @property
    def yaw_rad(self) -> float:
        w, x, y, z = self.attitude
        return math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))

    @property
    def tilt_cosine(self) -> float:
        _, x, y, _ = self.attitude
        return 1.0 - 2.0 * (x * x + y * y)


class VehicleState:
    """Time, estimate and truth of the present step; both are read from the plant once a step."""

    def __init__(self, plant: Plant) -> None:
        self.plant = plant
        self.steps = 0  # number of steps of STEP_S since boot
        self._truth: Truth | None = None
        self._estimate: StateEstimate | None = None

    @property
    def time_s(self) -> float:
        """Vehicle time since boot."""
        return self.steps * STEP_S

    @property
    def time_us(self) -> int:
        """Vehicle time since boot in whole microseconds; no clock fault changes it."""
        return self.steps * STEP_US

    def step(self) -> None:
        """Count a step, after the plant was advanced."""
        self.steps += 1
        self.invalidate()

    def invalidate(self) -> None:
        """Discard truth and estimate of this step, because the plant was changed."""
        self._truth = self._estimate = None

    @property
    def truth(self) -> Truth:
        """True state, which the autopilot itself does not use."""
        if self._truth is None:
            self._truth = self.plant.truth
        return self._truth

    @property
    def estimate(self) -> StateEstimate:
        """State as the autopilot estimates it."""
        if self._estimate is None:
            plant = self.plant
            north, east, down, v_north, v_east, v_down, w, x, y, z, p, q, r = (
                plant.report().tolist()
            )
            self._estimate = StateEstimate(
                self.time_s,
                (north, east, down),
                (v_north, v_east, v_down),
                (w, x, y, z),
                (p, q, r),
                plant.on_ground,
                plant.reset_counter,
                plant.height_m,
            )
        return self._estimate
