"""Scenarios and vehicles by name or file. Only this module of the simulator reads files.

Shipped files lie inside an installed package, or in a checkout's `config/`.
"""

from __future__ import annotations

from importlib import resources
from pathlib import Path

from pydantic import Field

from offboard.model.document import DocumentError, M, parse
from offboard.model.vehicle import Parameters, Vehicle
from simulator.faults import Fault
from simulator.vehicle.conditions import Conditions


class Scenario(Parameters):
    """What a flight is flown in: one file of `config/scenarios`."""

    name: str = Field(min_length=1, max_length=40)
    description: str = Field(default="", max_length=200)
    conditions: Conditions = Conditions()
    faults: tuple[Fault, ...] = Field(default=(), max_length=50)


def scenario(name: str) -> Scenario:
    """A shipped scenario or a file. Raises DocumentError with a sentence."""
    return _load(name, "scenarios", "scenario", Scenario)


def vehicle(name: str) -> Vehicle:
    """A shipped vehicle or a file. Raises DocumentError with a sentence."""
    return _load(name, "vehicles", "vehicle", Vehicle)


def shipped_names(folder: str) -> list[str]:
    """Names of the files of one folder of the shipped configuration."""
    return sorted(path.stem for path in (_shipped() / folder).glob("*.yaml"))


def _shipped() -> Path:
    package = Path(str(resources.files("offboard")))
    inside = package / "_config"
    return inside if inside.is_dir() else package.parent / "config"


def _load(name: str, folder: str, what: str, model: type[M]) -> M:
    is_file = name.endswith((".yaml", ".yml")) or "/" in name
    path = Path(name) if is_file else _shipped() / folder / f"{name}.yaml"
    try:
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError:
        shipped = ", ".join(shipped_names(folder))
        raise DocumentError(f"{what} {name} not found: give a file or one of {shipped}") from None
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "not UTF-8 text"
        raise DocumentError(f"{what} {path} cannot be read: {reason}") from None
    return parse(text, model, str(path))
