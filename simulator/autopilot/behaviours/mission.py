"""Mission: fly the items of `simulator.autopilot.mission` one after the other."""

from __future__ import annotations

from simulator.autopilot.behaviours.base import ActiveBehaviour
from simulator.autopilot.behaviours.land import land_speed_mps, sink
from simulator.autopilot.nav import Nav
from simulator.autopilot.trajectory import Leg
from simulator.firmware.values import NAN3, MotionSetpoint, Triple


class FlyMission(ActiveBehaviour):
    """PX4 AUTO.MISSION; ArduCopter AUTO."""

    lifts_off = True
    goes_on = True

    def enter(self, nav: Nav, place_ned_m: Triple = NAN3) -> None:
        self.guidance.mission.pause()

    def left(self) -> None:
        self.guidance.mission.pause()

    @property
    def landing(self) -> bool:
        return self.guidance.mission.landing

    @property
    def climbing(self) -> bool:
        return self.guidance.mission.climbing

    @property
    def speed_mps(self) -> float:
        return self.guidance.mission.speed_mps

    def motion(self, nav: Nav, time_s: float, *, landed: bool) -> MotionSetpoint:
        guidance = self.guidance
        home_ned_m = guidance.home_ned_m
        motion = guidance.mission.fly(time_s, nav.position_ned_m, home_ned_m, landed=landed)
        if not self.landing:
            return motion
        return sink(motion.position_ned_m, land_speed_mps(nav, home_ned_m[2], guidance.parameters))

    def leg(self, cruise_mps: float, height_m: float) -> Leg:
        mission = self.guidance.mission
        before, behind = mission.before_ned_m, mission.behind_ned_m
        return Leg(cruise_mps, before, behind, mission.accepted_m, self.climbing, height_m)
