"""Whether the vehicle stands on the ground, as an autopilot finds out: by thrust and standstill.

It believes its estimates, so a wandering one delays it. First the ground is felt (`contact`, and
the motors idle), then it counts as `landed`. Knows no modes and no MAVLink.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from simulator.autopilot.nav import Nav
from simulator.autopilot.parameters import ParameterTable
from simulator.firmware.base import Landing

AIRBORNE_S = 0.1
_SMOOTHING_S = 0.2
_LANDED_LENIENCY = 2.5  # of the limits, once landed


@dataclass(slots=True)
class LandDetector:
    """`landing` is the firmware's way of it."""

    landing: Landing
    parameters: ParameterTable
    landed: bool = True
    _contact_s: float = 0.0
    _still_s: float = 0.0
    _air_s: float = 0.0
    _sinking_mps: float = 0.0  # the estimated velocity, smoothed
    _slope_mps: float = 0.0  # of the estimated height, smoothed
    _down_m: float = math.nan

    @property
    def contact(self) -> bool:
        """The ground is felt: no thrust is needed any more."""
        return self._contact_s >= self.parameters.role("contact_s")

    def stand(self) -> None:
        """Disarmed on the ground."""
        self.rest()
        self.landed, self._air_s = True, 0.0

    def lift_off(self) -> None:
        """In the air by decree."""
        self.rest()
        self.landed = False

    def rest(self) -> None:
        """In the air, where nothing can be felt."""
        self._contact_s = self._still_s = self._sinking_mps = self._slope_mps = 0.0
        self._down_m = math.nan

    def step(
        self, period_s: float, nav: Nav, thrust: float, *, by_motion: bool, sinks: bool
    ) -> None:
        """One period. `by_motion`: the vertical loop makes the thrust, and is told to sink."""
        self._air_s = 0.0 if nav.on_ground else self._air_s + period_s
        if not (nav.on_ground or self.landed):
            self.rest()
            return
        self._smooth(period_s, nav)
        least = self.parameters.role("thrust_least" if by_motion else "stick_thrust_least")
        span = self.parameters.role("hover_thrust") - least
        low = thrust <= least + self.landing.low_thrust_share * span
        descends = sinks or not by_motion or self.landed or self._still_s > 0.0
        stands = nav.on_ground and low and descends and not self._moves(nav)
        self._contact_s = self._contact_s + period_s if stands else 0.0
        idle = thrust <= least + self.landing.idle_thrust_share * span
        rests = self.contact and idle and not self._turns(nav)
        self._still_s = self._still_s + period_s if rests else 0.0
        if self.landed:
            self.landed = self._air_s < AIRBORNE_S and idle
        else:
            self.landed = self._still_s >= self.parameters.role("settled_s")

    def _smooth(self, period_s: float, nav: Nav) -> None:
        down_m, velocity_mps = nav.position_ned_m[2], nav.velocity_ned_mps[2]
        share = period_s / (_SMOOTHING_S + period_s)
        slope_mps = 0.0 if math.isnan(self._down_m) else (down_m - self._down_m) / period_s
        self._down_m = down_m
        self._sinking_mps += share * (velocity_mps - self._sinking_mps)
        self._slope_mps += share * (slope_mps - self._slope_mps)

    def _moves(self, nav: Nav) -> bool:
        limit = _LANDED_LENIENCY if self.landed else 1.0
        north, east, _ = nav.velocity_ned_mps
        vertical_mps = min(abs(self._sinking_mps), abs(self._slope_mps))
        return (
            vertical_mps > limit * self.landing.speed_down_mps
            or math.hypot(north, east) > self.landing.speed_across_mps
        )

    def _turns(self, nav: Nav) -> bool:
        limit = _LANDED_LENIENCY if self.landed else 1.0
        p, q, _ = nav.rates_frd_radps
        return math.hypot(p, q) > limit * self.landing.rate_radps
