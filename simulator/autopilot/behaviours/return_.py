"""Return: climb, fly home, descend, wait, land."""

from __future__ import annotations

import math
from enum import Enum

from simulator.autopilot.behaviours.base import ActiveBehaviour
from simulator.autopilot.behaviours.land import descent, land_speed_mps
from simulator.autopilot.state import StateEstimate
from simulator.firmware.values import MotionSetpoint, ReturnYaw, Triple


class Stage(Enum):
    """Stages of a return, in order."""

    CLIMB, FLY, DESCEND, WAIT, LAND = range(5)


class Return(ActiveBehaviour):
    """PX4 AUTO.RTL; ArduCopter RTL."""

    _stage = Stage.CLIMB
    _wait_until_s = math.inf
    _yaw: ReturnYaw | None = None

    def enter(self, estimate: StateEstimate, place_ned_m: Triple, *, landed: bool) -> None:
        """Choose the height of the return and its yaw."""
        guidance, (x, y, z) = self.guidance, estimate.position_ned_m
        read, flight = guidance.parameters.__getitem__, guidance.firmware.flight
        distance_m = self._distance_home_m(estimate)
        height_m = flight.return_height_m(distance_m, read)
        self._yaw = flight.return_yaw(distance_m, read)
        guidance.hold = MotionSetpoint((x, y, min(z, guidance.home_ned_m[2] - height_m)))
        guidance.events.append("return begun")

    @property
    def landing(self) -> bool:
        return self._stage is Stage.LAND

    def motion(self, estimate: StateEstimate, *, landed: bool) -> MotionSetpoint:
        self._advance(estimate)
        yaw_rad = math.nan
        if self._yaw is ReturnYaw.AS_AT_HOME and self._stage is not Stage.CLIMB:
            yaw_rad = self.guidance.home_yaw_rad
        if self._stage is Stage.LAND:
            speed_mps = land_speed_mps(estimate, self.guidance)
            return descent(self.guidance.hold_ned_m, speed_mps, yaw_rad)
        along = self._yaw is ReturnYaw.ALONG_PATH
        return MotionSetpoint(self.guidance.hold_ned_m, yaw_rad=yaw_rad, faces_way=along)

    def _advance(self, estimate: StateEstimate) -> None:
        """Go through the stages that are complete."""
        guidance, z = self.guidance, estimate.position_ned_m[2]
        home_x, home_y, home_z = guidance.home_ned_m
        role, target_z = guidance.parameters.role, guidance.hold_ned_m[2]
        height_within_m, wait_s = role("return_height_within_m"), role("return_waits_s")
        if self._stage is Stage.CLIMB and z < target_z + height_within_m:
            guidance.hold = MotionSetpoint((home_x, home_y, target_z))
            self._stage = Stage.FLY
        if self._stage is Stage.FLY and self._distance_home_m(estimate) < role("return_within_m"):
            target_z = max(target_z, home_z - role("return_descends_to_m"))
            guidance.hold = MotionSetpoint((home_x, home_y, target_z))
            self._stage = Stage.DESCEND
            if wait_s == 0.0:
                self._land()
        if self._stage is Stage.DESCEND and z > target_z - height_within_m:
            if wait_s >= 0.0:
                self._wait_until_s = estimate.time_s + wait_s + role("return_settles_s")
            self._stage = Stage.WAIT
        if self._stage is Stage.WAIT and estimate.time_s >= self._wait_until_s:
            self._land()
        if self._yaw is not None and self._stage.value > Stage.FLY.value:
            self._yaw = ReturnYaw.AS_AT_HOME

    def _land(self) -> None:
        self._stage = Stage.LAND
        self.guidance.events.append("return lands")

    def _distance_home_m(self, estimate: StateEstimate) -> float:
        return math.dist(estimate.position_ned_m[:2], self.guidance.home_ned_m[:2])
