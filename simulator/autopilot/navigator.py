"""The navigator: where the vehicle is to be, by the behaviour of its mode.

Holds the behaviour in force and lets the firmware's trajectory plan the way to its goal. Knows
position and time; knows no modes by name, no thrust and no attitude loop: the pilot
(`simulator.autopilot.pilot`) flies the motion that it asks for.
"""

from __future__ import annotations

import math

from simulator.autopilot.behaviours import BEHAVIOURS, ActiveBehaviour
from simulator.autopilot.guidance import Guidance
from simulator.autopilot.nav import Nav
from simulator.firmware.values import (
    NAN3,
    AttitudeSetpoint,
    Behaviour,
    MotionSetpoint,
    Quaternion,
    Triple,
)


class Navigator:
    """Carries out one behaviour at a time."""

    def __init__(self, guidance: Guidance) -> None:
        self.guidance = guidance
        self.behaviour = Behaviour.HOLD
        self.active: ActiveBehaviour = BEHAVIOURS[Behaviour.HOLD](guidance)
        self._levelling: AttitudeSetpoint | None = None  # the newest setpoint of `level_off`

    def enter(self, behaviour: Behaviour, nav: Nav, place_ned_m: Triple = NAN3) -> None:
        """Begin a behaviour here. `place_ned_m`: where a takeoff is to climb to."""
        guidance = self.guidance
        if not self.active.keeps_place(behaviour):
            guidance.hold_ned_m = guidance.stopping_place_ned_m(nav)
        if behaviour is not self.behaviour:
            guidance.cruise_mps = math.inf
        self.active.left()
        self.behaviour, self.active = behaviour, BEHAVIOURS[behaviour](guidance)
        if guidance.trajectory is not None and not self.active.planned:
            guidance.trajectory.leave()
        self.active.enter(nav, place_ned_m)

    def arm(self, nav: Nav) -> None:
        """The motors start: home is here."""
        guidance = self.guidance
        guidance.home_ned_m, guidance.home_yaw_rad = nav.position_ned_m, nav.yaw_rad
        guidance.mission.pause()
        if guidance.trajectory is not None:
            guidance.trajectory.leave()
        guidance.hold_ned_m = nav.position_ned_m

    def follow(self, setpoint: AttitudeSetpoint | MotionSetpoint) -> None:
        """Take a client's setpoint. One of another kind than before, flown as automatic flight is
        (ArduCopter), resets the speed that was asked for."""
        guidance = self.guidance
        changes = _kind(setpoint) != _kind(guidance.setpoint)
        if changes and guidance.firmware.setpoints.as_automatic:
            guidance.cruise_mps = math.inf
        guidance.setpoint = setpoint

    def go_to(self, place_ned_m: Triple, yaw_rad: float) -> None:
        """Hold there, in a mode that holds or follows setpoints; a NaN yaw faces the way there."""
        held = self.guidance.hold_at(place_ned_m, yaw_rad)
        if self.behaviour is Behaviour.SETPOINT:
            self.follow(held)

    def level_off(self, nav: Nav) -> None:
        """No setpoint arrives: level attitude, present yaw and height."""
        self._levelling = AttitudeSetpoint(level(nav.yaw_rad), None, 0.0, climb_mps=0.0)
        self.guidance.setpoint = self._levelling

    def take_events(self) -> list[str]:
        """The events since the last call, and those in force."""
        events = [*self.active.events, *self.guidance.events]
        self.guidance.events.clear()
        return events

    # -- answers -----------------------------------------------------------------------------

    @property
    def target_height_m(self) -> float:
        """Height above home of the place that it holds or climbs to."""
        return self.guidance.home_ned_m[2] - self.active.target_ned_m[2]

    @property
    def attitude_setpoint(self) -> AttitudeSetpoint | None:
        """The attitude setpoint in force; with one no place is wanted."""
        setpoint = self.guidance.setpoint
        if self.behaviour is Behaviour.SETPOINT and isinstance(setpoint, AttitudeSetpoint):
            return setpoint
        return None

    @property
    def follows_attitude(self) -> bool:
        """A client's attitude setpoint is flown."""
        setpoint = self.attitude_setpoint
        return setpoint is not None and setpoint is not self._levelling

    @property
    def follows_motion(self) -> bool:
        """A client's position, velocity or acceleration setpoint is flown."""
        by_motion = isinstance(self.guidance.setpoint, MotionSetpoint)
        return by_motion and self.behaviour is Behaviour.SETPOINT

    @property
    def follows_velocity(self) -> bool:
        """The same with a velocity or an acceleration, which must be repeated."""
        setpoint = self.guidance.setpoint
        if self.behaviour is not Behaviour.SETPOINT or not isinstance(setpoint, MotionSetpoint):
            return False
        rates = (*setpoint.velocity_ned_mps, *setpoint.acceleration_ned_mps2)
        return not all(map(math.isnan, rates))

    # -- where to be -------------------------------------------------------------------------

    @property
    def cruise_mps(self) -> float:
        """Horizontal speed limit."""
        guidance, automatic = self.guidance, self.active.automatic
        limit_mps = guidance.parameters.role("cruise_speed_mps") if automatic else math.inf
        if automatic or guidance.setpoint_is_held:
            limit_mps = min(limit_mps, guidance.cruise_mps)
        return min(limit_mps, self.active.speed_mps)

    @property
    def planned(self) -> bool:
        """The trajectory is flown: the motion asked for keeps all limits by itself."""
        trajectory = self.guidance.trajectory
        return trajectory is not None and trajectory.under_way

    @property
    def plans_up(self) -> bool:
        """The trajectory leads upwards."""
        trajectory = self.guidance.trajectory
        return trajectory is not None and trajectory.under_way and trajectory.wants_up

    def motion(self, nav: Nav, time_s: float, *, landed: bool, waits: bool) -> MotionSetpoint:
        """The motion of this period; NED, SI, vehicle time. `waits`: on the ground, not to lift off
        yet."""
        guidance, active = self.guidance, self.active
        goal = active.motion(nav, time_s, landed=landed)
        if guidance.trajectory is None or not active.planned:
            return goal
        height_m = guidance.home_ned_m[2] - nav.position_ned_m[2]
        return guidance.trajectory.follow(
            goal, active.leg(self.cruise_mps, height_m), nav, waits=waits
        )


def level(yaw_rad: float) -> Quaternion:
    """The attitude with this yaw and no tilt."""
    return (math.cos(0.5 * yaw_rad), 0.0, 0.0, math.sin(0.5 * yaw_rad))


def _kind(setpoint: AttitudeSetpoint | MotionSetpoint | None) -> tuple[bool, ...]:
    """Whether it gives an attitude, a place and a velocity."""
    if not isinstance(setpoint, MotionSetpoint):
        return (setpoint is not None,)
    given = (setpoint.position_ned_m, setpoint.velocity_ned_mps)
    return tuple(not math.isnan(vector[0]) for vector in given)
