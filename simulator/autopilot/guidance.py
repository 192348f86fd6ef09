"""Guidance state: what outlives a change of mode.

Every behaviour (`simulator.autopilot.behaviours`) reads and changes this one value. NED, SI.
"""

from __future__ import annotations

import math
from dataclasses import replace

from simulator.autopilot.mission import Mission
from simulator.autopilot.parameters import ParameterTable
from simulator.autopilot.state import StateEstimate
from simulator.autopilot.sticks import Sticks
from simulator.firmware.base import Firmware
from simulator.firmware.values import AttitudeSetpoint, MotionSetpoint, Triple

ORIGIN: Triple = (0.0, 0.0, 0.0)


class Guidance:
    """Home, the place to hold, the setpoint in force and the speed limit of one autopilot.

    `sticks` is None for a firmware whose sticks are not simulated (PX4). `events` are reported to
    the commander at each step.
    """

    def __init__(self, firmware: Firmware, parameters: ParameterTable, mission: Mission) -> None:
        self.firmware, self.parameters, self.mission = firmware, parameters, mission
        self.events = mission.events
        sticks = firmware.sticks
        self.sticks = None if sticks is None else Sticks(sticks)
        self.setpoint: AttitudeSetpoint | MotionSetpoint | None = None  # the newest of a client
        self.hold = MotionSetpoint(ORIGIN)
        self.home_ned_m = ORIGIN
        self.home_yaw_rad = 0.0
        self.cruise_mps = math.inf  # requested for automatic flight; inf: none

    @property
    def hold_ned_m(self) -> Triple:
        """The place to hold."""
        return self.hold.position_ned_m

    def hold_at(self, place_ned_m: Triple, yaw_rad: float) -> None:
        """Hold a place that a client names; a NaN yaw faces the direction of flight."""
        self.hold = MotionSetpoint(place_ned_m, yaw_rad=yaw_rad, faces_way=True)

    def turn_to(self, yaw_rad: float, turn_radps: float) -> None:
        """Keep this yaw while holding a place or following a setpoint."""
        self.hold = MotionSetpoint(self.hold_ned_m, yaw_rad=yaw_rad, turn_radps=turn_radps)
        if isinstance(self.setpoint, MotionSetpoint):
            self.setpoint = replace(self.setpoint, yaw_rad=yaw_rad, turn_radps=turn_radps)

    def stopping_place_ned_m(self, estimate: StateEstimate) -> Triple:
        """Where the vehicle stops when it brakes now."""
        (x, y, z), (vx, vy, vz) = estimate.position_ned_m, estimate.velocity_ned_mps
        return (x + 0.5 * vx, y + 0.5 * vy, z + 0.2 * vz)
