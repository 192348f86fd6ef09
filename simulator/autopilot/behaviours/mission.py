"""Mission: fly the items of `simulator.autopilot.mission` one after the other."""

from __future__ import annotations

from simulator.autopilot.behaviours.base import ActiveBehaviour
from simulator.autopilot.behaviours.land import descent, land_speed_mps
from simulator.autopilot.state import StateEstimate
from simulator.autopilot.trajectory import Leg
from simulator.firmware.values import MotionSetpoint


class FlyMission(ActiveBehaviour):
    """PX4 AUTO.MISSION; ArduCopter AUTO."""

    lifts_off = True
    continues = True

    def leave(self) -> None:
        self.guidance.mission.pause()

    def motion(self, estimate: StateEstimate, *, landed: bool) -> MotionSetpoint:
        guidance = self.guidance
        motion = guidance.mission.fly(estimate, guidance.home_ned_m, landed=landed)
        if not self.landing:
            return motion
        return descent(motion.position_ned_m, land_speed_mps(estimate, guidance))

    def leg(self, cruise_mps: float, height_m: float) -> Leg:
        mission = self.guidance.mission
        places = (mission.previous_ned_m, mission.following_ned_m)
        return Leg(cruise_mps, *places, mission.acceptance_m, self.climbing, height_m)

    @property
    def landing(self) -> bool:
        return self.guidance.mission.landing

    @property
    def climbing(self) -> bool:
        return self.guidance.mission.climbing

    @property
    def speed_mps(self) -> float:
        return self.guidance.mission.speed_mps
