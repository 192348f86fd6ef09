"""Guidance: the motion that the vehicle flies, according to the behaviour of its mode.

Home, the place to hold and a client's setpoint do not belong to one behaviour: every behaviour
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
from simulator.autopilot.values import (
    NAN3,
    AttitudeSetpoint,
    Behaviour,
    Circle,
    MotionSetpoint,
    Triple,
)

ORIGIN: Triple = (0.0, 0.0, 0.0)
Setpoint = AttitudeSetpoint | MotionSetpoint


class ActiveBehaviour:
    """Holds position (`guidance.hold`); the base class of the other behaviours.

    A new object is made each time the behaviour begins. The defaults are those of automatic flight
    that starts in the air and does not end by itself.
    """

    lifts_off: ClassVar[bool] = False  # whether it may leave the ground
    cannot_climb = False  # whether the vehicle stays on the ground, whatever motion is demanded

    def __init__(self, guidance: Guidance) -> None:
        self.guidance = guidance

    def enter(self, estimate: StateEstimate, place_ned_m: Triple, *, landed: bool) -> None:
        """Begin; called before the first `motion`. `place_ned_m` is the place to which a takeoff
        climbs, with NaN for coordinates that are not specified."""

    def leave(self) -> None:
        """End, because another behaviour begins, or this one begins again."""

    def motion(self, estimate: StateEstimate, *, landed: bool) -> MotionSetpoint:
        """Return the motion demanded in this period of the position loop."""
        return self.guidance.hold

    def keeps_place(self, following: Behaviour) -> bool:
        """Whether the behaviour `following` holds the same place; otherwise it holds the place
        where the vehicle stops."""
        return False

    @property
    def landing(self) -> bool:
        """Whether the vehicle is in the final descent of a landing."""
        return False

    @property
    def climbing(self) -> bool:
        """Whether the vehicle is in an automatic takeoff."""
        return False

    @property
    def automatic(self) -> bool:
        """Whether the speed and turn rate limits of automatic flight apply."""
        return True

    @property
    def speed_mps(self) -> float:
        """Horizontal speed limit of this behaviour."""
        return math.inf


class Guidance:
    """Carries out one behaviour at a time.

    The autopilot gives `events` to the commander at each step.
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
        self.sticks = Sticks(parameters.role, firmware.default_sticks_us)
        self.newest: Setpoint | None = None  # setpoint of a client
        self.newest_s = -math.inf  # time since boot of the newest accepted setpoint message
        self.hold = MotionSetpoint(ORIGIN)
        self.home_ned_m = ORIGIN
        self.home_yaw_rad = 0.0
        self.home_kept = False  # whether a client set home, which is then kept when it arms
        self.cruise_mps = math.inf  # speed requested for automatic flight; inf: none
        self.paused: MotionSetpoint | None = None  # flown until the behaviour continues or ends
        # region of interest, faced until the next setpoint
        self.region_ned_m: tuple[float, float] | None = None
        self.circle = Circle(ORIGIN, 1.0, 1.0, 0)
        self._behaviours = behaviours
        self.behaviour = Behaviour.HOLD
        self.active = behaviours[Behaviour.HOLD](self)
        self._entered = True  # whether `active.enter` was called
        self._place_ned_m = NAN3  # argument of `active.enter`
        self._level: AttitudeSetpoint | None = None  # setpoint of the last `level_off`

    # -- what is flown -----------------------------------------------------------------------

    def enter(
        self, behaviour: Behaviour, estimate: StateEstimate, place_ned_m: Triple = NAN3
    ) -> None:
        """Begin a behaviour. `place_ned_m` is the place to which a takeoff climbs."""
        if not self.active.keeps_place(behaviour):
            self.hold = MotionSetpoint(self.stopping_place_ned_m(estimate))
        if behaviour is not self.behaviour:
            self.cruise_mps = math.inf
        self.region_ned_m, self.paused = None, None
        self.active.leave()
        self.behaviour, self.active = behaviour, self._behaviours[behaviour](self)
        self._entered, self._place_ned_m = False, place_ned_m

    def arm(self, estimate: StateEstimate) -> None:
        """Set home, unless a client has done so, and the place to hold, when the motors start."""
        if not self.home_kept:
            self.home_ned_m, self.home_yaw_rad = estimate.position_ned_m, estimate.yaw_rad
        self.hold = MotionSetpoint(estimate.position_ned_m)
        self.mission.pause()

    def follow(self, setpoint: Setpoint) -> None:
        """Follow a client's setpoint, and no longer face a region of interest. Where setpoints are
        flown as automatic flight (ArduCopter), a setpoint of another kind than the last one resets
        the requested speed."""
        self.region_ned_m = None
        if self.firmware.ardupilot_setpoints and _kind(setpoint) != _kind(self.newest):
            self.cruise_mps = math.inf
        self.newest = setpoint

    def level_off(self, estimate: StateEstimate) -> None:
        """Keep a level attitude, the yaw and the height, after attitude setpoints were lost."""
        self.newest = self._level = AttitudeSetpoint(
            level(estimate.yaw_rad), None, 0.0, climb_mps=0.0
        )

    def motion(self, estimate: StateEstimate, *, landed: bool) -> MotionSetpoint:
        """Return the motion of this period of the position loop."""
        if not self._entered:
            self._entered = True
            self.active.enter(estimate, self._place_ned_m, landed=landed)
        if self.paused is not None:
            return self.paused
        motion = self.active.motion(estimate, landed=landed)
        turns = not math.isnan(motion.yaw_rad) or not math.isnan(motion.yaw_rate_radps)
        if self.region_ned_m is None or turns or motion not in (self.hold, self.newest):
            return motion
        (north, east), (x, y, _) = self.region_ned_m, estimate.position_ned_m
        return replace(motion, yaw_rad=math.atan2(east - y, north - x))

    # -- setpoint, place and speed -----------------------------------------------------------

    def stream_alive(self, now_s: float) -> bool:
        """Whether setpoints still arrive. They count as lost `stream_reaction_s` after the
        timeout."""
        role = self.parameters.role
        age_s = now_s - self.newest_s - role("stream_reaction_s")
        return age_s <= role("stream_timeout_s")

    @property
    def setpoint(self) -> Setpoint | None:
        """The setpoint that the vehicle follows; None in other behaviours."""
        follows = self.behaviour is Behaviour.SETPOINT and self.paused is None
        return self.newest if follows else None

    @property
    def follows_attitude(self) -> bool:
        """Whether the vehicle follows a client's attitude setpoint."""
        return isinstance(self.setpoint, AttitudeSetpoint) and self.setpoint is not self._level

    @property
    def follows_velocity(self) -> bool:
        """Whether the vehicle follows a setpoint with a velocity or an acceleration, which a client
        must repeat."""
        if not isinstance(self.setpoint, MotionSetpoint):
            return False
        rates = (*self.setpoint.velocity_ned_mps, *self.setpoint.acceleration_ned_mps2)
        return not all(map(math.isnan, rates))

    @property
    def hold_ned_m(self) -> Triple:
        """The place that the vehicle holds."""
        return self.hold.position_ned_m

    def hold_at(self, place_ned_m: Triple, yaw_rad: float) -> None:
        """Hold a place that a client names. With a NaN yaw the nose points in the direction of
        flight."""
        self.hold = MotionSetpoint(place_ned_m, yaw_rad=yaw_rad, faces_way=True)
        if self.behaviour is Behaviour.SETPOINT:
            self.follow(self.hold)

    def turn_to(self, yaw_rad: float, turn_radps: float, sense: float) -> None:
        """Turn to this yaw and keep it while the vehicle holds a place or follows a setpoint.
        `sense` is as in `MotionSetpoint.turn_sense`."""
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

    def stopping_place_ned_m(self, estimate: StateEstimate) -> Triple:
        """Place at which the vehicle stops if it brakes now."""
        (x, y, z), (vx, vy, vz) = estimate.position_ned_m, estimate.velocity_ned_mps
        role = self.parameters.role
        braking_s = math.hypot(vx, vy) / max(role("stopping_mps2"), 0.1)
        lasts_s = role("stopping_delay_s") + 0.5 * braking_s
        return (x + lasts_s * vx, y + lasts_s * vy, z + 0.2 * vz)


def _kind(setpoint: Setpoint | None) -> tuple[bool, ...]:
    """Kind of a setpoint: whether there is one, or which of position and velocity it demands."""
    if not isinstance(setpoint, MotionSetpoint):
        return (setpoint is not None,)
    given = (setpoint.position_ned_m, setpoint.velocity_ned_mps)
    return tuple(not math.isnan(vector[0]) for vector in given)
