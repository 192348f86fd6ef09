"""Faults of a flight, part of a scenario file: what goes wrong, when, and for how long.

One class is one fault: its keys, and what it does to the vehicle. A new one is listed in `Fault`.
"""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from simulator.faults import link, vehicle

Fault = Annotated[
    link.LinkFault
    | vehicle.EstimatorJump
    | vehicle.GpsLoss
    | link.SilentMessage
    | link.StuckMessage
    | vehicle.VelocityError
    | vehicle.WrongLandedState
    | vehicle.BlindLandDetector
    | vehicle.MotorsCut
    | vehicle.ThrustChange
    | vehicle.MassChange
    | vehicle.BatteryDrop
    | vehicle.Reboot
    | link.ClockJump
    | vehicle.Refusal
    | vehicle.PilotTakesOver
    | vehicle.PilotDisarms
    | link.SecondSender
    | link.SecondVehicle
    | link.Stranger,
    Field(discriminator="fault"),
]
