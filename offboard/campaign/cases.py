"""The cases of a campaign. A case is one flight as plain values, which a worker on any computer can
fly.

The key of a case is a hash of everything that decides its flight, except the code.
"""

from __future__ import annotations

import hashlib
import itertools
import json
import shlex
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from scipy.stats import qmc

from offboard.campaign.document import CASES_MOST, CampaignFile, Sample
from offboard.control import catalogue
from offboard.documents import shipped
from offboard.documents.errors import DocumentError, plain
from offboard.documents.reading import override, read
from offboard.run.configuration import FlightConfig, load
from offboard.run.flight import Simulated

SEED = "seed"  # name of a range of the flight's seed: of noise, and of the phase of gusts
SCENARIO = "scenario."  # prefix of a key of the scenario
CONNECTED = "connected"  # name of the scenario in tables if a vehicle at a link is flown
OWN_SCENARIOS = {"px4": "px4_like", "ardupilot": "ardupilot_like"}  # if a file names none
FILES = ("config", "controller", "reference", "vehicle", "sim_vehicle", "scenario")
DIGITS = 5  # significant digits of a drawn or searched value, to keep files and commands short
Values = tuple[tuple[str, Any], ...]


@dataclass(frozen=True, slots=True)
class Case:
    """One flight of a campaign. A name that is None is the default of `config` or of the firmware.

    `values` are the values that parameters and draws set, by key; `files` holds a hash of every
    file that is not shipped. If `link` (an address) is given, the vehicle there is flown instead of
    the simulator.
    """

    config: str
    controller: str | None
    reference: str | None
    vehicle: str | None
    sim_vehicle: str | None
    firmware: str
    scenario: str
    seed: int
    values: Values = ()
    files: tuple[tuple[str, str], ...] = ()
    link: str | None = None

    @property
    def key(self) -> str:
        """Hash of the case, 16 hexadecimal digits. Raises DocumentError."""
        flown = {**asdict(self), "text": self.scenario_text}
        return _hash(json.dumps(flown, sort_keys=True, separators=(",", ":")))

    @property
    def assignments(self) -> tuple[str, ...]:
        """The arguments of `--set`."""
        return tuple(
            f"{key}={json.dumps(value)}"
            for key, value in self.values
            if not key.startswith(SCENARIO)
        )

    @property
    def folder(self) -> str:
        """Name of the directory of its log, for example "pso-lemniscate-calm-1-3f9a1c2b"."""
        names = (self.controller, self.reference, self.scenario)
        stems = [Path(name).stem for name in names if name]
        return "-".join((*stems, str(self.seed), self.key[:8]))

    @property
    def scenario_text(self) -> str:
        """YAML of the scenario with the changes that `values` make to it; empty if they change
        nothing. Raises DocumentError."""
        changes = [(key, value) for key, value in self.values if key.startswith(SCENARIO)]
        return _changed(self.scenario, json.dumps(changes)) if changes else ""

    @property
    def scenario_file(self) -> str:
        """Name of the file for `scenario_text`, with a hash of the text; empty without text."""
        text = self.scenario_text
        return f"scenarios/{Path(self.scenario).stem}-{_hash(text)[:10]}.yaml" if text else ""

    @property
    def line(self) -> str:
        """The command that flies the case again, from the directory of the campaign. At a link it
        also needs the same --system and --signing-key, which are no part of the case."""
        named = {
            "config": self.config if self.config != "flight" else None,
            "controller": self.controller,
            "reference": self.reference,
            "vehicle": self.vehicle,
            "sim-vehicle": self.sim_vehicle,
            "firmware": self.firmware if self.firmware != "px4" else None,
        }
        words = ["offboard", "fly", *(("--connect", self.link) if self.link else ("--sitl",))]
        for option, name in named.items():
            words += [f"--{option}", shipped.absolute(name)] if name else []
        if not self.link:
            words += ["--scenario", self.scenario_file or shipped.absolute(self.scenario)]
        for assignment in self.assignments:
            words += ["--set", assignment]
        return shlex.join([*words, "--seed", str(self.seed)])

    def load(self) -> FlightConfig:
        """Return the configuration of the flight. At a link an armed vehicle, which somebody else
        is flying, is refused unless a value sets limits.begin_armed. Raises DocumentError."""
        disarmed = ("limits.begin_armed=false",) if self.link else ()
        return load(
            self.config,
            choices={part: getattr(self, part) for part in shipped.PARTS},
            assignments=(*disarmed, *self.assignments),
            seed=self.seed,
            known_vehicle=None if self.link else self.simulated().known_vehicle,
        )

    def simulated(self, scenario: str | None = None) -> Simulated:
        """Return the simulated vehicle of the case in `scenario`. Raises DocumentError."""
        return Simulated(self.firmware, scenario, self.sim_vehicle)


