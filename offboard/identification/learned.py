"""What an earlier flight has identified of a vehicle, to begin the next flight with."""

from __future__ import annotations

from dataclasses import dataclass

from offboard.identification.uncertainty import Estimate
from offboard.model.vehicle import Vehicle


@dataclass(frozen=True, slots=True)
class Learned:
    """`vehicle` with the identified constants, whose delays contain the link's delay of then,
    `link_s` (telemetry and setpoint together; 0 if it was not measured). `delay` is the delay of
    the tilt and its standard deviation, s."""

    vehicle: Vehicle
    delay: Estimate
    link_s: float
