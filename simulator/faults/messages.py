"""Faults of the companion link and of what the vehicle sends on it."""

from __future__ import annotations

from typing import Literal

from pydantic import Field, model_validator

from simulator.faults.fault import (
    Direction,
    Effect,
    MessageName,
    Running,
    Timed,
    Vehicle,
    until_the_end,
)
from simulator.link.impairment import Impairment
from simulator.mavlink.codec import fields_of
from simulator.mavlink.view import Stuck


class LinkFault(Timed, Impairment):
    """A bad companion link; each direction by itself, so `both` doubles the round trip.

    It does not apply to the TIMESYNC exchange of lockstep, which is the simulation's clock.
    """

    fault: Literal["link"]
    direction: Direction = Direction.BOTH

    @model_validator(mode="after")
    def _ends(self) -> LinkFault:
        if self.stalled and self.for_s is None:
            raise ValueError("a stalled link needs for_s: what waits arrives when the fault ends")
        return self

    @property
    def impaired(self) -> tuple[Direction, ...]:
        """Directions of the link that it impairs."""
        both = (Direction.DOWN, Direction.UP)
        return both if self.direction is Direction.BOTH else (self.direction,)

    def effect(self, vehicle: Vehicle, running: Running) -> Effect:
        for channel in running.channels:
            channel.on = True
        yield from until_the_end()
        for channel in running.channels:
            channel.on = False


class SilentMessage(Timed):
    """A message that is no longer sent, on any link; with `every`, every so many are still sent."""

    fault: Literal["silent_message"]
    message: MessageName
    every: int | None = Field(default=None, ge=2, le=1000)

    def effect(self, vehicle: Vehicle, running: Running) -> Effect:
        vehicle.view.silent[self.message] = self.every or 0
        yield from until_the_end()
        vehicle.view.silent.pop(self.message, None)


class StuckMessage(Timed):
    """A message that repeats its content, or only some of its `fields`; with `stamp_runs` its time
    stamp increases."""

    fault: Literal["stuck_message"]
    message: MessageName
    fields: tuple[str, ...] = ()
    stamp_runs: bool = True

    @model_validator(mode="after")
    def _has_fields(self) -> StuckMessage:
        known = fields_of(self.message)
        if unknown := [each for each in self.fields if each not in known]:
            raise ValueError(f"{self.message} has no field {unknown[0]}; it has {', '.join(known)}")
        return self

    def effect(self, vehicle: Vehicle, running: Running) -> Effect:
        known = fields_of(self.message)
        # the first field of telemetry is its time stamp
        stuck = self.fields or known[1 if self.stamp_runs else 0 :]
        vehicle.view.stuck[self.message] = Stuck([known.index(each) for each in stuck])
        yield from until_the_end()
        vehicle.view.stuck.pop(self.message, None)


class ClockJump(Timed):
    """All time stamps of the vehicle jump by `jump_s`."""

    fault: Literal["clock_jump"]
    jump_s: float = Field(ge=-1e7, le=1e7)

    def effect(self, vehicle: Vehicle, running: Running) -> Effect:
        jump_us = round(self.jump_s * 1e6)
        vehicle.view.clock_offset_us += jump_us
        yield from until_the_end()
        vehicle.view.clock_offset_us -= jump_us
