"""From names, files and --set to one validated `FlightConfig`. Only this module reads YAML files.

A configuration refers to its vehicle, controller and reference by name (a file of `config/`), by
file, or spells them out. Packaged, `config/` lies inside the package; in a checkout beside it.
"""

from __future__ import annotations

import platform
from collections.abc import Callable, Iterable, Mapping
from difflib import get_close_matches
from importlib.metadata import version
from pathlib import Path
from typing import Any

import yaml
from pydantic import BaseModel, Field

from offboard.control.catalogue import LAWS, ControllerConfig
from offboard.control.horizon.keep_out import refusal
from offboard.control.horizon.settings import HorizonSettings
from offboard.documents.parameters import Parameters
from offboard.documents.reading import DocumentError, override, read, validate
from offboard.documents.shipped import locate, read_text
from offboard.estimation.fusion import FollowedEstimate
from offboard.estimation.fusion_filter import FusionSettings
from offboard.estimation.observer import ObserverSettings
from offboard.flight.online_identification import IdentifySettings
from offboard.flight.phases import Limits
from offboard.model.vehicle import Vehicle
from offboard.reference.catalogue import SHAPES, FromTable, ReferenceConfig, build
from offboard.reference.feasibility import check
from offboard.reference.track import Track

Raw = dict[str, Any]
RECORDED_VERSIONS = ("pso-offboard", "pymavlink", "numpy", "scipy", "llvmlite")
UNKNOWN_VEHICLE = "neutral"
FOLDERS = {"vehicle": "vehicles", "controller": "controllers", "reference": "references"}


class FlightConfig(Parameters):
    """Everything that decides a flight, resolved. `flight.yaml` of a flight directory is one."""

    vehicle: Vehicle
    controller: ControllerConfig
    reference: ReferenceConfig
    estimate: FollowedEstimate = FollowedEstimate.VEHICLE
    fusion: FusionSettings = FusionSettings()
    observer: ObserverSettings = ObserverSettings()
    limits: Limits = Limits()
    identify: IdentifySettings = IdentifySettings()
    period_s: float = Field(default=0.1, ge=0.01, le=0.5)  # control period, vehicle time
    deadline_s: float = Field(default=0.05, gt=0.0005, le=0.5)  # for one decision, wall time
    seed: int = Field(default=7, ge=0, lt=2**32)


def load(
    name: str,
    *,
    choices: Mapping[str, str] | None = None,
    assignments: Iterable[str] = (),
    seed: int | None = None,
    known_vehicle: str | None = None,
) -> FlightConfig:
    """Resolve a flight configuration. Raises DocumentError with every problem found.

    `name` is a shipped configuration or a file; `choices` replaces its vehicle, controller or
    reference by another name or file; `assignments` are `key.path=value` of --set. `known_vehicle`
    stands in for the file's `neutral`, of which nothing is known.
    """
    path = locate(name, "", "configuration")
    raw = read(read_text(path), str(path))
    if known_vehicle and raw.get("vehicle") == UNKNOWN_VEHICLE:
        raw["vehicle"] = known_vehicle
    for part in FOLDERS:
        chosen = (choices or {}).get(part, raw.get(part))
        if isinstance(chosen, str):
            raw[part] = read_part(part, chosen)
    options: dict[str, str] = {}
    for assignment in assignments:
        raw = override(raw, assignment)
        key = assignment.partition("=")[0].strip()
        options[key] = f"--set {assignment}"
        if key in FOLDERS and isinstance(raw[key], str):
            raw[key] = read_part(key, raw[key])
    missing = [_missing(part, raw) for part in FOLDERS if part not in raw]
    if missing:
        raise DocumentError(*(f"{path}: {sentence}" for sentence in missing))
    if seed is not None:
        raw["seed"], options["seed"] = seed, f"--seed {seed}"
    return _with_table(validate(raw, FlightConfig, str(path), options))


def build_track(config: FlightConfig) -> Track:
    """The configured reference, checked against the vehicle and the controller's keep-out volumes
    before anything is sent.

    Raises DocumentError naming time, value and limit where it cannot be flown.
    """
    try:
        track = build(config.reference)
        check(track, config.vehicle)
    except ValueError as error:
        given = config.reference
        name = given.file if isinstance(given, FromTable) else given.shape
        raise DocumentError(f"reference {name}: {error}") from None
    controller = config.controller
    if isinstance(controller, HorizonSettings):
        refused = refusal(controller.keep_out, controller.clearance_m, track)
        if refused:
            raise DocumentError(f"controller: {refused}")
    return track


