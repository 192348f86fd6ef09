"""Guidance: which motion the vehicle flies, by the behaviour of its mode.

Home, the place to hold and a client's setpoint outlive a change of mode; every behaviour
(`simulator.autopilot.behaviours`) reads and changes them here. NED, SI. Knows no modes by name, no
thrust and no attitude loop: the position controller flies the motion.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import ClassVar

from simulator.autopilot.firmware import Firmware
from simulator.autopilot.mission import Mission
from simulator.autopilot.parameters import ParameterTable
from simulator.autopilot.position_loop import level
from simulator.autopilot.state import StateEstimate
from simulator.autopilot.sticks import Sticks
from simulator.autopilot.values import NAN3, AttitudeSetpoint, Behaviour, MotionSetpoint, Triple

ORIGIN: Triple = (0.0, 0.0, 0.0)
Setpoint = AttitudeSetpoint | MotionSetpoint


class ActiveBehaviour:
    """Holds position (`guidance.hold`); the base class of the other behaviours.

    There is a new object each time that its mode is entered. The defaults are those of automatic
    flight that starts in the air and does not end by itself.
    """

    lifts_off: ClassVar[bool] = False  # may leave the ground
    cannot_climb = False  # a takeoff whose target is not above the vehicle

    def __init__(self, guidance: Guidance) -> None:
        self.guidance = guidance

    def enter(self, estimate: StateEstimate, place_ned_m: Triple, *, landed: bool) -> None:
        """Begin, before the first `motion`. `place_ned_m`: where a takeoff climbs to; NaN where it
        is not specified."""

    def leave(self) -> None:
        """End: another behaviour begins."""

    def motion(self, estimate: StateEstimate, *, landed: bool) -> MotionSetpoint:
        """Motion demanded in this period; by default `guidance.hold`."""
        return self.guidance.hold

    def keeps_place(self, following: Behaviour) -> bool:
        """The behaviour that follows holds the same place; else it holds where it stops."""
        return False

    @property
    def landing(self) -> bool:
        """In the final descent."""
        return False

    @property
    def climbing(self) -> bool:
        """In an automatic takeoff."""
        return False

    @property
    def automatic(self) -> bool:
        """Speeds and turn rates are those of automatic flight."""
        return True

    @property
    def speed_mps(self) -> float:
        """Horizontal speed limit of this behaviour."""
        return math.inf


class Guidance:
    """Carries out one behaviour at a time.

    `sticks` is None for a firmware whose sticks are not simulated (PX4). `events` are reported to
    the commander at each step.
    """

    def __init__(
        self,
        firmware: Firmware,
        parameters: ParameterTable,
        mission: Mission,
        behaviours: Mapping[Behaviour, type[ActiveBehaviour]],
    ) -> None:
        self.firmware, self.parameters, self.mission = firmware, parameters, mission
        self.events = mission.events
        self.sticks = Sticks() if firmware.flown_by_sticks else None
        self.newest: Setpoint | None = None  # setpoint of a client
        self.newest_s = -math.inf  # time of the last one that was accepted
        self.hold = MotionSetpoint(ORIGIN)
        self.home_ned_m = ORIGIN
        self.home_yaw_rad = 0.0
        self.cruise_mps = math.inf  # requested for automatic flight; inf: none
        self.region_ned_m: tuple[float, float] | None = (
            None  # of interest, faced while it holds a place or follows setpoints without a yaw
        )
        self._behaviours = behaviours
        self.behaviour = Behaviour.HOLD
        self.active = behaviours[Behaviour.HOLD](self)
        self._entered = True  # `active.enter` was called
        self._place_ned_m = NAN3  # for `active.enter`
        self._level: AttitudeSetpoint | None = None  # the last of `level_off`

    # -- what is flown -----------------------------------------------------------------------

    def enter(
        self, behaviour: Behaviour, estimate: StateEstimate, place_ned_m: Triple = NAN3
    ) -> None:
        """Begin a behaviour. `place_ned_m`: where a takeoff climbs to."""
        if not self.active.keeps_place(behaviour):
            self.hold = MotionSetpoint(stopping_place_ned_m(estimate))
        if behaviour is not self.behaviour:
            self.cruise_mps = math.inf
        self.region_ned_m = None
        self.active.leave()
        self.behaviour, self.active = behaviour, self._behaviours[behaviour](self)
        self._entered, self._place_ned_m = False, place_ned_m

    def arm(self, estimate: StateEstimate) -> None:
        """The motors start: set home."""
        self.home_ned_m, self.home_yaw_rad = estimate.position_ned_m, estimate.yaw_rad
        self.hold = MotionSetpoint(estimate.position_ned_m)
        self.mission.pause()

    def follow(self, setpoint: Setpoint) -> None:
        """Take a client's setpoint. Where setpoints are flown as automatic flight (ArduCopter), a
        setpoint of another kind resets the requested speed."""
        if self.firmware.setpoints_as_automatic and _kind(setpoint) != _kind(self.newest):
            self.cruise_mps = math.inf
        self.newest = setpoint

    def level_off(self, estimate: StateEstimate) -> None:
        """The stream of attitude setpoints is lost: level attitude, present yaw and height."""
        self.newest = self._level = AttitudeSetpoint(
            level(estimate.yaw_rad), None, 0.0, climb_mps=0.0
        )

    def motion(self, estimate: StateEstimate, *, landed: bool) -> MotionSetpoint:
        """Motion of this period."""
        if not self._entered:
            self._entered = True
            self.active.enter(estimate, self._place_ned_m, landed=landed)
        motion = self.active.motion(estimate, landed=landed)
        turns = not math.isnan(motion.yaw_rad) or not math.isnan(motion.yaw_rate_radps)
        if self.region_ned_m is None or turns or motion not in (self.hold, self.newest):
            return motion
        (north, east), (x, y, _) = self.region_ned_m, estimate.position_ned_m
        return replace(motion, yaw_rad=math.atan2(east - y, north - x))

    # -- setpoint, place and speed -----------------------------------------------------------

    def stream_alive(self, now_s: float) -> bool:
        """Whether setpoints still arrive. A loss counts `stream_reaction_s` after the time-out."""
        role = self.parameters.role
        age_s = now_s - self.newest_s - role("stream_reaction_s")
        return age_s <= role("stream_timeout_s")

    @property
    def setpoint(self) -> Setpoint | None:
        """The setpoint that is followed; None in other behaviours."""
        return self.newest if self.behaviour is Behaviour.SETPOINT else None

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
    def hold_ned_m(self) -> Triple:
        """The place to hold."""
        return self.hold.position_ned_m

    def hold_at(self, place_ned_m: Triple, yaw_rad: float) -> None:
        """Hold a place that a client names; a NaN yaw faces the direction of flight."""
        self.hold = MotionSetpoint(place_ned_m, yaw_rad=yaw_rad, faces_way=True)
        if self.behaviour is Behaviour.SETPOINT:
            self.follow(self.hold)

    def turn_to(self, yaw_rad: float, turn_radps: float, sense: float) -> None:
        """Keep this yaw while holding a place or following a setpoint."""
        self.region_ned_m = None

        def turned(setpoint: MotionSetpoint) -> MotionSetpoint:
            return replace(setpoint, yaw_rad=yaw_rad, turn_radps=turn_radps, turn_sense=sense)

        self.hold = turned(MotionSetpoint(self.hold_ned_m))
        if isinstance(self.newest, MotionSetpoint):
            self.newest = turned(self.newest)

    @property
    def speed_limit_mps(self) -> float:
        """Horizontal speed limit."""
        automatic = self.active.automatic
        limit_mps = self.parameters.role("cruise_speed_mps") if automatic else math.inf
        if automatic or self.newest is self.hold:
            limit_mps = min(limit_mps, self.cruise_mps)
        return min(limit_mps, self.active.speed_mps)


def stopping_place_ned_m(estimate: StateEstimate) -> Triple:
    """Where the vehicle stops when it brakes now."""
    (x, y, z), (vx, vy, vz) = estimate.position_ned_m, estimate.velocity_ned_mps
    return (x + 0.5 * vx, y + 0.5 * vy, z + 0.2 * vz)


def _kind(setpoint: Setpoint | None) -> tuple[bool, ...]:
    """What a setpoint demands: an attitude, or which of position and velocity."""
    if not isinstance(setpoint, MotionSetpoint):
        return (setpoint is not None,)
    given = (setpoint.position_ned_m, setpoint.velocity_ned_mps)
    return tuple(not math.isnan(vector[0]) for vector in given)
