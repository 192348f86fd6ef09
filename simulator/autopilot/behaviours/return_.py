"""Return: climb, fly home, descend, wait, land."""

from __future__ import annotations

import math
from enum import Enum

from simulator.autopilot.behaviours.base import ActiveBehaviour
from simulator.autopilot.behaviours.land import land_speed_mps, sink
from simulator.autopilot.nav import Nav
from simulator.firmware.values import NAN3, MotionSetpoint, ReturnYaw, Triple


class Stage(Enum):
    """Stages of a return, in order."""

    BEGIN, CLIMB, FLY, DESCEND, WAIT, LAND = range(6)


class Return(ActiveBehaviour):
    """PX4 AUTO.RTL; ArduCopter RTL."""

    def enter(self, nav: Nav, place_ned_m: Triple = NAN3) -> None:
        self._stage = Stage.BEGIN
        self._place_ned_m: Triple = (0.0, 0.0, 0.0)
        self._until_s = math.inf
        self._heads: ReturnYaw | None = None

    @property
    def landing(self) -> bool:
        return self._stage is Stage.LAND

    @property
    def target_ned_m(self) -> Triple:
        return self._place_ned_m

    def motion(self, nav: Nav, time_s: float, *, landed: bool) -> MotionSetpoint:
        if self._stage is Stage.BEGIN:
            self._begin(nav)
        self._advance(nav, time_s)
        guidance = self.guidance
        yaw_rad = math.nan
        if self._heads is ReturnYaw.AS_AT_HOME and self._stage is not Stage.CLIMB:
            yaw_rad = guidance.home_yaw_rad
        if self._stage is Stage.LAND:
            speed_mps = land_speed_mps(nav, guidance.home_ned_m[2], guidance.parameters)
            return sink(self._place_ned_m, speed_mps, yaw_rad)
        along = self._heads is ReturnYaw.ALONG_PATH
        return MotionSetpoint(self._place_ned_m, yaw_rad=yaw_rad, faces_way=along)

    def _begin(self, nav: Nav) -> None:
        """Choose the height of the return and where the nose points."""
        guidance, (x, y, z) = self.guidance, nav.position_ned_m
        read, flight = guidance.parameters.__getitem__, guidance.firmware.flight
        distance_m = self._distance_home_m(nav)
        height_m = flight.return_height_m(distance_m, read)
        self._heads = flight.return_yaw(distance_m, read)
        self._place_ned_m = (x, y, min(z, guidance.home_ned_m[2] - height_m))
        self._go_to(Stage.CLIMB, "return begun")

    def _advance(self, nav: Nav, time_s: float) -> None:
        """Go on to the next stages, as far as they are reached."""
        role, z = self.guidance.parameters.role, nav.position_ned_m[2]
        home_x, home_y, home_z = self.guidance.home_ned_m
        height_within_m = role("return_height_within_m")
        if self._stage is Stage.CLIMB and z < self._place_ned_m[2] + height_within_m:
            self._place_ned_m = (home_x, home_y, self._place_ned_m[2])
            self._go_to(Stage.FLY)
        if self._stage is Stage.FLY and self._distance_home_m(nav) < role("return_within_m"):
            waits = role("return_waits_s") != 0.0
            self._go_to(Stage.DESCEND) if waits else self._go_to(Stage.LAND, "return lands")
            lower_m = role("return_descends_to_m")
            self._place_ned_m = (home_x, home_y, max(self._place_ned_m[2], home_z - lower_m))
        if self._stage is Stage.DESCEND and z > self._place_ned_m[2] - height_within_m:
            waits_s = role("return_waits_s")
            settles_s = role("return_settles_s")
            self._until_s = time_s + waits_s + settles_s if waits_s >= 0.0 else math.inf
            self._go_to(Stage.WAIT)
        if self._stage is Stage.WAIT and time_s >= self._until_s:
            self._go_to(Stage.LAND, "return lands")
        if self._heads is not None and self._stage.value > Stage.FLY.value:
            self._heads = ReturnYaw.AS_AT_HOME

    def _distance_home_m(self, nav: Nav) -> float:
        home = self.guidance.home_ned_m
        return math.hypot(nav.position_ned_m[0] - home[0], nav.position_ned_m[1] - home[1])

    def _go_to(self, stage: Stage, event: str = "") -> None:
        self._stage = stage
        self.guidance.events += (event,) if event else ()
