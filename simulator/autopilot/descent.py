"""How fast to go down, and the way home: climb, fly there, go down, land.

Knows position, height and parameters; knows no modes and no thrust.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from enum import Enum

from simulator.autopilot.nav import Nav
from simulator.autopilot.parameters import ParameterTable
from simulator.firmware.base import Firmware
from simulator.firmware.values import MotionSetpoint, ReturnYaw, Triple


def sink(place: Triple, speed_mps: float, yaw_rad: float = math.nan) -> MotionSetpoint:
    """Straight down at this speed."""
    down = (math.nan, math.nan, speed_mps)
    return MotionSetpoint((place[0], place[1], math.nan), down, yaw_rad=yaw_rad)


def land_speed_mps(nav: Nav, home_down_m: float, parameters: ParameterTable) -> float:
    """Slower the nearer home's height is, and slowest above the ground that is felt."""
    role = parameters.role
    slow = role("land_speed_mps")
    if nav.ground_m <= role("crawl_below_m"):
        return min(slow, role("crawl_speed_mps"))
    fast = max(slow, role("descent_speed_mps"))
    slow_below_m, fast_above_m = role("slow_below_m"), role("fast_above_m")
    height_m = home_down_m - nav.position_ned_m[2]
    share = (height_m - slow_below_m) / max(fast_above_m - slow_below_m, 1e-3)
    return slow + min(1.0, max(0.0, share)) * (fast - slow)


class Stage(Enum):
    """Of a return."""

    BEGIN, CLIMB, FLY, DESCEND, WAIT, LAND = range(6)


@dataclass(slots=True)
class Return:
    """One return to `home_ned_m`; what it comes upon it says in `events`."""

    firmware: Firmware
    parameters: ParameterTable
    events: list[str]
    stage: Stage = Stage.BEGIN
    place: Triple = field(default=(0.0, 0.0, 0.0))
    _until_s: float = math.inf
    _heads: ReturnYaw | None = None

    @property
    def landing(self) -> bool:
        return self.stage is Stage.LAND

    def fly(
        self, now_s: float, nav: Nav, home_ned_m: Triple, home_yaw_rad: float
    ) -> MotionSetpoint:
        """Where to be now."""
        x, y, z = nav.position_ned_m
        home_x, home_y, home_z = home_ned_m
        distance_m = math.hypot(x - home_x, y - home_y)
        if self.stage is Stage.BEGIN:
            read = self.parameters.__getitem__
            height_m = self.firmware.flight.return_height_m(distance_m, read)
            self._heads = self.firmware.flight.return_yaw(distance_m, read)
            self.place = (x, y, min(z, home_z - height_m))
            self._go(Stage.CLIMB, "return begun")
        role = self.parameters.role
        within_m, height_within_m = role("return_within_m"), role("return_height_within_m")
        if self.stage is Stage.CLIMB and z < self.place[2] + height_within_m:
            self.place = (home_x, home_y, self.place[2])
            self._go(Stage.FLY)
        if self.stage is Stage.FLY and distance_m < within_m:
            waits = role("return_waits_s") != 0.0
            self._go(Stage.DESCEND) if waits else self._go(Stage.LAND, "return lands")
            lower_m = role("return_descends_to_m")
            self.place = (home_x, home_y, max(self.place[2], home_z - lower_m))
        if self.stage is Stage.DESCEND and z > self.place[2] - height_within_m:
            waits_s = role("return_waits_s")
            settles_s = role("return_settles_s")
            self._until_s = now_s + waits_s + settles_s if waits_s >= 0.0 else math.inf
            self._go(Stage.WAIT)
        if self.stage is Stage.WAIT and now_s >= self._until_s:
            self._go(Stage.LAND, "return lands")
        if self._heads is not None and self.stage.value > Stage.FLY.value:
            self._heads = ReturnYaw.AS_AT_HOME
        yaw_rad = math.nan
        if self._heads is ReturnYaw.AS_AT_HOME and self.stage is not Stage.CLIMB:
            yaw_rad = home_yaw_rad
        if self.stage is Stage.LAND:
            return sink(self.place, land_speed_mps(nav, home_z, self.parameters), yaw_rad)
        along = self._heads is ReturnYaw.ALONG_PATH
        return MotionSetpoint(self.place, yaw_rad=yaw_rad, faces_way=along)

    def _go(self, stage: Stage, event: str = "") -> None:
        self.stage = stage
        self.events += (event,) if event else ()
