"""The takeoff ramp and the land detector.

Both know time, thrust and parameters; neither knows a mode.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from simulator.autopilot.parameters import ParameterTable
from simulator.autopilot.state import StateEstimate
from simulator.geodesy import GRAVITY_MPS2
from simulator.steps import LOOP_S

_AIRBORNE_S = 0.1  # time off the ground after which the vehicle is no longer landed
_SMOOTHING_S = 0.2  # time constant of the low-pass of the vertical speed
_LANDED_FACTOR = 2.5  # factor on the motion limits while landed


@dataclass(slots=True)
class TakeoffRamp:
    """Takeoff ramp: the motors spool up, then the limit of the climb rate increases.

    The ramp begins at the climb rate for which the position loop demands no thrust.
    """

    parameters: ParameterTable
    flying: bool = False  # whether the vehicle is in the air and the ramp has ended
    _spool_left_s: float = 0.0
    _ramp_s: float = 0.0

    @property
    def spooling(self) -> bool:
        return self._spool_left_s > 0.0

    @property
    def lifting(self) -> bool:
        """Whether the ramp runs, with the vehicle on the ground or just above it."""
        return not self.flying and self._ramp_s > 0.0

    def arm(self) -> None:
        """Begin to spool up the motors."""
        self.land()
        self._spool_left_s = self.parameters.role("spool_up_s")

    def land(self) -> None:
        """Reset the ramp: the vehicle is on the ground with the motors running."""
        self._ramp_s, self.flying = 0.0, False

    def skip(self) -> None:
        """End spool-up and ramp: the vehicle is in the air already."""
        self._spool_left_s, self.flying = 0.0, True

    @property
    def ramp_ended(self) -> bool:
        """Whether the limit of the climb rate has its final value; a heavy vehicle may still be on
        the ground then."""
        return self._ramp_s >= self.parameters.role("takeoff_ramp_s")

    def step(self, *, climb_demanded: bool, landed: bool) -> None:
        """Advance by one period of LOOP_S."""
        if self.spooling:
            self._spool_left_s -= LOOP_S
        elif not self.flying and (climb_demanded or self._ramp_s > 0.0):
            self._ramp_s += LOOP_S
            self.flying = self.ramp_ended and not landed
            if self.ramp_ended and landed and not climb_demanded:
                self.land()

    def climb_limit_mps(self) -> float:
        """Limit of the climb rate; at first it is negative, a descent."""
        if self.flying:
            return math.inf
        role = self.parameters.role
        start_mps = -GRAVITY_MPS2 / role("velocity_z_p")
        share = min(1.0, self._ramp_s / max(role("takeoff_ramp_s"), 1e-3))
        return start_mps + share * (role("ramp_ends_mps") - start_mps)


@dataclass(slots=True)
class LandDetector:
    """Land detector: low thrust without motion is ground contact; with idle thrust and without
    rotation, lasting contact is a landing.

    It uses the estimate, so a drifting estimate delays it. With ground contact the position
    controller lets the motors idle.
    """

    parameters: ParameterTable
    landed: bool = True
    _contact_s: float = 0.0  # duration of low thrust on the ground without motion
    _still_s: float = 0.0  # duration of contact with idle thrust and without rotation
    _air_s: float = 0.0  # time off the ground
    _velocity_mps: float = 0.0  # estimated velocity down, smoothed
    _slope_mps: float = 0.0  # derivative of the estimated position down, smoothed
    _down_m: float = math.nan

    @property
    def contact(self) -> bool:
        """Whether ground contact is detected."""
        return self._contact_s >= self.parameters.role("contact_s")

    def set_landed(self, landed: bool) -> None:
        """Set the landed state, whatever was detected before."""
        self.reset()
        self.landed, self._air_s = landed, 0.0

    def reset(self) -> None:
        """Forget the ground contact."""
        self._contact_s = self._still_s = self._velocity_mps = self._slope_mps = 0.0
        self._down_m = math.nan

    def step(
        self, estimate: StateEstimate, thrust: float, *, by_motion: bool, descends: bool
    ) -> None:
        """Advance by one period of LOOP_S. `by_motion`: whether the position loop, not an attitude
        setpoint, demands the thrust. `descends`: whether a descent is demanded."""
        self._air_s = 0.0 if estimate.on_ground else self._air_s + LOOP_S
        if not (estimate.on_ground or self.landed):
            self.reset()
            return
        self._smooth(estimate)
        role = self.parameters.role
        least = role("thrust_least" if by_motion else "stick_thrust_least")
        span = role("hover_thrust") - least
        low = thrust <= least + role("low_thrust_share") * span
        may_land = descends or not by_motion or self.landed or self._still_s > 0.0
        stands = estimate.on_ground and low and may_land and not self._moves(estimate)
        self._contact_s = self._contact_s + LOOP_S if stands else 0.0
        idle = thrust <= least + role("idle_thrust_share") * span
        still = self.contact and idle and not self._rotates(estimate)
        self._still_s = self._still_s + LOOP_S if still else 0.0
        if self.landed:
            self.landed = self._air_s < _AIRBORNE_S and idle
        else:
            self.landed = self._still_s >= role("settled_s")

    def _smooth(self, estimate: StateEstimate) -> None:
        down_m, velocity_mps = estimate.position_ned_m[2], estimate.velocity_ned_mps[2]
        share = LOOP_S / (_SMOOTHING_S + LOOP_S)
        slope_mps = 0.0 if math.isnan(self._down_m) else (down_m - self._down_m) / LOOP_S
        self._down_m = down_m
        self._velocity_mps += share * (velocity_mps - self._velocity_mps)
        self._slope_mps += share * (slope_mps - self._slope_mps)

    @property
    def _factor(self) -> float:
        return _LANDED_FACTOR if self.landed else 1.0

    def _moves(self, estimate: StateEstimate) -> bool:
        role = self.parameters.role
        north, east, _ = estimate.velocity_ned_mps
        vertical_mps = min(abs(self._velocity_mps), abs(self._slope_mps))
        return vertical_mps > self._factor * role("still_down_mps") or math.hypot(
            north, east
        ) > role("still_across_mps")

    def _rotates(self, estimate: StateEstimate) -> bool:
        p, q, _ = estimate.rates_frd_radps
        return math.hypot(p, q) > self._factor * self.parameters.role("still_radps")