def check_file(path: Path, check_scenario: Callable[[Path], None]) -> str:
    """Validate one file of any kind that a flight may be given; return what it is.

    A reference is built and must be flyable by the default flight's vehicle, a flight's by its
    own. Scenarios are the simulator's: `check_scenario` asks it. Raises DocumentError.
    """
    if path.suffix.lower() == ".csv":
        build_track(load("flight", choices={"reference": str(path)}))
        return "reference"
    raw = read(read_text(path), str(path))
    if not raw:
        raise DocumentError(f"{path} is empty")
    name = str(path if path.suffix in (".yaml", ".yml") else path.absolute())
    if "conditions" in raw or "faults" in raw:
        check_scenario(path)
        return "scenario"
    kind = _kind(raw)
    if kind in FOLDERS:
        validate(raw, _model(kind, raw, str(path)), str(path))
        if kind == "reference":
            build_track(load("flight", choices={kind: name}))
    else:
        build_track(load(name))
    return kind


def _kind(raw: Raw) -> str:
    """What a file is meant to be: by the key that only this kind has, else by most of its keys."""
    for kind, key in (("reference", "shape"), ("controller", "law"), ("vehicle", "mass_kg")):
        if key in raw:
            return kind
    keys = {
        "flight configuration": set(FlightConfig.model_fields),
        "vehicle": set(Vehicle.model_fields),
        "controller": {key for law in LAWS.values() for key in law.model_fields},
        "reference": {key for shape in SHAPES.values() for key in shape.model_fields},
    }

    def likeness(kind: str) -> tuple[int, int]:
        close = sum(bool(get_close_matches(key, keys[kind], n=1)) for key in raw)
        return len(raw.keys() & keys[kind]), close

    return max(keys, key=likeness)


def dump(config: FlightConfig) -> str:
    """The resolved configuration as YAML that `load` accepts, headed by what it is flown with."""
    packages = " ".join(f"{name} {version(name)}" for name in RECORDED_VERSIONS)
    heading = f"# Resolved configuration. {packages}, Python {platform.python_version()}\n"
    document = config.model_dump(mode="json", exclude_none=True)
    return heading + yaml.safe_dump(document, sort_keys=False)


def flown(text: str) -> FlightConfig:
    """The configuration in a log (`dump`ed then). Raises DocumentError."""
    return validate(read(text, "the log's configuration"), FlightConfig, "the log's configuration")


def _with_table(config: FlightConfig) -> FlightConfig:
    """With the content of the table that it names, so that it stands alone."""
    reference = config.reference
    if not isinstance(reference, FromTable) or reference.text is not None:
        return config
    content = {"text": read_text(Path(reference.file))}
    return config.model_copy(update={"reference": reference.model_copy(update=content)})


def _missing(part: str, raw: Raw) -> str:
    near = get_close_matches(part, raw, n=1)
    hint = f" (is it meant by {near[0]}?)" if near else ""
    return f"{part} is missing{hint}; give a name, a file or a mapping"


def read_part(part: str, name: str) -> Raw:
    """A vehicle, controller or reference by shipped name or file, valid. Raises DocumentError."""
    if part == "reference" and name.lower().endswith(".csv"):
        return {"shape": "table", "file": name}
    path = locate(name, FOLDERS[part], part)
    raw = read(read_text(path), str(path))
    validate(raw, _model(part, raw, str(path)), str(path))
    return raw


def _model(part: str, raw: Raw, source: str) -> type[BaseModel]:
    if part == "vehicle":
        return Vehicle
    key, table = ("law", LAWS) if part == "controller" else ("shape", SHAPES)
    chosen = raw.get(key)
    if key not in raw:
        raise DocumentError(f"{source}: {key} is missing; known are {', '.join(table)}")
    if not isinstance(chosen, str) or chosen not in table:
        raise DocumentError(f"{source}: {key} is {chosen!r}; known are {', '.join(table)}")
    return table[chosen]
