"""The pilot's sticks: what the firmware feigns, and who overrides them for a while.

Pulse widths in, shares of a stick's way and speeds out. Knows no modes and no vehicle.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from simulator.firmware.base import StickFlight

KEEP, GIVE_BACK = 65535, 0  # RC_CHANNELS_OVERRIDE: this channel is left alone, or given back
OVERRIDE_S = 3.0  # RC_OVERRIDE_TIME
_MIDDLE_US, _HALF_WAY_US = 1500, 500
_LEAST_S, _LONGEST_S = 1e-3, 0.1  # between two looks at them
Pair = tuple[float, float]
_DEAD_US, _DEAD_THROTTLE = 20, 0.2  # about the middle: RCx_DZ; THR_DZ


class Sticks:
    """Channels as they are now; time is an argument, vehicle seconds."""

    def __init__(self, handling: StickFlight) -> None:
        self.handling = handling
        self._overridden: dict[int, tuple[int, float]] = {}  # channel -> pulse width, until
        self._velocity = (0.0, 0.0)  # ahead and aside, m/s, as a course of 0 has them
        self._newest_s = self._asked_s = math.nan  # looked at; asking to move

    def override(self, widths_us: Sequence[int], now_s: float) -> None:
        """RC_CHANNELS_OVERRIDE, from the first channel on."""
        for channel, width_us in enumerate(widths_us[: len(self.handling.default_pulses_us)]):
            if width_us == GIVE_BACK:
                self._overridden.pop(channel, None)
            elif width_us != KEEP:
                self._overridden[channel] = (width_us, now_s + OVERRIDE_S)

    def widths_us(self, now_s: float) -> tuple[int, ...]:
        """Of all channels."""
        return tuple(
            self._overridden[channel][0]
            if now_s < self._overridden.get(channel, (0, -math.inf))[1]
            else feigned
            for channel, feigned in enumerate(self.handling.default_pulses_us)
        )

    def begin(self) -> None:
        """The vehicle comes under the sticks; it is not moving by them yet."""
        self._velocity, self._newest_s = (0.0, 0.0), math.nan

    def ask(self, now_s: float, course_rad: float) -> tuple[Pair, Pair, float, float]:
        """Velocity and acceleration north and east, climb, turn rate that they ask for now,
        heading so; SI."""
        roll, pitch, throttle, yaw = self.widths_us(now_s)[:4]
        ahead, aside = -_share(pitch), _share(roll)
        handling = self.handling
        duration_s = min(_LONGEST_S, max(0.0, now_s - self._newest_s))
        self._newest_s = now_s
        if ahead or aside:
            self._asked_s = now_s
        cos, sin = math.cos(course_rad), math.sin(course_rad)
        asked = (cos * ahead - sin * aside, sin * ahead + cos * aside)
        before = self._velocity
        self._move(asked, duration_s)
        changes = zip(self._velocity, before, strict=True)
        north, east = ((now - was) / max(duration_s, _LEAST_S) for now, was in changes)
        climb_mps = handling.climb_mps * _climb_share(throttle)
        return self._velocity, (north, east), climb_mps, handling.turn_radps * _share(yaw)

    def _move(self, asked: Pair, duration_s: float) -> None:
        """Accelerate as asked, against a drag that stops it at the greatest speed."""
        handling = self.handling
        drag_ps = handling.acceleration_mps2 / handling.speed_mps
        moved = [
            speed + duration_s * (handling.acceleration_mps2 * share - drag_ps * speed)
            for speed, share in zip(self._velocity, asked, strict=True)
        ]
        speed = math.hypot(*moved)
        if speed > 0.0 and self._newest_s - self._asked_s > handling.braking_after_s:
            left = max(0.0, speed - handling.braking_mps2 * duration_s) / speed
            moved = [left * value for value in moved]
        self._velocity = (moved[0], moved[1])


def _share(width_us: int) -> float:
    """-1 .. 1 of a stick that springs back, 0 about the middle."""
    off_us = min(_HALF_WAY_US, max(-_HALF_WAY_US, width_us - _MIDDLE_US))
    beyond_us = max(0, abs(off_us) - _DEAD_US) / (_HALF_WAY_US - _DEAD_US)
    return math.copysign(beyond_us, off_us)


def _climb_share(width_us: int) -> float:
    """-1 .. 1 of the throttle's way."""
    off = min(1.0, max(-1.0, (width_us - _MIDDLE_US) / _HALF_WAY_US))
    return math.copysign(max(0.0, abs(off) - _DEAD_THROTTLE) / (1.0 - _DEAD_THROTTLE), off)
