"""Stick input of ArduCopter: default RC channels, and channels that a client overrides.

It converts pulse widths to demanded velocities and rates. Knows no modes and no vehicle.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

KEEP, RELEASE = 65535, 0  # RC_CHANNELS_OVERRIDE: do not change this channel, end its override
OVERRIDE_S = 3.0  # RC_OVERRIDE_TIME
_CENTRE_US, _RANGE_US = 1500, 500
_PERIOD_MIN_S, _PERIOD_MAX_S = 1e-3, 0.1  # limits of the time between two `demand`s
_THROTTLE_DEAD_ZONE_US = 100  # THR_DZ
# Channels of SITL without RC: roll, pitch, throttle (down), yaw, mode switch (5) and others
_DEFAULT_US = (1500, 1500, 1000, 1500, 1800, 1000, 1000, 1800)
_CLIMB_MPS = 2.5  # PILOT_SPEED_UP, also of the descent with the throttle down
_TURN_RADPS = math.radians(202.5)  # PILOT_Y_RATE
_SPEED_MPS = 12.5  # LOIT_SPEED
_ACCELERATION_MPS2 = 3.57  # g times tangent of two thirds of ANGLE_MAX
_BRAKING_MPS2, _BRAKING_AFTER_S = 2.5, 1.0  # with centred sticks: LOIT_BRK_ACCEL, LOIT_BRK_DELAY
Pair = tuple[float, float]


class Sticks:
    """RC channels of one vehicle; times are seconds since boot."""

    def __init__(self) -> None:
        self._overridden: dict[int, tuple[int, float]] = {}  # channel -> pulse width, end time
        self._velocity_mps = (0.0, 0.0)  # demanded: north, east
        self._called_s = self._deflected_s = math.nan  # last `demand`, and last with a deflection

    def override(self, pulses_us: Sequence[int], now_s: float) -> None:
        """Apply RC_CHANNELS_OVERRIDE; `pulses_us` begins with the first channel."""
        for channel, pulse_us in enumerate(pulses_us[: len(_DEFAULT_US)]):
            if pulse_us == RELEASE:
                self._overridden.pop(channel, None)
            elif pulse_us != KEEP:
                self._overridden[channel] = (pulse_us, now_s + OVERRIDE_S)

    def pulses_us(self, now_s: float) -> tuple[int, ...]:
        """Return the pulse widths of all channels."""
        return tuple(
            self._overridden[channel][0]
            if now_s < self._overridden.get(channel, (0, -math.inf))[1]
            else default_us
            for channel, default_us in enumerate(_DEFAULT_US)
        )

    def begin(self) -> None:
        """Begin a mode flown by sticks, with zero demanded velocity."""
        self._velocity_mps, self._called_s = (0.0, 0.0), math.nan

    def demand(self, now_s: float, yaw_rad: float) -> tuple[Pair, Pair, float, float]:
        """Return demanded velocity and acceleration (north, east), climb rate and yaw rate; SI.

        The stick deflection accelerates the velocity against a drag, which limits it to LOIT_SPEED.
        """
        roll, pitch, throttle, yaw = self.pulses_us(now_s)[:4]
        forward, right = -_deflection(pitch), _deflection(roll)
        duration_s = min(_PERIOD_MAX_S, max(0.0, now_s - self._called_s))
        self._called_s = now_s
        if forward or right:
            self._deflected_s = now_s
        cos, sin = math.cos(yaw_rad), math.sin(yaw_rad)
        before = self._velocity_mps
        self._accelerate((cos * forward - sin * right, sin * forward + cos * right), duration_s)
        changes = zip(self._velocity_mps, before, strict=True)
        north, east = ((after - first) / max(duration_s, _PERIOD_MIN_S) for after, first in changes)
        climb_mps = _CLIMB_MPS * _deflection(throttle, _THROTTLE_DEAD_ZONE_US)
        return self._velocity_mps, (north, east), climb_mps, _TURN_RADPS * _deflection(yaw)

    def _accelerate(self, deflection: Pair, duration_s: float) -> None:
        drag_ps = _ACCELERATION_MPS2 / _SPEED_MPS
        north, east = (
            speed + duration_s * (_ACCELERATION_MPS2 * share - drag_ps * speed)
            for speed, share in zip(self._velocity_mps, deflection, strict=True)
        )
        speed = math.hypot(north, east)
        if speed > 0.0 and self._called_s - self._deflected_s > _BRAKING_AFTER_S:
            factor = max(0.0, speed - _BRAKING_MPS2 * duration_s) / speed
            north, east = factor * north, factor * east
        self._velocity_mps = (north, east)


def _deflection(pulse_us: int, dead_zone_us: int = 20) -> float:
    """Stick deflection, -1 .. 1, with a dead zone (RCx_DZ)."""
    offset_us = min(_RANGE_US, max(-_RANGE_US, pulse_us - _CENTRE_US))
    share = max(0, abs(offset_us) - dead_zone_us) / (_RANGE_US - dead_zone_us)
    return math.copysign(share, offset_us)
