"""A vehicle that is in the air when its links open: it takes off before the first message."""

from __future__ import annotations

import math

from pydantic import Field

from offboard.documents.errors import DocumentError
from offboard.documents.parameters import Parameters
from simulator.autopilot.autopilot import Autopilot
from simulator.autopilot.commander import Request
from simulator.faults.fault import ModeName

CLIMB_S = 120.0  # for the climb: 100 m at 1.5 m/s, and until estimate and truth agree
SETTLE_S = 2.0
REACHED_M, STILL_MPS = 0.3, 0.1


class Start(Parameters):
    """The vehicle hovers `height_m` above the ground when its links open; faults count from there.

    Its time stamps go on from the boot and the climb before.
    """

    height_m: float = Field(ge=1, le=100)
    mode: ModeName | None = None  # None: the one that holds position
    by_failsafe: bool = False  # a failsafe chose the mode: system_status is 5


def take_off(autopilot: Autopilot, start: Start) -> None:
    """Boot, climb and enter the mode of `start`.

    Raises:
        DocumentError: the vehicle does not reach the height.
    """
    ready_s = autopilot.firmware.passes_after_s * autopilot.health.boot_scale + SETTLE_S
    while autopilot.state.time_s < ready_s:
        autopilot.step()
    # as a pilot with a ground station does, in a mode in which the firmware takes off
    autopilot.handle("mode", Request(autopilot.firmware.reposition_mode))
    autopilot.handle("arm")
    autopilot.handle("takeoff", Request(takeoff_ned_m=(math.nan, math.nan, -start.height_m)))
    end_s = ready_s + CLIMB_S
    while not (hovers := _hovers(autopilot, start.height_m)) and autopilot.state.time_s < end_s:
        autopilot.step()
    if not hovers:
        raise DocumentError(f"start.height_m: the vehicle does not hover at {start.height_m:g} m")
    named = autopilot.firmware.mode_named(start.mode or autopilot.firmware.hold_mode)
    assert named is not None
    autopilot.commander.switch(named.name, by_failsafe=start.by_failsafe)
    autopilot.commander.texts.clear()
    autopilot.commander.announcements.clear()


def _hovers(autopilot: Autopilot, height_m: float) -> bool:
    off_m = abs(autopilot.plant.height_m - height_m)
    return off_m < REACHED_M and abs(autopilot.state.estimate.velocity_ned_mps[2]) < STILL_MPS
