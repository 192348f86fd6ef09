"""Faults of a flight as data: what goes wrong, when, and for how long. Part of a scenario file.

A fault begins `at_s` after a moment of the flight and lasts `for_s`, or for good. What each one
does to the vehicle is in `simulator.injection`.
"""

from __future__ import annotations

from enum import StrEnum
from typing import Annotated, Literal

from pydantic import AfterValidator, Field

from offboard.documents.parameters import Parameters
from offboard.model.vehicle import Triple
from simulator.link.impairment import Impairment
from simulator.mavlink.codec import id_of


def _known(name: str) -> str:
    if id_of(name) is None:
        raise ValueError(f"{name[:40]!r} is no MAVLink message")
    return name


MessageName = Annotated[str, AfterValidator(_known)]


class Moment(StrEnum):
    """What a fault's time counts from; each counts from its first occurrence."""

    BOOT = "boot"
    ARMED = "armed"
    TOOK_OFF = "took_off"
    ENGAGED = "engaged"  # the vehicle obeys setpoints
    LANDED = "landed"  # after a flight


class Direction(StrEnum):
    """Of a link, seen from the vehicle: telemetry goes down, commands go up."""

    DOWN = "down"
    UP = "up"
    BOTH = "both"


class Refusable(StrEnum):
    """What an autopilot may be made to refuse."""

    ARM = "arm"
    OFFBOARD = "offboard"
    TAKEOFF = "takeoff"


class Timed(Parameters):
    """When a fault begins and how long it lasts, seconds of vehicle time; None: for good."""

    at_s: float = Field(default=0.0, ge=0, le=1e5)
    after: Moment = Moment.BOOT
    for_s: float | None = Field(default=None, gt=0, le=1e5)


class LinkFault(Timed, Impairment):
    """A bad companion link; each direction by itself, so `both` has twice the delay there and back.

    In lockstep the question for the time, which is the simulation's clock, is exempt.
    """

    fault: Literal["link"]
    direction: Direction = Direction.BOTH


class EstimatorJump(Timed):
    """The estimate of position jumps; the reset counter says so."""

    fault: Literal["estimator_jump"]
    offset_ned_m: Triple


class GpsLoss(Timed):
    """No fix; the estimate drifts to the north-east until the fix is back, then jumps back."""

    fault: Literal["gps_loss"]
    drift_mps: float = Field(default=0.0, ge=0, le=10)


class SilentMessage(Timed):
    """A message that is no longer sent by itself, on any link."""

    fault: Literal["silent_message"]
    message: MessageName


class StuckMessage(Timed):
    """A message that repeats its content; with `stamp_runs` its time stamp goes on."""

    fault: Literal["stuck_message"]
    message: MessageName
    stamp_runs: bool = True


class WeakMotor(Timed):
    """One of four motors gives `motor_scale` of its thrust; the mixer keeps the torques."""

    fault: Literal["weak_motor"]
    motor_scale: float = Field(ge=0, le=1)


class ThrustChange(Timed):
    """All thrust multiplied."""

    fault: Literal["thrust_change"]
    thrust_scale: float = Field(ge=0.1, le=3)


class MassChange(Timed):
    """A load picked up or dropped: the mass multiplied."""

    fault: Literal["mass_change"]
    mass_scale: float = Field(ge=0.2, le=5)


class BatteryDrop(Timed):
    """The battery has only this share left, for good."""

    fault: Literal["battery_drop"]
    remaining: float = Field(ge=0, le=1)


class Reboot(Timed):
    """The autopilot restarts: motors off, silence for `for_s`, time from zero, disarmed."""

    fault: Literal["reboot"]
    for_s: float = Field(default=2.0, gt=0, le=60)


class ClockJump(Timed):
    """Every time stamp jumps by this much."""

    fault: Literal["clock_jump"]
    jump_s: float = Field(ge=-1e4, le=1e4)


class Refusal(Timed):
    """The autopilot refuses, with a text."""

    fault: Literal["refusal"]
    of: Refusable
    text: str = Field(default="Resolve system health failures first", min_length=1, max_length=200)


class PilotTakesOver(Timed):
    """The pilot switches to the mode that holds position."""

    fault: Literal["pilot_takes_over"]


Fault = Annotated[
    LinkFault
    | EstimatorJump
    | GpsLoss
    | SilentMessage
    | StuckMessage
    | WeakMotor
    | ThrustChange
    | MassChange
    | BatteryDrop
    | Reboot
    | ClockJump
    | Refusal
    | PilotTakesOver,
    Field(discriminator="fault"),
]
