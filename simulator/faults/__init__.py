"""Faults of a flight, part of a scenario file: what goes wrong, when, and for how long.

One class is one fault: its keys, and what it does to the vehicle. A new one is listed in `Fault`.
"""

from __future__ import annotations

from collections.abc import Sequence
from random import Random
from typing import Annotated

from pydantic import Field

from simulator.faults import link, vehicle
from simulator.faults.fault import Injection, Running
from simulator.link.impairment import Channel

Fault = Annotated[
    link.LinkFault
    | vehicle.EstimatorJump
    | vehicle.GpsLoss
    | link.SilentMessage
    | link.StuckMessage
    | vehicle.VelocityError
    | vehicle.WrongLandedState
    | vehicle.BlindLandDetector
    | vehicle.WeakMotor
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


def prepare(scenario: Sequence[Fault], seed: int) -> Injection:
    """Faults of one flight, none begun."""
    paths: dict[str, list[Channel]] = {"down": [], "up": []}
    unfinished: list[Running] = []
    for number, fault in enumerate(scenario):
        channels = []
        for direction, path in paths.items():
            if isinstance(fault, link.LinkFault) and fault.direction in (direction, "both"):
                channels.append(Channel(fault, Random(f"{seed} {number} {direction}")))
                channels[-1].on = False
                path.append(channels[-1])
        unfinished.append(Running(fault, channels, Random(f"{seed} {number}")))
    strangers = [one.datagrams for one in unfinished if isinstance(one.fault, link.Stranger)]
    return Injection(paths["down"], paths["up"], strangers, unfinished)
