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
        raise ValueError(f"{name[:40]!r} is not a MAVLink message")
    return name


MessageName = Annotated[str, AfterValidator(_known)]


class Moment(StrEnum):
    """Event from which the time of a fault counts: its first occurrence."""

    BOOT = "boot"
    ARMED = "armed"
    TOOK_OFF = "took_off"
    ENGAGED = "engaged"  # the vehicle obeys setpoints
    LANDED = "landed"  # after a flight


class Direction(StrEnum):
    """Direction of a link seen from the vehicle: telemetry is down, commands are up."""

    DOWN = "down"
    UP = "up"
    BOTH = "both"


class Refusable(StrEnum):
    """Requests that a fault can make the autopilot refuse."""

    ARM = "arm"
    OFFBOARD = "offboard"
    TAKEOFF = "takeoff"


class Timed(Parameters):
    """When a fault begins and how long it lasts, seconds of vehicle time; None: for good."""

    at_s: float = Field(default=0.0, ge=0, le=1e5)
    after: Moment = Moment.BOOT
    for_s: float | None = Field(default=None, gt=0, le=1e5)


class LinkFault(Timed, Impairment):
    """A bad companion link; each direction by itself, so `both` doubles the round trip.

    It does not apply to the TIMESYNC exchange of lockstep, which is the simulation's clock.
    """

    fault: Literal["link"]
    direction: Direction = Direction.BOTH


class EstimatorJump(Timed):
    """The position estimate jumps, and its reset counter increases."""

    fault: Literal["estimator_jump"]
    offset_ned_m: Triple


class GpsLoss(Timed):
    """No GPS fix: the position estimate drifts to the north-east, and jumps back with the fix."""

    fault: Literal["gps_loss"]
    drift_mps: float = Field(default=0.0, ge=0, le=10)


class SilentMessage(Timed):
    """A message that is no longer sent periodically, on any link."""

    fault: Literal["silent_message"]
    message: MessageName


class StuckMessage(Timed):
    """A message that repeats its content; with `stamp_runs` its time stamp increases."""

    fault: Literal["stuck_message"]
    message: MessageName
    stamp_runs: bool = True


class WeakMotor(Timed):
    """One of four motors has `motor_scale` of its thrust; the mixer keeps the torques."""

    fault: Literal["weak_motor"]
    motor_scale: float = Field(ge=0, le=1)


class ThrustChange(Timed):
    """Thrust of all motors multiplied by `thrust_scale`."""

    fault: Literal["thrust_change"]
    thrust_scale: float = Field(ge=0.1, le=3)


class MassChange(Timed):
    """A load picked up or dropped: mass multiplied by `mass_scale`."""

    fault: Literal["mass_change"]
    mass_scale: float = Field(ge=0.2, le=5)


class BatteryDrop(Timed):
    """The charge of the battery drops to `remaining` of its capacity, permanently."""

    fault: Literal["battery_drop"]
    remaining: float = Field(ge=0, le=1)


class Reboot(Timed):
    """The autopilot restarts, disarmed, with its time from zero, after `for_s` of silence."""

    fault: Literal["reboot"]
    for_s: float = Field(default=2.0, gt=0, le=60)


class ClockJump(Timed):
    """All time stamps of the vehicle jump by `jump_s`."""

    fault: Literal["clock_jump"]
    jump_s: float = Field(ge=-1e4, le=1e4)


class Refusal(Timed):
    """The autopilot refuses a request, with a text."""

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
