"""Conditions of a flight: estimator, air, battery, and differences between vehicle and model.

Part of a scenario file. By default there is no wind, and vehicle and model are equal.
"""

from __future__ import annotations

from dataclasses import dataclass

from pydantic import Field

from offboard.documents.parameters import Parameters
from offboard.model.vehicle import Triple
from simulator.vehicle.sensors import EstimatorName, WhiteNoise
from simulator.vehicle.wind import Gusts


class Battery(Parameters):
    """Lithium battery. Its open-circuit voltage is linear in the remaining charge, also below zero;
    the internal resistance lowers it. `simulator.vehicle.airframe` integrates the charge."""

    cells: int = Field(default=4, ge=1, le=16)
    capacity_ah: float = Field(default=5.0, ge=0.01, le=200)
    hover_current_a: float = Field(default=12.0, ge=0, le=500)
    resistance_ohm: float = Field(default=0.02, ge=0, le=1)
    remaining: float = Field(default=1.0, ge=0, le=1)  # share of the capacity at boot

    def state(self, drawn_as: float, hover_share: float) -> BatteryState:
        """State after `drawn_as` (A s) were consumed, at this multiple of the hover thrust."""
        left = self.remaining - drawn_as / (3600.0 * self.capacity_ah)
        current = self.hover_current_a * hover_share**1.5
        voltage = self.cells * (3.5 + 0.7 * left) - self.resistance_ohm * current
        return BatteryState(max(voltage, 0.0), current, max(left, 0.0), drawn_as / 3.6)

    def drawn_as(self, remaining: float) -> float:
        """Consumed charge (A s) when this share of the capacity remains."""
        return 3600.0 * self.capacity_ah * (self.remaining - remaining)


@dataclass(frozen=True, slots=True)
class BatteryState:
    """Values of a battery monitor; `remaining` is 0 .. 1."""

    voltage_v: float
    current_a: float
    remaining: float
    used_mah: float  # since boot


class Conditions(Parameters):
    """Conditions of a flight that the controller does not know."""

    estimator: EstimatorName = EstimatorName.PERFECT
    white_noise: WhiteNoise = WhiteNoise()  # used by the estimator `white` only
    wind_ned_mps: Triple = (0.0, 0.0, 0.0)  # velocity of the air: where the wind blows to
    gusts: Gusts = Gusts()
    thrust_scale: float = Field(default=1.0, ge=0.1, le=3)  # 0.85: 15 % less than the model
    mass_scale: float = Field(default=1.0, ge=0.1, le=5)
    # for each body axis by itself, q |u| u in addition to the vehicle's linear drag, as in
    # Frame::calculate_forces of ArduPilot's SITL
    quadratic_drag_npmps2: float = Field(default=0.0, ge=0, le=1)
    battery: Battery = Battery()
    # vehicle clock at the start; its 32-bit milliseconds wrap at 4294967.296 s
    clock_start_s: float = Field(default=0.0, ge=0, le=1e8)
    clock_rate: float = Field(default=1.0, ge=0.9, le=1.1)  # seconds of its clock per second
    boot_scale: float = Field(default=1.0, ge=0.02, le=10)  # factor on the times of boot events
