"""What outlives a change of mode: home, the place to hold, the setpoint in force, the speed limit.

Every behaviour (`simulator.autopilot.behaviours`) reads and changes this one value. NED, SI.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

from simulator.autopilot.mission import Mission
from simulator.autopilot.nav import Nav
from simulator.autopilot.parameters import ParameterTable
from simulator.autopilot.sticks import Sticks
from simulator.autopilot.trajectory import Trajectory
from simulator.firmware.base import Firmware
from simulator.firmware.values import AttitudeSetpoint, MotionSetpoint, Triple

ORIGIN: Triple = (0.0, 0.0, 0.0)


@dataclass(slots=True)
class Guidance:
    """Guidance state of one autopilot.

    `setpoint` is the newest setpoint of a client; `cruise_mps` the horizontal speed that was asked
    for in automatic flight, inf if none was; `events` are reported to the commander each step.
    `trajectory` is None for a firmware that plans none (ArduCopter), `sticks` for one whose sticks
    are not simulated (PX4).
    """

    firmware: Firmware
    parameters: ParameterTable
    mission: Mission
    sticks: Sticks | None = None
    trajectory: Trajectory | None = field(init=False, default=None)
    setpoint: AttitudeSetpoint | MotionSetpoint | None = None
    home_ned_m: Triple = ORIGIN
    home_yaw_rad: float = 0.0
    hold_ned_m: Triple = ORIGIN
    cruise_mps: float = math.inf
    events: list[str] = field(init=False)
    _held: MotionSetpoint = field(default_factory=lambda: MotionSetpoint(ORIGIN))

    def __post_init__(self) -> None:
        limits = self.firmware.flight.path_limits
        if limits is not None:
            self.trajectory = Trajectory(limits, self.parameters)
        self.events = self.mission.events

    @property
    def held(self) -> MotionSetpoint:
        """The setpoint that holds `hold_ned_m`; the same object while the place stays the same."""
        if self._held.position_ned_m is not self.hold_ned_m:
            self._held = MotionSetpoint(self.hold_ned_m)
        return self._held

    @property
    def holds_named_place(self) -> bool:
        """A client named the place to hold (`hold_at`)."""
        return self._held.faces_way and self._held.position_ned_m is self.hold_ned_m

    @property
    def setpoint_is_held(self) -> bool:
        """The setpoint in force is the one of `hold_at`."""
        return self.setpoint is self._held

    def hold_at(self, place_ned_m: Triple, yaw_rad: float) -> MotionSetpoint:
        """Hold this place; a NaN yaw faces the way there. Returns the setpoint that does so."""
        self.hold_ned_m = place_ned_m
        self._held = MotionSetpoint(place_ned_m, yaw_rad=yaw_rad, faces_way=True)
        return self._held

    def turn_to(self, yaw_rad: float, turn_radps: float) -> None:
        """Keep this yaw while holding a place or flying a setpoint."""
        self._held = MotionSetpoint(self.hold_ned_m, yaw_rad=yaw_rad, turn_radps=turn_radps)
        if isinstance(self.setpoint, MotionSetpoint):
            self.setpoint = replace(self.setpoint, yaw_rad=yaw_rad, turn_radps=turn_radps)

    def stopping_place_ned_m(self, nav: Nav) -> Triple:
        """Where the vehicle comes to rest when it brakes gently from here."""
        if self.trajectory is not None:
            return self.trajectory.stop_ned_m(nav)
        (x, y, z), (vx, vy, vz) = nav.position_ned_m, nav.velocity_ned_mps
        return (x + 0.5 * vx, y + 0.5 * vy, z + 0.2 * vz)
