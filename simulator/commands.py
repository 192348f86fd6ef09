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
from simulator.firmware.base import Result, Say, Severity
from simulator.telemetry import View


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
            if request.say is not None:
                autopilot.texts.append(request.say)
            return request.refusal
        return autopilot.happen("mode", mode=request.mode)

    def _arm_disarm(self, command: Command) -> Result:
        wish, force = command.params[0], command.params[1]
        if wish not in (0.0, 1.0):
            return Result.UNSUPPORTED
        event = "arm" if wish == 1.0 else "disarm"
        autopilot = self.link.view.autopilot
        forced = force == autopilot.firmware.force_codes[event]
        return autopilot.happen(f"force {event}" if forced else event)

    def _takeoff(self, command: Command) -> Result:
        asked_m = command.params[6]
        autopilot = self.link.view.autopilot
        home_down_m = autopilot.pilot.home_ned_m[2]
        if autopilot.firmware.takeoff_above_home:
            return autopilot.happen("takeoff", takeoff_z_m=home_down_m - asked_m)
        above_m = asked_m - autopilot.firmware.origin[2]
        known = math.isfinite(above_m) and above_m > -home_down_m
        return autopilot.happen("takeoff", takeoff_z_m=-above_m if known else math.nan)

    def _land(self, _: Command) -> Result:
        return self.link.view.autopilot.happen("land")

    def _return(self, _: Command) -> Result:
        return self.link.view.autopilot.happen("return")

    def _start_mission(self, command: Command) -> Result:
        autopilot = self.link.view.autopilot
        first = command.params[0]
        if not autopilot.knows("mission"):
            return Result.UNSUPPORTED
        if not -1 <= first < max(1, len(autopilot.mission.items)):
            return Result.DENIED
        return autopilot.happen("mission")

    def _set_current_item(self, command: Command) -> Result:
        number = command.params[0]
        known = math.isfinite(number) and self.link.view.autopilot.mission.go_to(int(number))
        return Result.ACCEPTED if known else Result.DENIED

    def _set_interval(self, command: Command) -> Result:
        number, interval_us = command.params[:2]
        streams = self.link.view.autopilot.firmware.streams
        name = message_name(number)
        if 0 < interval_us < 1e6 / streams.rate_max_hz:
            return self._refuse_interval(number, streams.too_fast_text)
        if name is None or not math.isfinite(interval_us):
            return self._refuse_interval(number, streams.refusal_text)
        if not self.link.set_interval(name, interval_us):
            return self._refuse_interval(number, streams.refusal_text)
        return Result.ACCEPTED

    def _refuse_interval(self, number: float, text: str) -> Result:
        autopilot = self.link.view.autopilot
        if text and math.isfinite(number):
            autopilot.texts.append(Say(Severity.INFO, text.format(id=int(number))))
        return autopilot.firmware.streams.refusal

    def _get_interval(self, command: Command) -> Result:
        name = message_name(command.params[0])
        if name is None or name not in self.link.view.builders:
            return Result.DENIED
        number = int(command.params[0]) & 0xFFFF
        self.link.send("MESSAGE_INTERVAL", number, self.link.interval_us(name))
        return Result.ACCEPTED

    def _request_message(self, command: Command) -> Result:
        name = message_name(command.params[0])
        if name not in self.link.view.builders or self.link.view.withheld(name):
            return self.link.view.autopilot.firmware.streams.request_refusal
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
    224: Commands._set_current_item,
    300: Commands._start_mission,
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
