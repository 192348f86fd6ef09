"""What a pilot does, and what the autopilot refuses or forgets."""

from __future__ import annotations

from enum import StrEnum
from typing import Literal

from pydantic import Field

from simulator.autopilot.commander import Request
from simulator.faults.fault import Effect, ModeName, Running, Timed, Vehicle, until_the_end
from simulator.firmware.values import critical


class Refusable(StrEnum):
    """Requests that a fault can make the autopilot refuse."""

    ARM = "arm"
    OFFBOARD = "offboard"
    TAKEOFF = "takeoff"


# events that are refused, and the beginning of the text
_REFUSED = {
    Refusable.ARM: (("arm", "force arm"), "Arming denied"),
    Refusable.OFFBOARD: (("offboard",), "Switching to Offboard denied"),
    Refusable.TAKEOFF: (("takeoff",), "Takeoff denied"),
}


class Refusal(Timed):
    """The autopilot refuses a request, with a text."""

    fault: Literal["refusal"]
    of: Refusable
    text: str = Field(default="Resolve system health failures first", min_length=1, max_length=200)

    def effect(self, vehicle: Vehicle, running: Running) -> Effect:
        events, title = _REFUSED[self.of]
        for event in events:
            vehicle.autopilot.commander.refused[event] = critical(f"{title}: {self.text}")
        yield from until_the_end()
        for event in events:
            vehicle.autopilot.commander.refused.pop(event, None)


class PilotTakesOver(Timed):
    """The pilot switches to a mode; after `for_s` back to the one before.

    Sticks are centred or, where they are not simulated, missing: POSCTL then descends slowly.
    """

    fault: Literal["pilot_takes_over"]
    mode: ModeName | None = None  # None: the one that holds position

    def effect(self, vehicle: Vehicle, running: Running) -> Effect:
        """Switch as by command; a mode that no command may enter, as by the pilot's switch."""
        autopilot = vehicle.autopilot
        mode = autopilot.firmware.mode_named(self.mode or autopilot.firmware.hold_mode)
        assert mode is not None, "the scenario was checked"
        before = autopilot.commander.mode.name
        autopilot.handle("mode", Request(mode.name))
        if autopilot.commander.mode is not mode:
            autopilot.commander.switch(mode.name)
        yield from until_the_end()
        vehicle.autopilot.handle("mode", Request(before))


class PilotDisarms(Timed):
    """The pilot disarms, also in the air."""

    fault: Literal["pilot_disarms"]

    def effect(self, vehicle: Vehicle, running: Running) -> Effect:
        vehicle.autopilot.handle("force disarm")
        yield from ()


class Reboot(Timed):
    """The autopilot restarts, disarmed, with its time from zero, after `for_s` of silence."""

    fault: Literal["reboot"]
    for_s: float = Field(default=2.0, gt=0, le=60)

    def effect(self, vehicle: Vehicle, running: Running) -> Effect:
        vehicle.reboot(self.for_s)
        yield from ()
