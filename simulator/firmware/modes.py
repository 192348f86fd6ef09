"""Flight modes, what the vehicle does in them, and what a heartbeat shows of it.

Which there are is the firmware's; what a behaviour flies, `simulator.autopilot.navigator`'s.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

from simulator.firmware.setpoints import AttitudeSetpoint, MotionSetpoint


class Behaviour(Enum):
    """What the vehicle does in a mode."""

    HOLD = "holds position"
    TAKEOFF = "climbs to the takeoff height"
    LAND = "descends where it is and lands"
    RETURN = "flies home and lands"
    MISSION = "flies the mission"
    DESCEND = "sinks slowly, as sticks that are not there ask for"
    LEVEL = "level, least throttle: sticks that are down"
    COAST = "goes on as last demanded: sticks that are not there"
    SETPOINT = "obeys setpoints"


@dataclass(frozen=True, slots=True)
class Mode:
    """One flight mode. `base_mode`: MAV_MODE_FLAG bits without the armed bit."""

    name: str
    title: str  # in texts
    custom_mode: int
    base_mode: int
    behaviour: Behaviour
    arms: bool = True  # the vehicle may be armed in it
    remembered: bool = True  # comes back after an automatic disarm
    needs_sticks: bool = False
    needs_position: bool = False


@dataclass(frozen=True, slots=True)
class Condition:
    """What a heartbeat depends on."""

    mode: Mode
    reached: frozenset[str]  # boot events so far
    armed: bool
    landed: bool
    healthy: bool
    failsafe: bool
    faulty: bool
    setpoint: AttitudeSetpoint | MotionSetpoint | None  # in force
