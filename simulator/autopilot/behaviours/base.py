"""The interface of a behaviour: what the vehicle does in a mode, from `enter` to `leave`.

A behaviour demands a motion in each period and answers a few questions about itself. The defaults
are those of automatic flight that starts in the air and does not end by itself.
"""

from __future__ import annotations

import math
from enum import Enum
from typing import ClassVar

from simulator.autopilot.guidance import Guidance
from simulator.autopilot.state import StateEstimate
from simulator.autopilot.trajectory import Leg
from simulator.firmware.values import Behaviour, MotionSetpoint, Triple


class Control(Enum):
    """What the pilot controls."""

    MOTION = "the motion that the behaviour demands"
    LEVEL = "level attitude at the least throttle of the sticks"
    UNCHANGED = "the last demand stays in force"


class ActiveBehaviour:
    """One behaviour; a new object each time that its mode is entered."""

    control: ClassVar[Control] = Control.MOTION
    lifts_off: ClassVar[bool] = False  # may leave the ground
    planned: ClassVar[bool] = True  # flown along the firmware's trajectory, if it plans one
    continues: ClassVar[bool] = False  # a request for its mode does not start it again
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

    def leg(self, cruise_mps: float, height_m: float) -> Leg:
        """Leg that the trajectory flies, at this speed and this height above home."""
        return Leg(cruise_mps, takeoff=self.climbing, height_m=height_m)

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
