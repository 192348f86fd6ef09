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
    capacity_ah: float = Field(default=5.0, ge=0.01, le=200)
    hover_current_a: float = Field(default=12.0, ge=0, le=500)
    resistance_ohm: float = Field(default=0.02, ge=0, le=1)
    remaining: float = Field(default=1.0, ge=0, le=1)  # at boot

    def state(self, drawn_as: float, hover_share: float) -> BatteryState:
        """State after consuming `drawn_as` (A s), at this multiple of the hover thrust."""
        left = self.remaining - drawn_as / (3600.0 * self.capacity_ah)
        current = self.hover_current_a * hover_share**1.5
        voltage = self.cells * (3.5 + 0.7 * left) - self.resistance_ohm * current
        return BatteryState(max(voltage, 0.0), current, max(left, 0.0), drawn_as / 3.6)

    def drawn_as(self, remaining: float) -> float:
        """Charge consumed (A s) when this share remains."""
        return 3600.0 * self.capacity_ah * (self.remaining - remaining)


@dataclass(frozen=True, slots=True)
class BatteryState:
    """Values of a battery monitor; `remaining` 0..1."""

    voltage_v: float
    current_a: float
    remaining: float
    used_mah: float  # since boot
