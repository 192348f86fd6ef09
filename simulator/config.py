"""Scenarios and vehicles of the simulator, by shipped name or by file; a scenario that starts in
the air."""

from __future__ import annotations

import math

from pydantic import Field

from offboard.documents.errors import DocumentError
from offboard.documents.parameters import Parameters
from offboard.documents.reading import load_document
from offboard.model.vehicle import Vehicle
from simulator.autopilot.autopilot import Autopilot
from simulator.autopilot.commander import Request
from simulator.autopilot.firmware import Firmware
from simulator.faults import Fault
from simulator.faults.fault import ModeName
from simulator.faults.link import Stranger
from simulator.faults.vehicle import PilotTakesOver
from simulator.vehicle.conditions import Conditions

# Between two barriers (20 ms) more would fill a socket's buffer, so that barriers are lost
LOCKSTEP_STRANGER_HZ = 5000.0

# A start in the air
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


class Scenario(Parameters):
    """Conditions and faults of a simulated flight: one file of `config/scenarios`."""

    name: str = Field(min_length=1, max_length=40)
    conditions: Conditions = Conditions()
    start: Start | None = None
    faults: tuple[Fault, ...] = Field(default=(), max_length=50)


def scenario(name: str) -> Scenario:
    """A shipped scenario or a file. Raises DocumentError."""
    return load_document(name, "scenario", Scenario)[0]


def check_for(flown: Scenario, firmware: Firmware, *, lockstep: bool) -> None:
    """Check what a scenario needs of a run. Raises DocumentError."""
    switches = [fault.mode for fault in flown.faults if isinstance(fault, PilotTakesOver)]
    named = switches if flown.start is None else [*switches, flown.start.mode]
    for mode in named:
        if mode is not None and firmware.mode_named(mode) is None:
            raise DocumentError(f"scenario {flown.name}: {firmware.name} has no mode {mode}")
    for fault in flown.faults:
        if lockstep and isinstance(fault, Stranger) and fault.rate_hz > LOCKSTEP_STRANGER_HZ:
            raise DocumentError(
                f"scenario {flown.name}: a stranger with more than {LOCKSTEP_STRANGER_HZ:g}"
                " datagrams/s overflows the socket of a companion in lockstep: fly it in real time"
            )


def vehicle(name: str) -> Vehicle:
    """A shipped vehicle or a file. Raises DocumentError."""
    return load_document(name, "vehicle", Vehicle)[0]


def take_off(autopilot: Autopilot, start: Start) -> None:
    """Boot, climb and enter the mode of `start`.

    Raises:
        DocumentError: the vehicle does not reach the height.
    """
    ready_s = autopilot.firmware.boot_events_s["ready"] * autopilot.health.boot_scale + SETTLE_S
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
