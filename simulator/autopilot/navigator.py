"""The navigator: which motion the vehicle flies, by the behaviour of its mode.

Knows position and time; knows no modes by name, no thrust and no attitude loop: the position
controller flies the motion.
"""

from __future__ import annotations

import math

from simulator.autopilot.behaviours import BEHAVIOURS, ActiveBehaviour
from simulator.autopilot.guidance import Guidance
from simulator.autopilot.position_loop import level
from simulator.autopilot.state import StateEstimate
from simulator.firmware.values import NAN3, AttitudeSetpoint, Behaviour, MotionSetpoint, Triple


class Navigator:
    """Carries out one behaviour at a time."""

    def __init__(self, guidance: Guidance) -> None:
        self.guidance = guidance
        self.behaviour = Behaviour.HOLD
        self.active: ActiveBehaviour = BEHAVIOURS[Behaviour.HOLD](guidance)
        self._entered = True  # `active.enter` was called
        self._place_ned_m = NAN3  # for `active.enter`
        self._level: AttitudeSetpoint | None = None  # the last of `level_off`

    def enter(
        self, behaviour: Behaviour, estimate: StateEstimate, place_ned_m: Triple = NAN3
    ) -> None:
        """Begin a behaviour. `place_ned_m`: where a takeoff climbs to."""
        guidance = self.guidance
        if not self.active.keeps_place(behaviour):
            guidance.hold = MotionSetpoint(guidance.stopping_place_ned_m(estimate))
        if behaviour is not self.behaviour:
            guidance.cruise_mps = math.inf
        self.active.leave()
        self.behaviour, self.active = behaviour, BEHAVIOURS[behaviour](guidance)
        self._entered, self._place_ned_m = False, place_ned_m

    def arm(self, estimate: StateEstimate) -> None:
        """The motors start: set home."""
        guidance = self.guidance
        guidance.home_ned_m, guidance.home_yaw_rad = estimate.position_ned_m, estimate.yaw_rad
        guidance.hold = MotionSetpoint(estimate.position_ned_m)
        guidance.mission.pause()

    def follow(self, setpoint: AttitudeSetpoint | MotionSetpoint) -> None:
        """Take a client's setpoint. Where setpoints are flown as automatic flight (ArduCopter), a
        setpoint of another kind resets the requested speed."""
        guidance = self.guidance
        changes = _kind(setpoint) != _kind(guidance.setpoint)
        if changes and guidance.firmware.setpoints_as_automatic:
            guidance.cruise_mps = math.inf
        guidance.setpoint = setpoint

    def level_off(self, estimate: StateEstimate) -> None:
        """The stream of attitude setpoints is lost: level attitude, present yaw and height."""
        self._level = AttitudeSetpoint(level(estimate.yaw_rad), None, 0.0, climb_mps=0.0)
        self.guidance.setpoint = self._level

    @property
    def setpoint(self) -> AttitudeSetpoint | MotionSetpoint | None:
        """The setpoint that is followed; None in other behaviours."""
        return self.guidance.setpoint if self.behaviour is Behaviour.SETPOINT else None

    @property
    def follows_attitude(self) -> bool:
        """A client's attitude setpoint is followed."""
        return isinstance(self.setpoint, AttitudeSetpoint) and self.setpoint is not self._level

    @property
    def follows_velocity(self) -> bool:
        """A setpoint with a velocity or an acceleration is followed, which must be repeated."""
        if not isinstance(self.setpoint, MotionSetpoint):
            return False
        rates = (*self.setpoint.velocity_ned_mps, *self.setpoint.acceleration_ned_mps2)
        return not all(map(math.isnan, rates))

    @property
    def cruise_mps(self) -> float:
        """Horizontal speed limit."""
        guidance, automatic = self.guidance, self.active.automatic
        limit_mps = guidance.parameters.role("cruise_speed_mps") if automatic else math.inf
        if automatic or guidance.setpoint is guidance.hold:
            limit_mps = min(limit_mps, guidance.cruise_mps)
        return min(limit_mps, self.active.speed_mps)

    def motion(self, estimate: StateEstimate, *, landed: bool) -> MotionSetpoint:
        """Motion of this period."""
        if not self._entered:
            self._entered = True
            self.active.enter(estimate, self._place_ned_m, landed=landed)
        return self.active.motion(estimate, landed=landed)


def _kind(setpoint: AttitudeSetpoint | MotionSetpoint | None) -> tuple[bool, ...]:
    """What a setpoint demands: an attitude, or which of position and velocity."""
    if not isinstance(setpoint, MotionSetpoint):
        return (setpoint is not None,)
    given = (setpoint.position_ned_m, setpoint.velocity_ned_mps)
    return tuple(not math.isnan(vector[0]) for vector in given)
