"""MAVLink commands (MAV_CMD): what each does, and how it is acknowledged.

A command's unused parameters may be NaN or 0. Every command to us is answered, unknown ones with
UNSUPPORTED. Knows one link (`Link`) and the autopilot behind it.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

from simulator.codec import name_of
from simulator.firmware.base import Result
from simulator.telemetry import BUILDERS, View

FORCE = 21196.0


@dataclass(frozen=True, slots=True)
class Command:
    number: int
    params: tuple[float, ...]  # param1 .. param7
    system: int  # of the sender
    component: int


class Link(Protocol):
    """What a command needs of the link it came by."""

    view: View

    def send(self, name: str, *values: object) -> None: ...
    def send_now(self, name: str) -> None: ...
    def set_interval(self, name: str, interval_us: float) -> bool: ...
    def interval_us(self, name: str) -> int: ...


@dataclass(slots=True)
class Commands:
    link: Link

    def run(self, command: Command) -> None:
        """Carry out and acknowledge, on the same link."""
        handler = HANDLERS.get(command.number)
        result = Result.UNSUPPORTED if handler is None else handler(self, command)
        self._acknowledge(command, result)

    def _acknowledge(self, command: Command, result: Result) -> None:
        self.link.send(
            "COMMAND_ACK", command.number, int(result), 0, 0, command.system, command.component
        )

    def _set_mode(self, command: Command) -> Result:
        autopilot = self.link.view.autopilot
        if autopilot.firmware.mode_acked_twice:
            self._acknowledge(command, Result.ACCEPTED)
        request = autopilot.firmware.command_mode(command.params)
        if request.mode is None:
            return request.refusal
        return autopilot.happen("mode", mode=request.mode)

    def _arm_disarm(self, command: Command) -> Result:
        wish, force = command.params[0], command.params[1]
        if wish not in (0.0, 1.0):
            return Result.UNSUPPORTED
        event = "arm" if wish == 1.0 else "disarm"
        return self.link.view.autopilot.happen(f"force {event}" if force == FORCE else event)

    def _takeoff(self, command: Command) -> Result:
        amsl_m = command.params[6]
        autopilot = self.link.view.autopilot
        above_m = amsl_m - autopilot.firmware.origin[2]
        known = math.isfinite(above_m) and above_m > -autopilot.pilot.home_ned_m[2]
        return autopilot.happen("takeoff", takeoff_z_m=-above_m if known else math.nan)

    def _land(self, _: Command) -> Result:
        return self.link.view.autopilot.happen("land")

    def _return(self, _: Command) -> Result:
        return self.link.view.autopilot.happen("return")

    def _set_interval(self, command: Command) -> Result:
        name = message_name(command.params[0])
        interval_us = command.params[1]
        if name is None or not math.isfinite(interval_us):
            return Result.FAILED
        return Result.ACCEPTED if self.link.set_interval(name, interval_us) else Result.FAILED

    def _get_interval(self, command: Command) -> Result:
        name = message_name(command.params[0])
        if name is None or name not in BUILDERS:
            return Result.DENIED
        number = int(command.params[0]) & 0xFFFF
        self.link.send("MESSAGE_INTERVAL", number, self.link.interval_us(name))
        return Result.ACCEPTED

    def _request_message(self, command: Command) -> Result:
        name = message_name(command.params[0])
        if name not in BUILDERS:
            return Result.DENIED
        self.link.send_now(name)
        return Result.ACCEPTED

    def _request_version(self, _: Command) -> Result:
        self.link.send_now("AUTOPILOT_VERSION")
        return Result.ACCEPTED

    def _request_home(self, _: Command) -> Result:
        self.link.send_now("HOME_POSITION")
        return Result.ACCEPTED


HANDLERS: dict[int, Callable[[Commands, Command], Result]] = {
    20: Commands._return,
    21: Commands._land,
    22: Commands._takeoff,
    176: Commands._set_mode,
    400: Commands._arm_disarm,
    410: Commands._request_home,
    510: Commands._get_interval,
    511: Commands._set_interval,
    512: Commands._request_message,
    520: Commands._request_version,
}


def message_name(number: float) -> str | None:
    """Name of the message with this id, as a command's float parameter carries it."""
    return name_of(int(number)) if math.isfinite(number) and number >= 0 else None
