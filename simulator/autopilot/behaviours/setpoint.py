"""Setpoint: follow the newest setpoint of a client (PX4 OFFBOARD, ArduCopter GUIDED)."""

from __future__ import annotations

from simulator.autopilot.behaviours.base import ActiveBehaviour
from simulator.autopilot.state import StateEstimate
from simulator.firmware.values import MotionSetpoint


class FollowSetpoint(ActiveBehaviour):
    """Follow a motion setpoint; hold where there is none. The pilot flies an attitude setpoint
    without asking for a motion."""

    lifts_off = True
    planned = False
    continues = True

    def motion(self, estimate: StateEstimate, *, landed: bool) -> MotionSetpoint:
        setpoint = self.guidance.setpoint
        if isinstance(setpoint, MotionSetpoint):
            self.cannot_climb = False
            return setpoint
        self.cannot_climb = landed  # it stands until somebody asks for a climb
        return self.guidance.hold

    @property
    def automatic(self) -> bool:
        return self.guidance.firmware.setpoints.as_automatic
