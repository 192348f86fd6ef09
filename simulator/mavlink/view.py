"""Contents of all messages of one vehicle: values of its autopilot, faults that change telemetry,
and the conversion of SI values to message fields, which are scaled, rounded and limited.

Knows no links, rates or sequence numbers.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

from offboard.model.frames import rotation_from_quaternion
from simulator.autopilot.autopilot import Autopilot
from simulator.autopilot.values import Triple
from simulator.geodesy import GRAVITY_MPS2, to_degrees

_GPS, _RC, _PREARM = 0x20, 0x10000, 0x10000000  # MAV_SYS_STATUS_SENSOR


@dataclass(slots=True)
class Stuck:
    """A fault by which the fields of a message with these `indices` keep their values."""

    indices: Sequence[int]
    kept: Sequence[Any] | None = None

    def instead_of(self, values: Sequence[Any]) -> Sequence[Any]:
        kept = self.kept = self.kept or values
        return [kept[at] if at in self.indices else value for at, value in enumerate(values)]


@dataclass(slots=True)
class View:
    """Input of the message builders: the autopilot, and values that several messages need.

    `silent`: messages that a fault stops, each with a number n: each n-th is still sent (0: none).
    `stuck`: messages of which a fault freezes fields.
    """

    autopilot: Autopilot
    system: int
    epoch_us: int  # Unix time of boot
    builders: dict[str, Callable[[View], Sequence[Any]]]  # fields by message
    clock_rate: float = 1.0
    # Changed by faults
    clock_offset_us: int = 0
    silent: dict[str, int] = field(default_factory=dict)
    wrong_landed_state: int | None = None  # reported instead of the detected one
    stuck: dict[str, Stuck] = field(default_factory=dict)

    def withheld(self, name: str) -> bool:
        """Whether the vehicle cannot send this message yet, whatever its rate."""
        autopilot = self.autopilot
        event = autopilot.firmware.withheld_until.get(name)
        return event is not None and event not in autopilot.health.reached

    def fields(self, name: str) -> Sequence[Any]:
        """Return the present fields of message `name`."""
        values = self.builders[name](self)
        return self.stuck[name].instead_of(values) if name in self.stuck else values

    def heartbeat(self, base_mode: int, state: int) -> tuple[int, ...]:
        """Return the fields of HEARTBEAT of a quadrotor, with the armed bit. `state`: MAV_STATE."""
        commander, firmware = self.autopilot.commander, self.autopilot.firmware
        base_mode |= 128 if commander.armed else 0
        return (2, firmware.mav_autopilot, base_mode, commander.mode.custom_mode, state, 3)

    def restart(self, autopilot: Autopilot) -> None:
        """Show the autopilot after a reboot."""
        self.autopilot = autopilot
        self.clock_offset_us = 0

    @property
    def sensor_bits(self) -> tuple[int, int, int]:
        """MAV_SYS_STATUS_SENSOR: present, enabled, healthy."""
        autopilot = self.autopilot
        present, enabled, health = autopilot.firmware.sensor_bits
        if "fix" not in autopilot.health.reached:
            present, enabled, health = present & ~_GPS, enabled & ~_GPS, health & ~_GPS
        elif not autopilot.commander.has_fix:
            health &= ~_GPS
        if autopilot.commander.healthy:
            health |= _PREARM
        if not autopilot.health.sticks_lost:
            present, health = present | _RC, health | _RC
        return present, enabled, health

    @property
    def specific_force(self) -> Triple:
        """True specific force, FRD, m/s^2."""
        truth = self.autopilot.state.truth
        north, east, down = truth.acceleration_ned_mps2
        force_ned = (north, east, down - GRAVITY_MPS2)
        forward, right, down = (force_ned @ rotation_from_quaternion(truth.attitude)).tolist()
        return forward, right, down

    @property
    def scaled_imu(self) -> list[int]:
        """True specific force in mg and estimated rates in mrad/s, FRD."""
        per_mg, rates = GRAVITY_MPS2 * 1e-3, self.autopilot.state.estimate.rates_frd_radps
        force = (value / per_mg for value in self.specific_force)
        return [fit(value, 16) for value in (*force, *(rate * 1e3 for rate in rates))]

    @property
    def landed_state(self) -> int:
        """MAV_LANDED_STATE: 1 on ground, 2 in air, 3 taking off, 4 landing."""
        if self.wrong_landed_state is not None:
            return self.wrong_landed_state
        behaviour = self.autopilot.guidance.active
        if self.autopilot.position_controller.landed:
            return 1
        if behaviour.landing:
            return 4
        return 3 if behaviour.climbing else 2

    @property
    def time_ms(self) -> int:
        return self.time_us // 1000 & 0xFFFFFFFF

    @property
    def time_us(self) -> int:
        """Vehicle time in all time stamps: with the errors of its clock, microseconds."""
        return max(0, int(self.autopilot.state.time_us * self.clock_rate) + self.clock_offset_us)

    def geodetic(self, north_m: float, east_m: float) -> tuple[int, int]:
        """Latitude and longitude in 1e-7 deg of a point near the origin (spherical Earth)."""
        latitude, longitude = to_degrees(self.autopilot.firmware.origin, north_m, east_m)
        return fit(latitude * 1e7, 32), fit(longitude * 1e7, 32)

    def altitude_mm(self, down_m: float) -> int:
        """Height above mean sea level, mm."""
        return fit((self.autopilot.firmware.origin[2] - down_m) * 1e3, 32)


# -- fields --------------------------------------------------------------------------------

_RANGES = {
    (bits, signed): (-(1 << bits - 1), (1 << bits - 1) - 1) if signed else (0, (1 << bits) - 1)
    for bits in (8, 16, 32)
    for signed in (False, True)
}


def fit(value: float, bits: int, *, signed: bool = True) -> int:
    """`value`, rounded and limited to the range of an integer of `bits`; 0 if it is not finite."""
    if value - value != 0.0:  # infinite or not a number
        return 0
    low, high = _RANGES[bits, signed]
    return min(high, max(low, round(value)))


def centi(velocity: Triple) -> tuple[int, int, int]:
    """m/s -> cm/s, int16."""
    return fit(velocity[0] * 100, 16), fit(velocity[1] * 100, 16), fit(velocity[2] * 100, 16)


def heading_cdeg(yaw_rad: float) -> int:
    """Yaw -> centidegrees 0 .. 35999; 0 if it is not finite."""
    return fit(math.degrees(yaw_rad) * 100, 32) % 36000


def pressure_hpa(height_m: float) -> float:
    """Pressure of the standard atmosphere at this height above the sea; 0 above 44 km."""
    return 1013.25 * math.pow(max(0.0, 1.0 - 2.25577e-5 * height_m), 5.25588)
