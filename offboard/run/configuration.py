"""Resolves names, files and --set to one validated `FlightConfig`; builds controller and reference.

A configuration names its vehicle, controller and reference, gives their files, or holds their
values. A name is that of a shipped file (`config/`). The name of a controller may also be that of a
control law, which is then flown with its defaults.
"""

from __future__ import annotations

import platform
from collections.abc import Iterable, Mapping
from contextlib import suppress
from difflib import get_close_matches
from importlib.metadata import version
from pathlib import Path
from typing import Any, Literal

import numpy as np
import yaml
from pydantic import BaseModel, Field, SerializeAsAny, create_model

from offboard.control import catalogue
from offboard.control.base import Controller, ControllerSettings
from offboard.documents import shipped
from offboard.documents.errors import DocumentError, outside, wrong_result
from offboard.documents.parameters import Parameters
from offboard.documents.reading import override, read, validate
from offboard.documents.shipped import PARTS, beside, locate, read_text
from offboard.flight.phases import Limits
from offboard.identification.learner import IdentifySettings
from offboard.model.vehicle import Vehicle
from offboard.reference.feasibility import check
from offboard.reference.shapes import SHAPES, FromTable, Shape, Waypoints
from offboard.reference.track import Track

Raw = dict[str, Any]
RECORDED_VERSIONS = ("pso-offboard", "pymavlink", "numpy", "scipy", "numba")
UNKNOWN_VEHICLE = "neutral"
PERIODS_LEAST = 3  # control periods at full speed: two decisions, and one that may be lost
# Defaults of ArduCopter: WPNAV_SPEED_DN, LAND_ALT_LOW, LAND_SPEED; PX4 is at least as fast
DESCENT_MPS, SLOW_BELOW_M, SLOW_MPS = 1.5, 10.0, 0.5
DISARMING_S = 9.0  # real PX4 from 80 m: 75 s; from 3 m: 15 s


class FlightConfig(Parameters):
    """Resolved configuration of a flight, as recorded in `flight.yaml` of its directory."""

    vehicle: Vehicle
    controller: SerializeAsAny[ControllerSettings]  # the settings class of its `law`
    reference: SerializeAsAny[Shape]  # the class of its `shape`
    limits: Limits = Limits()
    identify: IdentifySettings = IdentifySettings()
    period_s: float = Field(default=0.1, ge=0.01, le=0.5)  # control period, vehicle time
    deadline_s: float = Field(default=0.05, ge=0.0005, le=0.5)  # for one decision, wall time
    seed: int = Field(default=7, ge=0, lt=2**32)

    @property
    def budget_s(self) -> float:
        """Wall time for one decision in seconds, at most one control period: a later setpoint is
        not sent."""
        return min(self.deadline_s, self.period_s)


def load(
    name: str,
    *,
    choices: Mapping[str, str | None] | None = None,
    assignments: Iterable[str] = (),
    seed: int | None = None,
    known_vehicle: str | None = None,
) -> FlightConfig:
    """Resolve a flight configuration. Raises DocumentError with every problem found.

    `name` is a shipped configuration or a file. `choices` replaces its vehicle, controller or
    reference by another name or file (None: no replacement). `assignments` are the
    `key.path=value` of --set. `known_vehicle` names the vehicle file that replaces `neutral`, the
    vehicle of which nothing is known, where the configuration names that.
    """
    path = locate(name, "configuration")
    raw = read(read_text(path), str(path), "configuration")
    if known_vehicle and raw.get("vehicle") == UNKNOWN_VEHICLE:
        raw["vehicle"] = known_vehicle
    for part in PARTS:
        chosen = (choices or {}).get(part) or _placed(raw.get(part), path)
        if isinstance(chosen, str):
            raw[part] = read_part(part, chosen)
    for assignment in assignments:
        raw = override(raw, assignment)
        key = assignment.partition("=")[0].strip()
        if key in PARTS and isinstance(raw[key], str):
            raw[key] = read_part(key, raw[key])
    missing = [_missing(part, raw) for part in PARTS if part not in raw]
    if missing:
        raise DocumentError(*(f"{path}: {sentence}" for sentence in missing))
    if seed is not None:
        raw["seed"], raw.places["seed"] = seed, f"--seed {seed}"
    return _complete(_validated(raw, str(path)))


def build_track(config: FlightConfig) -> Track:
    """Build the configured reference, and check it against the vehicle, the limits of the flight
    and the controller's keep-out volumes.

    Raises DocumentError if it cannot be flown; the sentence names time, value and limit.
    """
    vehicle, limits = config.vehicle, config.limits
    for name, value, limit, bound, instead in (
        ("hover_thrust", vehicle.hover_thrust, "hover_thrust", limits.hover_thrust, "carry less"),
        ("tilt_max_rad", vehicle.tilt_max_rad, "tilt_rad", limits.tilt_rad, "lower tilt_max_rad"),
    ):
        if value > bound:
            raise DocumentError(
                f"vehicle {vehicle.name}: {name} {value:g} exceeds limits.{limit} ({bound:g}), "
                f"beyond which a flight is ended; {instead} or raise the limit"
            )
    try:
        with np.errstate(over="ignore", invalid="ignore"):  # a value that overflows exceeds a limit
            track = config.reference.track()
            _, height_m, radius_m = check(track, vehicle, config.reference.slower)
    except ValueError as error:
        raise DocumentError(f"reference {config.reference.title}: {error}") from None
    least_s = PERIODS_LEAST * config.period_s
    if track.track_end_s - track.track_start_s < least_s * (1.0 - 1e-9):
        raise DocumentError(
            f"reference {config.reference.title}: it is flown at full speed for "
            f"{track.track_end_s - track.track_start_s:.2g} s; a score needs {least_s:.2g} s "
            f"({PERIODS_LEAST} periods)"
        )
    slow_m = min(height_m, SLOW_BELOW_M)
    landing_s = (height_m - slow_m) / DESCENT_MPS + slow_m / SLOW_MPS + DISARMING_S
    for value, what, limit in (
        (landing_s, f"landing from {height_m:.4g} m takes {landing_s:.4g} s", "land_s"),
        (height_m, f"it goes {height_m:.4g} m above the takeoff point", "ceiling_m"),
        (radius_m, f"it goes {radius_m:.4g} m away from the takeoff point", "radius_m"),
    ):
        most: float = getattr(limits, limit)
        if value > most:  # the failsafe would end the flight there
            raise DocumentError(
                f"reference {config.reference.title}: {what}, beyond limits.{limit} ({most:g}); "
                "fly lower or nearer, or raise the limit"
            )
    with outside("controller"):
        refused = config.controller.refusal(track)
    if refused:
        raise DocumentError(f"controller: {refused}")
    return track


