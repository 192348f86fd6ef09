"""Scenarios and vehicles of the simulator, by shipped name or by file."""

from __future__ import annotations

from pydantic import Field

from offboard.documents.parameters import Parameters
from offboard.documents.reading import M, parse
from offboard.documents.shipped import locate, read_text
from offboard.model.vehicle import Vehicle
from simulator.faults import Fault
from simulator.vehicle.conditions import Conditions


class Scenario(Parameters):
    """Conditions and faults of a simulated flight: one file of `config/scenarios`."""

    name: str = Field(min_length=1, max_length=40)
    conditions: Conditions = Conditions()
    faults: tuple[Fault, ...] = Field(default=(), max_length=50)


def scenario(name: str) -> Scenario:
    """A shipped scenario or a file. Raises DocumentError."""
    return _load(name, "scenarios", "scenario", Scenario)


def vehicle(name: str) -> Vehicle:
    """A shipped vehicle or a file. Raises DocumentError."""
    return _load(name, "vehicles", "vehicle", Vehicle)


def _load(name: str, folder: str, kind: str, model: type[M]) -> M:
    path = locate(name, folder, kind)
    return parse(read_text(path), model, str(path))
