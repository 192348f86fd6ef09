"""What the vehicle does in its modes: the classes of behaviours, and their table.

A behaviour demands a motion in each period and has a few properties. A new one needs a member of
`simulator.autopilot.values.Behaviour`, a class here, a row in BEHAVIOURS, and a row in the mode
table of a firmware. NED, SI.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from enum import Enum

from offboard.model.frames import wrap_pi
from simulator.autopilot.guidance import ActiveBehaviour, Guidance
from simulator.autopilot.state import StateEstimate
from simulator.autopilot.values import NAN3, Behaviour, MotionSetpoint, Triple
from simulator.steps import LOOP_S

_FLATTEST = 1000.0  # limit of a takeoff from the ground: m horizontally per m of climb
_STILL_MPS = 0.05  # sticks: with a lower velocity demand the vehicle holds its place


class Takeoff(ActiveBehaviour):
    """PX4 AUTO.TAKEOFF; ArduCopter GUIDED after MAV_CMD_NAV_TAKEOFF. Raises event "climbed"."""

    lifts_off = True
    climbing = True
    _climbed = False

    def enter(self, estimate: StateEstimate, place_ned_m: Triple, *, landed: bool) -> None:
        """Choose the height. The vehicle does not descend to it, and does not leave the ground on a
        nearly horizontal path."""
        (x, y, z), (north, east, target_z) = estimate.position_ned_m, place_ned_m
        if math.isnan(target_z):
            target_z = z - self.guidance.parameters.role("takeoff_height_m")
        elif target_z > z:
            target_z, self.cannot_climb = z, landed
            self.guidance.events.append("already higher")
        if landed and math.hypot(north - x, east - y) > _FLATTEST * (z - target_z):
            self.cannot_climb = True
        self._place_ned_m = (north, east, target_z)

    def keeps_place(self, following: Behaviour) -> bool:
        return self._climbed and following in (Behaviour.HOLD, Behaviour.SETPOINT)

    def motion(self, estimate: StateEstimate, *, landed: bool) -> MotionSetpoint:
        guidance = self.guidance
        north, east, target_z = self._place_ned_m
        if math.isnan(north + east):
            north, east = guidance.hold_ned_m[:2]
        within_m = guidance.parameters.role("climbed_within_m")
        if not (self._climbed or landed) and estimate.position_ned_m[2] < target_z + within_m:
            self._climbed = True
            guidance.events.append("climbed")
        guidance.hold = MotionSetpoint((north, east, target_z))
        return guidance.hold


class Land(ActiveBehaviour):
    """PX4 AUTO.LAND; ArduCopter LAND: a vertical descent, slower near the ground."""

    landing = True

    def motion(self, estimate: StateEstimate, *, landed: bool) -> MotionSetpoint:
        return landing_motion(self.guidance.hold_ned_m, estimate, self.guidance)


def descent(place_ned_m: Triple, speed_mps: float) -> MotionSetpoint:
    """Vertical descent at this place and speed."""
    return MotionSetpoint((*place_ned_m[:2], math.nan), (math.nan, math.nan, speed_mps))


def landing_motion(
    place_ned_m: Triple, estimate: StateEstimate, guidance: Guidance
) -> MotionSetpoint:
    """Descent to the ground: slower near the height of home (PX4 MPC_LAND_SPEED; ArduCopter
    LAND_SPEED), slowest where the range finder measures a small distance (PX4 MPC_LAND_CRWL)."""
    role = guidance.parameters.role
    slow = role("land_speed_mps")
    if estimate.ground_m <= role("crawl_below_m"):
        return descent(place_ned_m, min(slow, role("crawl_speed_mps")))
    fast = max(slow, role("descent_speed_mps"))
    slow_below_m, fast_above_m = role("slow_below_m"), role("fast_above_m")
    height_m = guidance.home_ned_m[2] - estimate.position_ned_m[2]
    share = (height_m - slow_below_m) / max(fast_above_m - slow_below_m, 1e-3)
    return descent(place_ned_m, slow + min(1.0, max(0.0, share)) * (fast - slow))


class Stage(Enum):
    """Stages of a return, in order."""

    CLIMB, FLY, DESCEND, WAIT, LAND = range(5)


class Return(ActiveBehaviour):
    """PX4 AUTO.RTL; ArduCopter RTL: the vehicle climbs, flies home, descends, waits, lands."""

    _stage = Stage.CLIMB
    _wait_until_s = math.inf

    def enter(self, estimate: StateEstimate, place_ned_m: Triple, *, landed: bool) -> None:
        """Choose the height of the return."""
        guidance, (x, y, z) = self.guidance, estimate.position_ned_m
        distance_m = self._distance_home_m(estimate)
        height_m = guidance.firmware.return_height_m(distance_m, guidance.parameters)
        guidance.hold = MotionSetpoint((x, y, min(z, guidance.home_ned_m[2] - height_m)))

    @property
    def landing(self) -> bool:
        return self._stage is Stage.LAND

    def motion(self, estimate: StateEstimate, *, landed: bool) -> MotionSetpoint:
        self._advance(estimate)
        guidance = self.guidance
        if self._stage is Stage.LAND:
            return landing_motion(guidance.hold_ned_m, estimate, guidance)
        return MotionSetpoint(guidance.hold_ned_m, faces_way=guidance.firmware.return_faces_way)

    def _advance(self, estimate: StateEstimate) -> None:
        """Go on to the next stage if the present one is complete, and so on."""
        guidance, z = self.guidance, estimate.position_ned_m[2]
        home_x, home_y, home_z = guidance.home_ned_m
        role, target_z = guidance.parameters.role, guidance.hold_ned_m[2]
        height_within_m, wait_s = role("reached_height_m"), role("return_waits_s")
        if self._stage is Stage.CLIMB and z < target_z + height_within_m:
            guidance.hold = MotionSetpoint((home_x, home_y, target_z))
            self._stage = Stage.FLY
        if self._stage is Stage.FLY and self._distance_home_m(estimate) < role("reached_m"):
            target_z = max(target_z, home_z - role("return_descends_to_m"))
            guidance.hold = MotionSetpoint((home_x, home_y, target_z))
            self._stage = Stage.LAND if wait_s == 0.0 else Stage.DESCEND
        if self._stage is Stage.DESCEND and z > target_z - height_within_m:
            if wait_s >= 0.0:
                self._wait_until_s = estimate.time_s + wait_s + role("return_settles_s")
            self._stage = Stage.WAIT
        if self._stage is Stage.WAIT and estimate.time_s >= self._wait_until_s:
            self._stage = Stage.LAND

    def _distance_home_m(self, estimate: StateEstimate) -> float:
        return math.dist(estimate.position_ned_m[:2], self.guidance.home_ned_m[:2])


class FlyMission(ActiveBehaviour):
    """PX4 AUTO.MISSION; ArduCopter AUTO: flies the items of `simulator.autopilot.mission`."""

    lifts_off = True

    def leave(self) -> None:
        self.guidance.mission.pause()

    def motion(self, estimate: StateEstimate, *, landed: bool) -> MotionSetpoint:
        guidance = self.guidance
        motion = guidance.mission.fly(estimate, guidance.home_ned_m, landed=landed)
        return landing_motion(motion.position_ned_m, estimate, guidance) if self.landing else motion

    @property
    def landing(self) -> bool:
        return self.guidance.mission.landing

    @property
    def climbing(self) -> bool:
        return self.guidance.mission.climbing

    @property
    def speed_mps(self) -> float:
        return self.guidance.mission.speed_mps


class FlyBySticks(ActiveBehaviour):
    """ArduCopter LOITER, ALT_HOLD, POSHOLD and CIRCLE (without the circle); PX4 POSCTL and ALTCTL.
    Without stick input the vehicle descends slowly."""

    lifts_off = True

    @property
    def automatic(self) -> bool:
        return False

    def enter(self, estimate: StateEstimate, place_ned_m: Triple, *, landed: bool) -> None:
        self.guidance.sticks.begin()

    def motion(self, estimate: StateEstimate, *, landed: bool) -> MotionSetpoint:
        """Return the motion that the sticks demand; horizontally and vertically the place is held
        if there is no demand."""
        guidance = self.guidance
        descend = descent(guidance.hold_ned_m, guidance.parameters.role("stick_descent_mps"))
        if not guidance.sticks.present(estimate.time_s):
            return descend
        demand = guidance.sticks.demand(estimate.time_s, estimate.yaw_rad)
        velocity, acceleration, climb_mps, turn_radps = demand
        if landed and climb_mps <= 0.0:
            return descend
        (x, y, z), stop = guidance.hold_ned_m, guidance.stopping_place_ned_m(estimate)
        moves = math.hypot(*velocity) > _STILL_MPS
        x, y = stop[:2] if moves else (x, y)
        guidance.hold = MotionSetpoint((x, y, stop[2] if climb_mps else z))
        none = (math.nan, math.nan)
        return MotionSetpoint(
            (*(none if moves else (x, y)), math.nan if climb_mps else z),
            (*(velocity if moves else none), -climb_mps or math.nan),
            (*(acceleration if moves else none), math.nan),
            yaw_rate_radps=turn_radps or math.nan,
        )


class FollowSetpoint(ActiveBehaviour):
    """PX4 OFFBOARD, ArduCopter GUIDED: follows a motion setpoint; holds its place without one. The
    position controller flies an attitude setpoint itself and then does not call `motion`."""

    lifts_off = True
    _velocity_ned_mps = NAN3  # integral of accelerations

    def motion(self, estimate: StateEstimate, *, landed: bool) -> MotionSetpoint:
        setpoint = self.guidance.newest
        if isinstance(setpoint, MotionSetpoint):
            self.cannot_climb = False
            return self._integrated(setpoint, estimate) if self.automatic else setpoint
        self.cannot_climb = landed  # a landed vehicle waits for a setpoint or a takeoff
        return self.guidance.hold

    def _integrated(self, setpoint: MotionSetpoint, estimate: StateEstimate) -> MotionSetpoint:
        """ArduCopter integrates an acceleration without position and velocity to a velocity."""
        before_ned_mps, self._velocity_ned_mps = self._velocity_ned_mps, NAN3
        if not all(map(math.isnan, (*setpoint.position_ned_m, *setpoint.velocity_ned_mps))):
            return setpoint
        if math.isnan(before_ned_mps[0]):
            before_ned_mps = estimate.velocity_ned_mps
        (x, y, z), (ax, ay, az) = before_ned_mps, setpoint.acceleration_ned_mps2
        self._velocity_ned_mps = (x + ax * LOOP_S, y + ay * LOOP_S, z + az * LOOP_S)
        return replace(setpoint, velocity_ned_mps=self._velocity_ned_mps)

    @property
    def automatic(self) -> bool:
        return self.guidance.firmware.ardupilot_setpoints


class Orbit(ActiveBehaviour):
    """PX4 ORBIT: flies `guidance.circle`."""

    def motion(self, estimate: StateEstimate, *, landed: bool) -> MotionSetpoint:
        circle, (x, y, _) = self.guidance.circle, estimate.position_ned_m
        north, east, down = circle.centre_ned_m
        radius_m = abs(circle.radius_m)
        bearing_rad = math.atan2(y - east, x - north)
        cos, sin = math.cos(bearing_rad), math.sin(bearing_rad)
        outward_mps = radius_m - math.hypot(x - north, y - east)
        along_mps = math.copysign(circle.speed_mps, circle.radius_m)
        inward_mps2 = along_mps**2 / radius_m
        offset_rad = {0: math.pi, 3: math.copysign(0.5 * math.pi, along_mps)}  # to centre, tangent
        return MotionSetpoint(
            (math.nan, math.nan, down),
            (outward_mps * cos - along_mps * sin, outward_mps * sin + along_mps * cos, math.nan),
            (-inward_mps2 * cos, -inward_mps2 * sin, math.nan),
            wrap_pi(bearing_rad + offset_rad.get(circle.yaw_behaviour, math.nan)),
        )


BEHAVIOURS: Mapping[Behaviour, type[ActiveBehaviour]] = {
    # hold, or fly to the place that a client named: PX4 AUTO.LOITER; ArduCopter BRAKE
    Behaviour.HOLD: ActiveBehaviour,
    Behaviour.TAKEOFF: Takeoff,
    Behaviour.LAND: Land,
    Behaviour.RETURN: Return,
    Behaviour.MISSION: FlyMission,
    Behaviour.STICKS: FlyBySticks,
    # the position controller flies these itself and does not call `motion`
    Behaviour.LEVEL: ActiveBehaviour,
    Behaviour.COAST: ActiveBehaviour,
    Behaviour.SETPOINT: FollowSetpoint,
    Behaviour.ORBIT: Orbit,
}
