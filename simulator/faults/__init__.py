"""Faults of a flight, part of a scenario file: what goes wrong, when, and for how long.

Each class is a fault, with its keys and its effect on the vehicle. `Fault` lists all of them.
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
