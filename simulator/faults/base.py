"""What every fault has: when it begins, how long it lasts, and an effect on the vehicle.

An effect is a generator: it begins, then yields until its end. Each yield returns True at a step of
the vehicle, the step of its beginning among them, and False when the fault ends.
`simulator.faults.injection` begins and ends them.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Generator
from dataclasses import dataclass, field
from enum import StrEnum
from random import Random
from typing import Annotated, Protocol

from pydantic import AfterValidator, Field

from offboard.documents.parameters import Parameters
from simulator.autopilot.autopilot import Autopilot
from simulator.firmware.catalogue import FIRMWARES
from simulator.link.impairment import Channel
from simulator.mavlink.codec import id_of
from simulator.mavlink.server import Server
from simulator.mavlink.view import View

Effect = Generator[None, bool, None]


def _known(name: str) -> str:
    if id_of(name) is None:
        raise ValueError(f"{name[:40]!r} is not a MAVLink message")
    return name


def _flown(name: str) -> str:
    if all(firmware.mode_named(name) is None for firmware in FIRMWARES.values()):
        raise ValueError(f"{name[:40]!r} is not a mode of any firmware")
    return name


MessageName = Annotated[str, AfterValidator(_known)]
ModeName = Annotated[str, AfterValidator(_flown)]  # "AUTO." may be left out


class Moment(StrEnum):
    """Event from which the time of a fault counts: its first occurrence."""

    BOOT = "boot"
    ARMED = "armed"
    TOOK_OFF = "took_off"
    ENGAGED = "engaged"  # the vehicle obeys setpoints
    LANDING = "landing"  # in the air, in the final descent of a landing
    LANDED = "landed"  # after a flight


class Direction(StrEnum):
    """Direction of a link seen from the vehicle: telemetry is down, commands are up."""

    DOWN = "down"
    UP = "up"
    BOTH = "both"


class Vehicle(Protocol):
    """What faults act on."""

    autopilot: Autopilot
    view: View
    companion: Server

    def reboot(self, silent_s: float) -> None: ...


class Timed(Parameters):
    """A fault: when it begins and how long it lasts, seconds of vehicle time; None: for good."""

    at_s: float = Field(default=0.0, ge=0, le=1e5)
    after: Moment = Moment.BOOT
    for_s: float | None = Field(default=None, gt=0, le=1e5)

    @abstractmethod
    def effect(self, vehicle: Vehicle, running: Running) -> Effect:
        """What it does to the vehicle, from its beginning to its end."""


@dataclass(slots=True)
class Running:
    """One fault of a flight and its progress."""

    fault: Timed
    channels: list[Channel]  # of a link fault
    random: Random
    datagrams: list[bytes] = field(default_factory=list)  # of a stranger, to be sent
    begins_s: float | None = None  # None until the event that starts its delay
    effect: Effect | None = None  # once it has begun
    over: bool = False


def until_the_end() -> Effect:
    """Wait for the end of the fault."""
    while (yield):
        pass
