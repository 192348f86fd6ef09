"""Scenarios and vehicles of the simulator, by shipped name or by file."""

from __future__ import annotations

from pydantic import Field

from offboard.documents.errors import DocumentError
from offboard.documents.parameters import Parameters
from offboard.documents.reading import load_document
from offboard.model.vehicle import Vehicle
from simulator.autopilot.firmware import Firmware
from simulator.faults import Fault
from simulator.faults.fault import ModeName
from simulator.faults.link import Stranger
from simulator.faults.vehicle import PilotTakesOver
from simulator.vehicle.conditions import Conditions

# At a higher rate, the datagrams between two barriers (20 ms) overflow the buffer of the
# companion's socket, and barriers are lost
LOCKSTEP_STRANGER_HZ = 5000.0


class Start(Parameters):
    """A start in the air: the vehicle hovers `height_m` above the ground when its links open.

    The times of faults count from this moment; the vehicle's time stamps from the boot, before the
    climb.
    """

    height_m: float = Field(ge=1, le=100)
    mode: ModeName | None = None  # None: the mode of the firmware that holds position
    by_failsafe: bool = False  # whether a failsafe chose the mode: system_status is then 5


class Scenario(Parameters):
    """Conditions and faults of a simulated flight: one file of `config/scenarios`."""

    name: str = Field(min_length=1, max_length=40)
    conditions: Conditions = Conditions()
    start: Start | None = None
    faults: tuple[Fault, ...] = Field(default=(), max_length=50)


def scenario(name: str) -> Scenario:
    """Read a scenario by shipped name or file. Raises DocumentError."""
    return load_document(name, "scenario", Scenario)[0]


def check_for(flown: Scenario, firmware: Firmware, *, lockstep: bool) -> None:
    """Check that a scenario can be flown with this firmware and clock. Raises DocumentError."""
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
    """Read a vehicle by shipped name or file. Raises DocumentError."""
    return load_document(name, "vehicle", Vehicle)[0]
