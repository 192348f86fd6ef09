"""All control laws: their shipped files and defaults, and the properties that they share."""

from __future__ import annotations

import itertools
import json
import math
import re
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from attitude_plant import lemniscate
from laws import LEVEL, G, at, law_named, state_of

from offboard.control.base import Controller, DecisionError, Situation
from offboard.control.catalogue import names, settings_of
from offboard.documents import shipped
from offboard.documents.errors import DocumentError
from offboard.documents.reading import read
from offboard.flight.phases import Limits
from offboard.identification.learner import IdentifySettings
from offboard.model.command import PositionCommand
from offboard.reference.track import hold
from offboard.run.configuration import FlightConfig, load, read_part
from offboard.run.flight import Simulated

ENDS = ("minimum", "exclusiveMinimum", "maximum")  # of a JSON schema
# a key with a number, and the range that its comment states
RANGED = re.compile(r"^(\w+): [-\d.]+ .*# .*?(-?[\d.]+) \.\. ([\d.]+)", re.MULTILINE)


def test_laws_and_shipped_controller_files_correspond() -> None:
    files = set(shipped.names("controller"))
    assert set(names()) == files - {"paper_integral", "paper_limited"}


@pytest.mark.parametrize("law", names())
def test_shipped_file_states_the_defaults(law: str) -> None:
    settings = settings_of(law)
    given = settings.model_validate_json(json.dumps(read_part("controller", law)), strict=True)
    assert given == settings(law=law)


def test_flight_yaml_states_every_setting_with_its_default_and_range() -> None:
    text = shipped.read_text(shipped.directory() / "flight.yaml")
    raw = read(text, "flight.yaml")
    assert raw.keys() == FlightConfig.model_fields.keys()
    for section, settings in (("limits", Limits()), ("identify", IdentifySettings())):
        assert raw[section] == settings.model_dump()
        for name, schema in settings.model_json_schema()["properties"].items():
            ends = [f"{schema[key]:g}" for key in ENDS if key in schema]
            (line,) = re.findall(rf"^  {name}: .*", text, re.MULTILINE)
            assert " .. ".join(ends) in line


@pytest.mark.parametrize("part", shipped.PARTS)
def test_stated_ranges_of_shipped_files_are_accepted(part: str) -> None:
    """A lower end of 0 may be refused, because it may mean "greater than 0"."""
    stated, refused = 0, []
    for name, side in itertools.product(shipped.names(part), (1, 2)):
        text = shipped.read_text(shipped.locate(name, part))
        ends = {f"{part}.{row[0]}": row[side] for row in re.findall(RANGED, text)}
        stated += len(ends)
        try:
            load("flight", choices={part: name}, assignments=map("=".join, ends.items()))
        except DocumentError as error:
            wrong = [f": {end} should be" for end in ends.values() if end != "0"]
            refused += [each for each in error.problems if any(words in each for words in wrong)]
    assert stated
    assert refused == []


@pytest.mark.parametrize("law", names())
def test_reset_gives_the_decisions_of_a_new_controller(law: str) -> None:
    reference = lemniscate(8.0)
    states = [state_of(np.random.default_rng(seed), reference, 0.3) for seed in range(3)]

    def decisions(controller: Controller) -> list[object]:
        return [
            controller.decide(Situation(5.0, state, reference, LEVEL)).command for state in states
        ]

    controller = law_named(law)
    first = decisions(controller)
    controller.reset()
    assert decisions(controller) == first == decisions(law_named(law))


@pytest.mark.parametrize("law", [law for law in names() if law != "autopilot"])
@pytest.mark.parametrize("field", ["position_ned_m", "velocity_ned_mps", "thrust_direction_ned"])
def test_non_finite_state_raises_decision_error(law: str, field: str) -> None:
    reference = lemniscate(8.0)
    state = state_of(np.random.default_rng(0), reference, 0.1)
    for broken in (math.nan, math.inf):
        wrong = replace(state, **{field: np.array([0.0, broken, 1.0])})
        with np.errstate(invalid="ignore"), pytest.raises(DecisionError, match=r"finite|solution"):
            law_named(law).decide(Situation(5.0, wrong, reference, LEVEL))


@pytest.mark.parametrize("law", ["pso", "paper"])
def test_the_deadline_cuts_the_swarm_short(law: str) -> None:
    """The swarm reads the remaining time after every 25 iterations."""
    remaining_s, reference = iter((0.002, 0.001, 0.0)), lemniscate(8.0)
    state = state_of(np.random.default_rng(0), reference, 0.1)
    situation = Situation(5.0, state, reference, LEVEL, lambda: next(remaining_s))
    certificate = law_named(law).decide(situation).certificate
    assert (certificate.cut_short, certificate.iterations) == (True, 75)


def test_pid_integral_grows_while_an_error_stays() -> None:
    """An error of 5 cm adds in 3 s 0.03 m/s^2 along north and east, and 0.15 along the vertical."""
    for axis, off in enumerate(0.05 * np.eye(3)):
        law, situation = law_named("pid"), Situation(0.0, at(off, 0.0), hold((0, 0, 0), 0.0), LEVEL)
        first, *_, last = (law.decide(situation).command for _ in range(31))
        more = np.subtract(last.thrust_direction_ned[:2], first.thrust_direction_ned[:2]) * G
        more = [*more, last.thrust_mps2 - first.thrust_mps2]
        assert more == pytest.approx(np.diag((0.03, 0.03, 0.15))[axis], abs=1e-9)


def test_autopilot_law_sends_the_reference() -> None:
    heading = np.radians(-179.9)
    reference = lemniscate(8.0, heading_rad=heading, vertical_m=0.3)
    situation = Situation(6.0, at((0, 0, -3), heading), reference, LEVEL)
    command = law_named("autopilot").decide(situation).command
    assert isinstance(command, PositionCommand)
    sample = reference.sample(6.05)  # the middle of the period that follows
    assert command.position_ned_m == pytest.approx(tuple(sample.position_ned_m))
    assert command.velocity_ned_mps == pytest.approx(tuple(sample.velocity_ned_mps))
    assert command.acceleration_ned_mps2 == pytest.approx(tuple(sample.acceleration_ned_mps2))
    assert command.heading_rad == pytest.approx(heading)


# --- the vehicle of a flight ----------------------------------------------------------------------


@pytest.mark.parametrize(
    ("asked", "expected"),
    [
        ({}, "neutral"),
        ({"firmware": "px4"}, "px4_sih"),
        ({"firmware": "px4", "assignments": ("vehicle=neutral",)}, "neutral"),
        ({"firmware": "ardupilot", "name": "paper"}, "px4_sih"),
        ({"choices": {"vehicle": "arducopter"}}, "arducopter"),
    ],
)
def test_vehicle_file_defaults_to_neutral_or_the_simulated_one(
    asked: dict[str, Any], expected: str
) -> None:
    firmware, name = asked.pop("firmware", None), asked.pop("name", "flight")
    known = Simulated(firmware).known_vehicle if firmware else None
    assert load(name, known_vehicle=known, **asked).vehicle.name == expected
