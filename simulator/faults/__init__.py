"""Faults of a flight, part of a scenario file: what goes wrong, when, and for how long.

One class is one fault: its keys, and what it does to the vehicle. A new one is listed in `Fault`.
"""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from simulator.faults.fault import Direction
from simulator.faults.link import (
    ClockJump,
    LinkFault,
    SecondSender,
    SecondVehicle,
    SilentMessage,
    Stranger,
    StuckMessage,
)
from simulator.faults.vehicle import (
    BatteryDrop,
    BlindLandDetector,
    EstimatorJump,
    GpsLoss,
    MassChange,
    MotorsCut,
    PilotDisarms,
    PilotTakesOver,
    Reboot,
    Refusal,
    ThrustChange,
    VelocityError,
    WeakMotor,
    WrongLandedState,
)

__all__ = ["Direction", "Fault", "GpsLoss", "PilotTakesOver", "Stranger", "VelocityError"]

Fault = Annotated[
    LinkFault
    | EstimatorJump
    | GpsLoss
    | SilentMessage
    | StuckMessage
    | VelocityError
    | WrongLandedState
    | BlindLandDetector
    | WeakMotor
    | MotorsCut
    | ThrustChange
    | MassChange
    | BatteryDrop
    | Reboot
    | ClockJump
    | Refusal
    | PilotTakesOver
    | PilotDisarms
    | SecondSender
    | SecondVehicle
    | Stranger,
    Field(discriminator="fault"),
]
