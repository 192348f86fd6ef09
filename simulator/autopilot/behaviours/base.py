"""The interface of a behaviour: what the vehicle does in a mode, from `enter` to `left`.

A behaviour says where the vehicle is to be (`motion`) and answers a few questions about itself; the
defaults here are those of a behaviour that flies by itself, in the air, and never ends.
"""

from __future__ import annotations

import math
from enum import Enum
from typing import ClassVar

from simulator.autopilot.guidance import Guidance
from simulator.autopilot.nav import Nav
from simulator.autopilot.trajectory import Leg
from simulator.firmware.values import NAN3, Behaviour, MotionSetpoint, Triple


class Control(Enum):
    """What the pilot controls."""

    MOTION = "the motion that the behaviour demands"
    LEVEL = "level attitude at the least thrust of the sticks"
    UNCHANGED = "the last demand stays in force"


class ActiveBehaviour:
    """One behaviour, made anew each time that its mode is entered."""

    control: ClassVar[Control] = Control.MOTION
    lifts_off: ClassVar[bool] = False  # may leave the ground
    planned: ClassVar[bool] = True  # flown along the firmware's trajectory, if it plans one
    goes_on: ClassVar[bool] = False  # its mode asked for again does not begin it again
    cannot_climb = False  # a takeoff whose target is not above the vehicle

    def __init__(self, guidance: Guidance) -> None:
        self.guidance = guidance

    def enter(self, nav: Nav, place_ned_m: Triple = NAN3) -> None:
        """Begin here. `place_ned_m`: where a takeoff is to climb to, NaN where it was not said."""

    def left(self) -> None:
        """Another behaviour begins."""

    def motion(self, nav: Nav, time_s: float, *, landed: bool) -> MotionSetpoint:
        """Where the vehicle is to be now; by default at the place to hold. Vehicle time."""
        return self.guidance.held

    def leg(self, cruise_mps: float, height_m: float) -> Leg:
        """The leg that the trajectory flies, at this speed and this height above home."""
        return Leg(cruise_mps, takeoff=self.climbing, height_m=height_m)

    def keeps_place(self, following: Behaviour) -> bool:
        """Whether the behaviour that follows holds the same place, not where it stops."""
        return False

    @property
    def events(self) -> tuple[str, ...]:
        """Events in force, reported to the commander each step."""
        return ()

    @property
    def landing(self) -> bool:
        """On the last descent."""
        return False

    @property
    def climbing(self) -> bool:
        """Taking off by itself."""
        return False

    @property
    def speed_mps(self) -> float:
        """Horizontal speed limit of its own."""
        return math.inf

    @property
    def automatic(self) -> bool:
        """Speeds and turn rates are those of automatic flight."""
        return True

    @property
    def target_ned_m(self) -> Triple:
        """The place that it holds or climbs to."""
        return self.guidance.hold_ned_m