def expand(file: CampaignFile, link: str | None = None) -> list[Case]:
    """Return all cases of a campaign in the order of its table. `link`: address of the vehicle to
    fly instead of the simulator. Raises DocumentError."""
    if SEED in file.parameters:
        raise DocumentError("parameters.seed: give the seeds with seeds")
    columns = [[(key, value) for value in values] for key, values in file.parameters.items()]
    draws = drawn(file.sample) if file.sample else [()]
    flown = (
        replace(case, values=(*grid, *draw), seed=seed)
        for case in base_cases(file, link)
        for grid in itertools.product(*columns)
        for draw in draws
        for seed in file.seeds
    )
    cases = list(itertools.islice(flown, CASES_MOST + 1))
    if len(cases) > CASES_MOST:
        raise DocumentError(f"more than {CASES_MOST:,} flights")
    if len({case.key for case in cases}) < len(cases):
        raise DocumentError("a combination is given twice; give each value once")
    return cases


def base_cases(file: CampaignFile, link: str | None = None) -> Iterator[Case]:
    """Iterate over every combination of names, without parameters and with the first seed. Raises
    DocumentError."""
    for firmware in file.firmwares:
        for reference, scenario, controller, vehicle, sim_vehicle in itertools.product(
            file.references or (None,),
            (CONNECTED,) if link else file.scenarios or (OWN_SCENARIOS[firmware],),
            file.controllers or (None,),
            file.vehicles or (None,),
            file.sim_vehicles or (None,),
        ):
            case = Case(
                file.config, controller, reference, vehicle, sim_vehicle, firmware, scenario,
                file.seeds[0], link=link,
            )  # fmt: skip
            yield replace(case, files=_digests(case))


def drawn(sample: Sample) -> list[Values]:
    """Return the points of a sample."""
    cube = qmc.LatinHypercube(len(sample.ranges), rng=np.random.default_rng(sample.seed))
    points = qmc.scale(cube.random(sample.draws), *zip(*sample.ranges.values(), strict=True))
    return [tuple(zip(sample.ranges, plain(each, DIGITS), strict=True)) for each in points.tolist()]


def _digests(case: Case) -> tuple[tuple[str, str], ...]:
    """Return a hash of each file that the case names. If there are any, add a hash of the resolved
    configuration, because files may name other files. Raises DocumentError for a missing file."""
    found = []
    for part in FILES:
        name = getattr(case, part)
        if name is None or (part == "scenario" and case.link):
            continue
        if shipped.is_file(name):
            found.append((part, _digest(name)))
        else:
            kind = {"config": "configuration", "sim_vehicle": "vehicle"}.get(part, part)
            laws = catalogue.names() if part == "controller" else ()
            if name not in laws:
                shipped.locate(name, kind, laws)
    if found:
        with suppress(DocumentError):  # a case that cannot be flown becomes a row of the table
            found.append(("flight", _hash(case.load().model_dump_json())))
    return tuple(found)


@cache
def _digest(name: str) -> str:
    return _hash(shipped.read_text(Path(name)))


def _hash(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()[:16]


@cache
def _changed(scenario: str, changes: str) -> str:
    """Return the YAML of a scenario with `changes`, a JSON list of keys and values."""
    text = shipped.read_text(shipped.locate(scenario, "scenario"))
    raw = read(text, f"scenario {scenario}")
    for key, value in json.loads(changes):
        raw = override(raw, f"{key.removeprefix(SCENARIO)}={json.dumps(value)}")
    return yaml.safe_dump(raw, sort_keys=False)
