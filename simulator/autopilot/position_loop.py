"""The autopilot's own position loop: a motion demanded -> attitude and thrust.

What is demanded, its limits and the gains, handed to the law (`simulator.autopilot.position_law`).
Knows no modes.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from offboard.model.kernel import address
from simulator.autopilot.position_law import RECORD, step_loop
from simulator.firmware.flight import PositionGains
from simulator.firmware.setpoints import MotionSetpoint
from simulator.firmware.vocabulary import NAN3, Quaternion, Triple
from simulator.steps import LOOP_S

_AT_REST = (0.0,) * 6 + NAN3  # integrals, filtered derivative and velocity of the last period


@dataclass(frozen=True, slots=True)
class Limits:
    """Within which a motion is flown; the speeds lower the limits of the gains."""

    hover_thrust: float  # normalised, believed to hover
    thrust_least: float = 0.0
    across_mps: float = math.inf
    up_mps: float = math.inf  # below 0 it is a descent
    down_mps: float = math.nan  # in place of the gains', whatever theirs
    turn_radps: float = math.inf
    gently: bool = False  # as automatic flight speeds up and brakes


class PositionLoop:
    """Loop with its integrators."""

    def __init__(self, gains: PositionGains) -> None:
        self.record = np.zeros(1, RECORD)
        self.address = address(self.record)
        self.tune(gains)
        self._estimate = self.record["estimate"][0]
        self._state = self.record["state"][0]
        self._demand: MotionSetpoint | None = None
        self.record["period_s"] = LOOP_S
        self.reset(0.0)

    @property
    def yaw_rad(self) -> float:
        """The course that it flies."""
        return float(self.record["course_rad"][0])

    def tune(self, gains: PositionGains) -> None:
        """Other gains from now on."""
        self.gains = gains
        across = (gains.position_xy_ps, *gains.velocity_xy)
        up = (gains.position_z_ps, *gains.velocity_z)
        self.record["gains"] = (*across, *across, *up, gains.derivative_cutoff_hz)
        self.record["tilt_max_rad"] = gains.tilt_max_rad
        self.record["thrust_max"] = gains.thrust_max
        self.record["facing_mps"] = gains.facing_mps
        self.record["speeding_mps2"] = gains.speeding_mps2
        self.record["braking_mps2"] = gains.braking_mps2

    def reset(self, yaw_rad: float) -> None:
        """Forget integrators and derivative; hold the present course."""
        self._state[:] = _AT_REST
        self.record["course_rad"] = yaw_rad
        self.record["across_mps"] = math.nan

    def demand(self, motion: MotionSetpoint, limits: Limits, *, integrate: bool = True) -> None:
        """What to fly from now on; `integrate` False freezes the integrators."""
        record, gains = self.record, self.gains
        if motion is not self._demand:
            self._demand = motion
            record["position"] = motion.position_ned_m
            record["velocity"] = motion.velocity_ned_mps
            record["acceleration"] = motion.acceleration_ned_mps2
            record["yaw_rad"] = motion.yaw_rad
            record["yaw_rate_radps"] = motion.yaw_rate_radps
            record["faces_way"] = motion.faces_way
        record["speed_xy_mps"] = min(limits.across_mps, gains.speed_xy_mps)
        record["speed_up_mps"] = min(limits.up_mps, gains.speed_up_mps)
        own = math.isnan(limits.down_mps)
        record["speed_down_mps"] = gains.speed_down_mps if own else limits.down_mps
        record["hover_thrust"] = limits.hover_thrust
        record["thrust_least"] = limits.thrust_least
        record["turn_radps"] = limits.turn_radps
        record["gently"] = limits.gently
        record["integrates"] = integrate

    def step(
        self, position_ned_m: Triple, velocity_ned_mps: Triple
    ) -> tuple[Quaternion, float, Triple]:
        """One period of LOOP_S on this estimate. Attitude (wxyz), normalised thrust and the
        velocity (NED, m/s) that it tries to fly."""
        self._estimate[:] = (*position_ned_m, *velocity_ned_mps)
        step_loop.call(self.address)
        return self.result

    @property
    def result(self) -> tuple[Quaternion, float, Triple]:
        """What the last step gave, as `step` returns it."""
        record = self.record
        attitude, wanted = record["attitude"][0].tolist(), record["wanted_velocity"][0].tolist()
        return tuple(attitude), float(record["thrust"][0]), tuple(wanted)