def build_controller(config: FlightConfig) -> Controller:
    """Build the configured controller. Raises DocumentError if it cannot fly the vehicle with these
    settings."""
    settings = config.controller
    with outside(f"controller {settings.law}"):
        try:
            built: object = settings.build(
                config.vehicle, period_s=config.period_s, seed=config.seed
            )
        except ValueError as error:
            raise DocumentError(f"controller {settings.law}: {error}") from error
        if not isinstance(built, Controller):
            raise wrong_result(settings.build, built, "a controller with decide and reset")
    return built


def dump(config: FlightConfig) -> str:
    """The resolved configuration as YAML that `load` accepts. A comment at the top names the
    versions of Python and of the packages that affect a flight."""
    packages = " ".join(f"{name} {version(name)}" for name in RECORDED_VERSIONS)
    heading = f"# Resolved configuration. {packages}, Python {platform.python_version()}\n"
    with outside("the configuration cannot be recorded"):
        document = config.model_dump(mode="json", exclude_none=True)
    return heading + yaml.safe_dump(document, sort_keys=False)


def flown(text: str) -> FlightConfig:
    """The configuration in a log, written there by `dump`. Settings that this version does not have
    are ignored. Raises DocumentError."""
    source = "the log's configuration"
    raw = read(text, source)
    with suppress(DocumentError):
        return _validated(raw, source)
    return _validated(raw, source, "ignore")


def _validated(raw: Raw, source: str, extra: Literal["ignore"] | None = None) -> FlightConfig:
    """Validate `raw` as a FlightConfig. Its `law` and `shape` select the classes of controller and
    reference; for `extra` see `validate`."""
    models = {part: _model(part, raw.get(part), f"{source}: {part}") for part in PARTS}
    parts: dict[str, Any] = {part: (model, ...) for part, model in models.items()}
    model = create_model("FlightConfig", __base__=FlightConfig, **parts)
    with outside(source):  # validators of a control law
        return FlightConfig(**dict(validate(raw, model, source, extra)))


def _complete(config: FlightConfig) -> FlightConfig:
    """Store in the configuration the content of the reference's table, or the optimised times of
    its waypoints. Then the recorded reference needs no other file and is the same on every
    computer."""
    reference = config.reference
    if isinstance(reference, FromTable) and reference.text is None:
        found: dict[str, Any] = {"text": read_text(Path(reference.file))}
    elif isinstance(reference, Waypoints) and reference.fastest is not None:
        found = {"times_s": tuple(reference.times().tolist()), "fastest": None}
    else:
        return config
    return config.model_copy(update={"reference": reference.model_copy(update=found)})


def _missing(part: str, raw: Raw) -> str:
    near = get_close_matches(part, raw, n=1)
    hint = f" (is it meant by {near[0]}?)" if near else ""
    return f"{part} is missing{hint}; give a name, a file or a mapping"


def read_part(part: str, name: str) -> Raw:
    """Read and validate a vehicle, controller or reference by shipped name or file. Raises
    DocumentError."""
    if part == "reference" and name.lower().endswith(".csv"):
        return {"shape": "table", "file": name}
    laws = []
    if part == "controller":
        laws = sorted(set(catalogue.names()) - set(shipped.names(part)))
    if name in laws:
        return {"law": name}
    path = locate(name, part, laws)
    raw = read(read_text(path), str(path), part)
    with outside(str(path)):
        validate(raw, _model(part, raw, str(path)), str(path))
    placed: Raw = _placed(raw, path)
    return placed


def _placed(part: Any, path: Path) -> Any:
    """A part of a configuration, or its name, as the file `path` gives it. The path of its file, or
    of a reference's table, is relative to `path`."""
    if isinstance(part, str):
        return beside(part, path)
    if isinstance(part, dict) and isinstance(part.get("file"), str) and "text" not in part:
        part["file"] = str(path.parent / part["file"])
    return part


def _model(part: str, raw: object, source: str) -> type[BaseModel]:
    """The class of `Parameters` for a vehicle, for a controller with the `law` of `raw`, or for a
    reference with its `shape`. Raises DocumentError."""
    if part == "vehicle":
        return Vehicle
    key, known = ("law", catalogue.names()) if part == "controller" else ("shape", list(SHAPES))
    named = raw.get(key) if isinstance(raw, dict) else None
    if named not in known:
        problem = f"{key}: {named!r} is not one of" if named else f"{key} is missing; known are"
        place = getattr(raw, "places", {}).get(key, source)
        raise DocumentError(f"{place}: {problem} {', '.join(known)}")
    return catalogue.settings_of(named) if part == "controller" else SHAPES[named]
