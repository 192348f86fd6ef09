"""Leaving the ground and reaching it: the takeoff ramp and the land detector.

Both know time, thrust and parameters; neither knows a mode.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from simulator.autopilot.parameters import ParameterTable
from simulator.autopilot.state import StateEstimate
from simulator.geodesy import GRAVITY_MPS2
from simulator.steps import LOOP_S

_AIRBORNE_S = 0.1  # off the ground until it is no longer landed
_SMOOTHING_S = 0.2
_LANDED_FACTOR = 2.5  # by which the limits are wider once landed


@dataclass(slots=True)
class TakeoffRamp:
    """The motors spool up, then the allowed climb rate rises until the vehicle lifts off.

    The ramp begins at the climb rate for which the position loop demands no thrust.
    """

    parameters: ParameterTable
    flying: bool = False  # in the air, the ramp has ended
    _spool_left_s: float = 0.0
    _ramp_s: float = 0.0

    @property
    def spooling(self) -> bool:
        return self._spool_left_s > 0.0

    @property
    def lifting(self) -> bool:
        """On the ramp, on the ground or just off it."""
        return not self.flying and self._ramp_s > 0.0

    def arm(self) -> None:
        """The motors start."""
        self.land()
        self._spool_left_s = self.parameters.role("spool_up_s")

    def land(self) -> None:
        """On the ground with the motors running."""
        self._ramp_s, self.flying = 0.0, False

    def skip(self) -> None:
        """The vehicle is in the air without a ramp."""
        self._spool_left_s, self.flying = 0.0, True

    @property
    def ramp_ended(self) -> bool:
        """The allowed climb rate has its final value; a heavy vehicle may still stand."""
        return self._ramp_s >= self.parameters.role("takeoff_ramp_s")

    def step(self, *, climb_demanded: bool, landed: bool) -> None:
        """One period of LOOP_S."""
        if self.spooling:
            self._spool_left_s -= LOOP_S
        elif not self.flying and (climb_demanded or self._ramp_s > 0.0):
            self._ramp_s += LOOP_S
            self.flying = self.ramp_ended and not landed
            if self.ramp_ended and landed and not climb_demanded:
                self.land()

    def climb_limit_mps(self) -> float:
        """Allowed climb rate; negative, a descent, at first."""
        if self.flying:
            return math.inf
        role = self.parameters.role
        start_mps = -GRAVITY_MPS2 / role("velocity_z_p")
        share = min(1.0, self._ramp_s / max(role("takeoff_ramp_s"), 1e-3))
        return start_mps + share * (role("ramp_ends_mps") - start_mps)


@dataclass(slots=True)
class LandDetector:
    """Land detector: low thrust and no motion are ground contact, and later a landing.

    It uses the estimate, so a drifting one delays it. With ground contact the motors idle.
    """

    parameters: ParameterTable
    landed: bool = True
    _contact_s: float = 0.0  # how long there is contact, no motion, no ground
    _still_s: float = 0.0
    _air_s: float = 0.0
    _velocity_mps: float = 0.0  # down, estimated, smoothed
    _slope_mps: float = 0.0  # of the estimated height, smoothed
    _down_m: float = math.nan

    @property
    def contact(self) -> bool:
        """The vehicle touches the ground and needs no thrust."""
        return self._contact_s >= self.parameters.role("contact_s")

    def set_landed(self, landed: bool) -> None:
        """Landed or not, whatever was detected."""
        self.reset()
        self.landed, self._air_s = landed, 0.0

    def reset(self) -> None:
        """No ground contact."""
        self._contact_s = self._still_s = self._velocity_mps = self._slope_mps = 0.0
        self._down_m = math.nan

    def step(
        self, estimate: StateEstimate, thrust: float, *, by_motion: bool, descends: bool
    ) -> None:
        """One period of LOOP_S. `by_motion`: the vertical loop makes the thrust; `descends`: it
        has a demand to descend."""
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
