"""Stick input: RC channels that a client overrides (RC_CHANNELS_OVERRIDE, MANUAL_CONTROL), and the
default ones of ArduCopter's SITL. It converts pulse widths to demanded velocities and rates. Knows
no modes and no vehicle.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

KEEP, RELEASE = 65535, 0  # RC_CHANNELS_OVERRIDE: do not change this channel, end its override
CENTRE_US = 1500
_RANGE_US = 500
_STICKS = 4  # the first channels: roll, pitch, throttle, yaw
_PERIOD_MIN_S, _PERIOD_MAX_S = 1e-3, 0.1  # limits of the time between two `demand`s
# PX4: low-pass of the speed of a stick, and the speed above which it counts as moved, in halves of
# its range per second (COM_RC_STICK_OV)
_SPEED_FILTER_S, _MOVED_PS = 0.1, 0.3
Pair = tuple[float, float]


class Sticks:
    """RC channels of one vehicle; times are seconds since boot.

    `role` returns values of the firmware (`Firmware.parameter_roles`). `default_us` are the pulse
    widths of channels that no client overrides; 0 is a channel without input.
    """

    def __init__(self, role: Callable[[str], float], default_us: Sequence[int]) -> None:
        self._role, self._default_us = role, default_us
        self._overridden: dict[int, tuple[int, float]] = {}  # channel -> pulse width, its time
        self._speeds_ps = [0.0] * _STICKS  # filtered speeds of the sticks
        self._velocity_mps = (0.0, 0.0)  # demanded: north, east
        self._called_s = self._deflected_s = math.nan  # last `demand`, and last with a deflection

    def override(self, pulses_us: Sequence[int], now_s: float) -> bool:
        """Apply the pulse widths of a message, which begin with the first channel. Returns whether
        a stick is moving."""
        for channel, pulse_us in enumerate(pulses_us[: len(self._default_us)]):
            if pulse_us == RELEASE:
                self._overridden.pop(channel, None)
            elif pulse_us != KEEP:
                if channel < _STICKS:
                    self._measure_speed(channel, pulse_us, now_s)
                self._overridden[channel] = (pulse_us, now_s)
        return any(abs(speed_ps) > _MOVED_PS for speed_ps in self._speeds_ps)

    def _measure_speed(self, channel: int, pulse_us: int, now_s: float) -> None:
        before_us, before_s = self._overridden.get(channel, (pulse_us, now_s))
        passed_s = max(_PERIOD_MIN_S, now_s - before_s)
        speed_ps = (pulse_us - before_us) / _RANGE_US / passed_s
        share = passed_s / (passed_s + _SPEED_FILTER_S)
        self._speeds_ps[channel] += share * (speed_ps - self._speeds_ps[channel])

    def pulses_us(self, now_s: float) -> tuple[int, ...]:
        """Return the pulse widths of all channels."""
        since_s = now_s - self._role("stick_timeout_s")
        widths = list(self._default_us)
        for channel, (pulse_us, at_s) in self._overridden.items():
            if at_s > since_s:
                widths[channel] = pulse_us
        return tuple(widths)

    def present(self, now_s: float) -> bool:
        """Whether all sticks have input."""
        return all(self.pulses_us(now_s)[:_STICKS])

    def throttle_raised(self, now_s: float) -> bool:
        """Whether the throttle is more than a fifth above its centre."""
        return self.pulses_us(now_s)[2] > CENTRE_US + 0.2 * _RANGE_US

    def begin(self) -> None:
        """Begin a mode flown by sticks, with zero demanded velocity."""
        self._velocity_mps, self._called_s = (0.0, 0.0), math.nan

    def demand(self, now_s: float, yaw_rad: float) -> tuple[Pair, Pair, float, float]:
        """Return demanded velocity and acceleration (north, east), climb rate and yaw rate; SI.

        The stick deflection accelerates the velocity against a drag, which limits its speed.
        """
        role = self._role
        roll, pitch, throttle, yaw = self.pulses_us(now_s)[:_STICKS]
        dead_us = role("stick_dead_zone_us")
        forward, right = -self._deflection(pitch, dead_us), self._deflection(roll, dead_us)
        duration_s = min(_PERIOD_MAX_S, max(0.0, now_s - self._called_s))
        self._called_s = now_s
        if forward or right:
            self._deflected_s = now_s
        cos, sin = math.cos(yaw_rad), math.sin(yaw_rad)
        before = self._velocity_mps
        self._accelerate((cos * forward - sin * right, sin * forward + cos * right), duration_s)
        changes = zip(self._velocity_mps, before, strict=True)
        north, east = ((after - first) / max(duration_s, _PERIOD_MIN_S) for after, first in changes)
        climb = self._deflection(throttle, role("throttle_dead_zone_us"))
        climb_mps = climb * role("stick_climb_mps" if climb > 0.0 else "stick_sink_mps")
        turn_radps = role("stick_turn_radps") * self._deflection(yaw, dead_us)
        return self._velocity_mps, (north, east), climb_mps, turn_radps

    def _accelerate(self, deflection: Pair, duration_s: float) -> None:
        role = self._role
        acceleration_mps2 = role("stick_acceleration_mps2")
        drag_ps = acceleration_mps2 / max(role("stick_speed_mps"), 1e-3)
        north, east = (
            speed + duration_s * (acceleration_mps2 * share - drag_ps * speed)
            for speed, share in zip(self._velocity_mps, deflection, strict=True)
        )
        speed = math.hypot(north, east)
        if speed > 0.0 and self._called_s - self._deflected_s > role("stick_brakes_after_s"):
            factor = max(0.0, speed - role("stick_braking_mps2") * duration_s) / speed
            north, east = factor * north, factor * east
        self._velocity_mps = (north, east)

    def _deflection(self, pulse_us: int, dead_zone_us: float) -> float:
        """Stick deflection, -1 .. 1, with a dead zone (RCx_DZ, MPC_HOLD_DZ), smaller near the
        centre (MPC_XY_MAN_EXPO)."""
        offset_us = min(_RANGE_US, max(-_RANGE_US, pulse_us - CENTRE_US))
        share = max(0.0, abs(offset_us) - dead_zone_us) / max(1.0, _RANGE_US - dead_zone_us)
        bend = self._role("stick_expo")
        return math.copysign((1.0 - bend) * share + bend * share**3, offset_us)
