"""The base class of faults, with time and duration, and `Injection`, which begins and ends the
faults of a flight.

The effect of a fault is a generator. It is advanced when the fault begins and then yields until it
ends. `yield` returns True at each step of the vehicle, including the step at which the fault
begins, and False when the fault ends.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Generator, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Annotated, Protocol

from pydantic import AfterValidator, Field

from offboard.documents.parameters import Parameters
from simulator.autopilot.autopilot import Autopilot
from simulator.autopilot.values import Behaviour
from simulator.firmware import FIRMWARES
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
    """Event from whose first occurrence the time of a fault counts."""

    BOOT = "boot"
    ARMED = "armed"
    TOOK_OFF = "took_off"
    ENGAGED = "engaged"  # the vehicle obeys setpoints
    LANDING = "landing"  # in the air, in the final descent of a landing
    LANDED = "landed"  # after a flight


class Vehicle(Protocol):
    """The part of `simulator.instance.Instance` that faults use."""

    autopilot: Autopilot
    view: View
    companion: Server
    down: list[Channel]  # link faults of telemetry on the companion link
    up: list[Channel]  # link faults of what the companion sends

    def reboot(self, silent_s: float) -> None: ...


class Timed(Parameters):
    """A fault that begins `at_s` after the event `after` and lasts `for_s` (None: for good)."""

    at_s: float = Field(default=0.0, ge=0, le=1e5)
    after: Moment = Moment.BOOT
    for_s: float | None = Field(default=None, gt=0, le=1e5)

    @abstractmethod
    def effect(self, vehicle: Vehicle, running: Running) -> Effect:
        """Change the vehicle when the fault begins, at each step, and when it ends."""


@dataclass(slots=True)
class Running:
    """One fault of a flight and its progress."""

    fault: Timed
    seed: str  # seed of its random numbers
    datagrams: list[bytes] = field(default_factory=list)  # that a `Stranger` is to send
    begins_s: float | None = None  # None until the event from which its time counts
    effect: Effect | None = None  # None until it begins


def until_the_end() -> Effect:
    """Wait until the fault ends."""
    while (yield):
        pass


class Injection:
    """The faults of one flight; `unfinished` are those that have not begun or not ended."""

    def __init__(self, faults: Sequence[Timed], seed: int) -> None:
        self.unfinished = [Running(fault, f"{seed} {at}") for at, fault in enumerate(faults)]
        self._moments: dict[Moment, float] = {}
        self._flown = False

    def step(self, now_s: float, vehicle: Vehicle) -> None:
        """Begin, advance and end faults at `now_s`, seconds since the links opened."""
        self._note_moments(now_s, vehicle.autopilot)
        self.unfinished = [
            one for one in self.unfinished if self._goes_on(one, now_s + 1e-6, vehicle)
        ]

    def _note_moments(self, now_s: float, autopilot: Autopilot) -> None:
        landed = autopilot.position_controller.landed
        self._flown = self._flown or not landed
        by_setpoint = autopilot.commander.mode.behaviour is Behaviour.SETPOINT
        for moment, reached in (
            (Moment.BOOT, True),
            (Moment.ARMED, autopilot.commander.armed),
            (Moment.TOOK_OFF, not landed),
            (Moment.ENGAGED, by_setpoint and autopilot.commander.armed),
            (Moment.LANDING, autopilot.guidance.active.landing and not landed),
            (Moment.LANDED, self._flown and landed),
        ):
            if reached:
                self._moments.setdefault(moment, now_s)

    def _goes_on(self, running: Running, now_s: float, vehicle: Vehicle) -> bool:
        """Advance one fault; return False when it is over."""
        fault = running.fault
        if running.begins_s is None:
            since_s = self._moments.get(fault.after)
            if since_s is None:
                return True
            running.begins_s = since_s + fault.at_s
        if now_s < running.begins_s:
            return True
        try:
            if running.effect is None:
                running.effect = fault.effect(vehicle, running)
                next(running.effect)
            lasts = fault.for_s is None or now_s < running.begins_s + fault.for_s
            running.effect.send(lasts)
        except StopIteration:
            return False
        return True
