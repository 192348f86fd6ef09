"""Battery: voltage, current and remaining charge, as a battery monitor measures them.

The airframe (`simulator.vehicle.airframe`) integrates the charge consumed.
"""

from __future__ import annotations

from dataclasses import dataclass

from pydantic import Field

from offboard.documents.parameters import Parameters


class Battery(Parameters):
    """Lithium battery: open-circuit voltage linear in the remaining charge, also below zero, minus
    the drop at the internal resistance."""

    cells: int = Field(default=4, ge=1, le=16)
    capacity_ah: float = Field(default=5.0, gt=0.01, le=200)
    hover_current_a: float = Field(default=12.0, ge=0, le=500)
    resistance_ohm: float = Field(default=0.02, ge=0, le=1)
    remaining: float = Field(default=1.0, ge=0, le=1)  # at boot


@dataclass(frozen=True, slots=True)
class BatteryState:
    """Values of a battery monitor; `remaining` 0..1."""

    voltage_v: float
    current_a: float
    remaining: float
    used_mah: float  # since boot


@dataclass(frozen=True, slots=True)
class Pack:
    """Battery of a vehicle that hovers at this normalised thrust."""

    battery: Battery
    hover_thrust: float

    def state(self, drawn_as: float, thrust: float) -> BatteryState:
        """State after consuming `drawn_as` (A s), at this normalised thrust."""
        battery = self.battery
        left = battery.remaining - drawn_as / (3600.0 * battery.capacity_ah)
        current = battery.hover_current_a * (thrust / self.hover_thrust) ** 1.5
        voltage = battery.cells * (3.5 + 0.7 * left) - battery.resistance_ohm * current
        return BatteryState(max(voltage, 0.0), current, max(left, 0.0), drawn_as / 3.6)

    def drawn_as(self, remaining: float) -> float:
        """Charge consumed (A s) when this share remains."""
        return 3600.0 * self.battery.capacity_ah * (self.battery.remaining - remaining)
