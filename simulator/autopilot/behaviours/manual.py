"""Modes flown by sticks alone: no position is controlled."""

from __future__ import annotations

from simulator.autopilot.behaviours.base import ActiveBehaviour, Control


class LevelAtLeastThrottle(ActiveBehaviour):
    """ArduCopter STABILIZE: level, with the throttle stick down."""

    control = Control.LEVEL
    planned = False


class LastDemand(ActiveBehaviour):
    """PX4 STABILIZED without sticks: the last demand stays in force."""

    control = Control.UNCHANGED
    planned = False
