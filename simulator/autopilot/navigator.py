"""The navigator: where the vehicle is to be, by what it does or by whose setpoint it obeys.

Behaviour and estimate in, motion demanded out. Knows position, time, home and parameters; knows no
modes by name, no thrust and no attitude loop (`simulator.autopilot.pilot` flies what it says).
"""

from __future__ import annotations

import math
from dataclasses import replace

from simulator.autopilot.descent import Return, land_speed_mps, sink
from simulator.autopilot.mission import Mission
from simulator.autopilot.nav import Nav
from simulator.autopilot.parameters import ParameterTable
from simulator.autopilot.sticks import Sticks
from simulator.autopilot.trajectory import Leg, Trajectory
from simulator.firmware.base import Firmware
from simulator.firmware.values import (
    NAN3,
    AttitudeSetpoint,
    Behaviour,
    MotionSetpoint,
    Quaternion,
    Triple,
)

_STILL_MPS = 0.05  # slower than that it holds its place
_FLATTEST = 1000.0  # metres across per metre of climb
_STANDING = frozenset({Behaviour.HOLD, Behaviour.SETPOINT})
_BY_ITSELF = frozenset(
    {Behaviour.HOLD, Behaviour.TAKEOFF, Behaviour.LAND, Behaviour.RETURN, Behaviour.MISSION}
)


