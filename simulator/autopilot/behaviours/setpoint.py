"""Setpoint: follow the newest setpoint of a client (PX4 OFFBOARD, ArduCopter GUIDED)."""

from __future__ import annotations

from simulator.autopilot.behaviours.base import ActiveBehaviour
from simulator.autopilot.nav import Nav
from simulator.firmware.values import MotionSetpoint


class FollowSetpoint(ActiveBehaviour):
    """The motion setpoint in force, or hold where there is none. The pilot flies an attitude
    setpoint without asking for a motion."""

    lifts_off = True
    planned = False
    goes_on = True

    def motion(self, nav: Nav, time_s: float, *, landed: bool) -> MotionSetpoint:
        setpoint = self.guidance.setpoint
        return setpoint if isinstance(setpoint, MotionSetpoint) else self.guidance.held

    @property
    def automatic(self) -> bool:
        return self.guidance.firmware.setpoints.as_automatic