class Navigator:
    """Goes about one behaviour at a time; `setpoint` is what somebody asked for last."""

    def __init__(
        self,
        firmware: Firmware,
        parameters: ParameterTable,
        mission: Mission,
        sticks: Sticks | None = None,
    ) -> None:
        self._firmware = firmware
        self._parameters = parameters
        self.mission = mission
        self._sticks = sticks
        self._events = self.mission.events
        self.behaviour = Behaviour.HOLD
        self.setpoint: AttitudeSetpoint | MotionSetpoint | None = None
        self.home_ned_m: Triple = (0.0, 0.0, 0.0)
        self.home_yaw_rad = 0.0
        self.cruise_mps = math.inf  # asked for, in automatic flight
        self._return = Return(firmware, parameters, self._events)
        self._hold: Triple = (0.0, 0.0, 0.0)
        self._held = MotionSetpoint(self._hold)
        self._takeoff_ned_m, self._climb_begun = NAN3, False
        self.earthbound = False  # the takeoff leads nowhere up
        self._climbed = False
        self._levelling: AttitudeSetpoint | None = None  # the last one of our own
        limits = firmware.flight.path_limits
        self._way = Trajectory(limits, parameters) if limits else None

    # -- what it does ------------------------------------------------------------------------

    def enter(self, behaviour: Behaviour, nav: Nav, takeoff_ned_m: Triple = NAN3) -> None:
        """Begin a behaviour here; hold after a climb keeps the climb's target, and hold asked
        for again the place it goes to.

        `takeoff_ned_m`: where to climb to; NaN here, and the default height.
        """
        goes_on = behaviour is self.behaviour is Behaviour.HOLD and self._is_going
        if not (goes_on or (self._climbed and behaviour in _STANDING)):
            self._hold = self._ahead(nav)
        if behaviour is not self.behaviour:
            self.cruise_mps = math.inf
        if self._way is not None and behaviour not in _BY_ITSELF:
            self._way.leave()
        self.behaviour = behaviour
        self._takeoff_ned_m, self._climb_begun, self.earthbound = takeoff_ned_m, False, False
        self._return = Return(self._firmware, self._parameters, self._events)
        self._climbed = False
        self.mission.pause()
        if self._sticks is not None:
            self._sticks.begin()

    def arm(self, nav: Nav) -> None:
        """The motors begin to turn: home is here."""
        self.home_ned_m, self.home_yaw_rad = nav.position_ned_m, nav.yaw_rad
        self.mission.pause()
        if self._way is not None:
            self._way.leave()
        self.stay(nav)

    def stay(self, nav: Nav) -> None:
        """Hold exactly here."""
        self._hold = nav.position_ned_m

    def obey(self, setpoint: AttitudeSetpoint | MotionSetpoint) -> None:
        """From now on; one of another kind than before, flown as automatic flight is, forgets the
        speed that was asked for."""
        anew = _kind(setpoint) != _kind(self.setpoint)
        if anew and self._firmware.setpoints.as_automatic:
            self.cruise_mps = math.inf
        self.setpoint = setpoint

    def go_to(self, place_ned_m: Triple, yaw_rad: float) -> None:
        """Hold there, in a mode that holds or obeys; no number keeps the course."""
        self._hold = place_ned_m
        self._held = MotionSetpoint(place_ned_m, yaw_rad=yaw_rad, faces_way=True)
        if self.behaviour is Behaviour.SETPOINT:
            self.obey(self._held)

    @property
    def _is_going(self) -> bool:
        """To a place that somebody named, or stands there."""
        return self._held.faces_way and self._held.position_ned_m is self._hold

    def turn_to(self, yaw_rad: float, turn_radps: float) -> None:
        """Keep this course while holding or obeying."""
        self._held = MotionSetpoint(self._hold, yaw_rad=yaw_rad, turn_radps=turn_radps)
        if isinstance(self.setpoint, MotionSetpoint):
            self.setpoint = replace(self.setpoint, yaw_rad=yaw_rad, turn_radps=turn_radps)

    def level(self, nav: Nav) -> None:
        """Nobody says what to do: level, course and height as they are."""
        self._levelling = AttitudeSetpoint(level(nav.yaw_rad), None, 0.0, climb_mps=0.0)
        self.setpoint = self._levelling

    def tell(self) -> list[str]:
        """The events since it was last asked."""
        told = [*(("climbed",) if self._climbed else ()), *self._events]
        self._events.clear()
        return told

    # -- what others see ---------------------------------------------------------------------

    @property
    def landing(self) -> bool:
        """On the last way down."""
        return self.behaviour is Behaviour.LAND or (
            self._return.landing
            if self.behaviour is Behaviour.RETURN
            else self.behaviour is Behaviour.MISSION and self.mission.landing
        )

    @property
    def climbing(self) -> bool:
        """Taking off, by itself."""
        by_mission = self.behaviour is Behaviour.MISSION and self.mission.climbing
        return by_mission or self.behaviour is Behaviour.TAKEOFF

    @property
    def target_height_m(self) -> float:
        """Of what it holds or climbs to, above home."""
        place = self._return.place if self.behaviour is Behaviour.RETURN else self._hold
        return self.home_ned_m[2] - place[2]

    @property
    def attitude_setpoint(self) -> AttitudeSetpoint | None:
        """What is obeyed, if it is one of attitude: no place is wanted then."""
        if self.behaviour is Behaviour.SETPOINT and isinstance(self.setpoint, AttitudeSetpoint):
            return self.setpoint
        return None

    @property
    def obeys_attitude(self) -> bool:
        """Somebody else's attitude setpoint is flown."""
        setpoint = self.attitude_setpoint
        return setpoint is not None and setpoint is not self._levelling

    @property
    def obeys_motion(self) -> bool:
        """Somebody else's position, velocity or acceleration is flown."""
        return self.behaviour is Behaviour.SETPOINT and isinstance(self.setpoint, MotionSetpoint)

    @property
    def obeys_velocity(self) -> bool:
        """The same, but somebody must go on saying so."""
        if not (self.obeys_motion and isinstance(self.setpoint, MotionSetpoint)):
            return False
        rates = (*self.setpoint.velocity_ned_mps, *self.setpoint.acceleration_ned_mps2)
        return not all(map(math.isnan, rates))

    # -- where to be -------------------------------------------------------------------------

    @property
    def automatic(self) -> bool:
        """Speeds and turns are those of automatic flight."""
        return self.behaviour is not Behaviour.SETPOINT or self._firmware.setpoints.as_automatic

    @property
    def across_mps(self) -> float:
        """Greatest speed across the ground."""
        asked_mps = self._parameters.role("cruise_speed_mps") if self.automatic else math.inf
        if self.automatic or self.setpoint is self._held:
            asked_mps = min(asked_mps, self.cruise_mps)
        if self.behaviour is Behaviour.MISSION:
            asked_mps = min(asked_mps, self.mission.speed_mps)
        return asked_mps

    @property
    def smooth(self) -> bool:
        """The motion asked for keeps all limits by itself."""
        return self._way is not None and self._way.under_way

    @property
    def rises(self) -> bool:
        """It is to go up, smoothly."""
        return self._way is not None and self._way.under_way and self._way.wants_up

    @property
    def _standing(self) -> MotionSetpoint:
        if self.behaviour is Behaviour.SETPOINT and isinstance(self.setpoint, MotionSetpoint):
            return self.setpoint
        if self._held.position_ned_m is not self._hold:
            self._held = MotionSetpoint(self._hold)
        return self._held

    def motion(self, nav: Nav, time_s: float, *, landed: bool, waits: bool) -> MotionSetpoint:
        """Where to be now, and how to get there; NED, SI, vehicle time. `waits`: on the ground,
        not to lift off yet."""
        goal = self._goal(nav, time_s, landed=landed)
        if self._way is None or self.behaviour not in _BY_ITSELF:
            return goal
        return self._way.follow(goal, self._leg(nav), nav, waits=waits)

    def _leg(self, nav: Nav) -> Leg:
        height_m = self.home_ned_m[2] - nav.position_ned_m[2]
        if self.behaviour is not Behaviour.MISSION:
            return Leg(self.across_mps, takeoff=self.climbing, height_m=height_m)
        before, behind = self.mission.before_ned_m, self.mission.behind_ned_m
        return Leg(
            self.across_mps, before, behind, self.mission.accepted_m, self.climbing, height_m
        )

    def _goal(self, nav: Nav, time_s: float, *, landed: bool) -> MotionSetpoint:
        if self.behaviour is Behaviour.TAKEOFF:
            return self._climb(nav, landed=landed)
        if self.behaviour is Behaviour.RETURN:
            return self._return.fly(time_s, nav, self.home_ned_m, self.home_yaw_rad)
        if self.behaviour is Behaviour.MISSION:
            return self._follow_mission(nav, time_s, landed=landed)
        if self.behaviour is Behaviour.LAND:
            return sink(self._hold, land_speed_mps(nav, self.home_ned_m[2], self._parameters))
        if self.behaviour is Behaviour.DESCEND:
            return self._by_sticks(nav, time_s, landed=landed)
        return self._standing

    def _by_sticks(self, nav: Nav, time_s: float, *, landed: bool) -> MotionSetpoint:
        """What they ask for; what none of them asks for stays as it is."""
        if self._sticks is None:
            return sink(self._hold, self._firmware.flight.descend_speed_mps)
        across, change, climb_mps, turn_radps = self._sticks.ask(time_s, nav.yaw_rad)
        if landed and climb_mps <= 0.0:
            return sink(self._hold, self._firmware.flight.descend_speed_mps)
        (x, y, z), ahead = self._hold, self._ahead(nav)
        moves = math.hypot(*across) > _STILL_MPS
        x, y = ahead[:2] if moves else (x, y)
        self._hold = (x, y, ahead[2] if climb_mps else z)
        nothing = (math.nan, math.nan)
        return MotionSetpoint(
            (*(nothing if moves else (x, y)), math.nan if climb_mps else z),
            (*(across if moves else nothing), -climb_mps or math.nan),
            (*(change if moves else nothing), math.nan),
            yaw_rate_radps=turn_radps or math.nan,
        )

    def _climb(self, nav: Nav, *, landed: bool) -> MotionSetpoint:
        if not self._climb_begun:
            self._climb_begun = True
            self._begin_climb(nav.position_ned_m, landed=landed)
        north, east, target_z = self._takeoff_ned_m
        if math.isnan(north + east):
            north, east = self._hold[:2]
        if nav.position_ned_m[2] < target_z + self._parameters.role("climbed_within_m"):
            self._climbed = not landed
        self._hold = (north, east, target_z)
        return MotionSetpoint(self._hold)

    def _ahead(self, nav: Nav) -> Triple:
        """Where a vehicle comes to rest that brakes gently from here."""
        if self._way is not None:
            return self._way.stop_ned_m(nav)
        (x, y, z), (vx, vy, vz) = nav.position_ned_m, nav.velocity_ned_mps
        return (x + 0.5 * vx, y + 0.5 * vy, z + 0.2 * vz)

    def _begin_climb(self, here_ned_m: Triple, *, landed: bool) -> None:
        """No way down, and from the ground none that is flat, is flown."""
        (x, y, z), (north, east, target_z) = here_ned_m, self._takeoff_ned_m
        if math.isnan(target_z):
            target_z = z - self._parameters.role("takeoff_height_m")
            self._events.append("default height")
        elif target_z > z:
            target_z, self.earthbound = z, landed
            self._events.append("already higher")
        if landed and math.hypot(north - x, east - y) > _FLATTEST * (z - target_z):
            self.earthbound = True
        self._takeoff_ned_m = (north, east, target_z)

    def _follow_mission(self, nav: Nav, time_s: float, *, landed: bool) -> MotionSetpoint:
        motion = self.mission.fly(time_s, nav.position_ned_m, self.home_ned_m, landed=landed)
        if self.mission.landing:
            speed_mps = land_speed_mps(nav, self.home_ned_m[2], self._parameters)
            return sink(motion.position_ned_m, speed_mps)
        return motion


def level(yaw_rad: float) -> Quaternion:
    """Attitude of this course without tilt."""
    return (math.cos(0.5 * yaw_rad), 0.0, 0.0, math.sin(0.5 * yaw_rad))


def _kind(setpoint: AttitudeSetpoint | MotionSetpoint | None) -> tuple[bool, ...]:
    """Whether it gives an attitude, a place and a velocity."""
    if not isinstance(setpoint, MotionSetpoint):
        return (setpoint is not None,)
    given = (setpoint.position_ned_m, setpoint.velocity_ned_mps)
    return tuple(not math.isnan(vector[0]) for vector in given)
