"""What is found out before a flight: a law that fails, a scenario that is wrong."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from faults import failing, no_direction, raises

from offboard.control.base import Certificate, Controller, Decision, Situation
from offboard.documents.reading import DocumentError
from offboard.model.command import Command
from offboard.run.configuration import load
from offboard.run.flight import Simulated, build, rehearse


def without_cost(_: Situation) -> Decision:
    """A certificate that the log cannot hold."""
    return Decision(Command(9.8, (0.0, 0.0, 1.0), 0.0), Certificate(cost=None))  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("fail", "says"),
    [
        (raises, r"controller: ZeroDivisionError: nothing to divide by \(.*faults\.py:\d+\)"),
        (no_direction, "controller: it decides Command.*, which cannot be sent"),
        (without_cost, r"controller: TypeError: .*float\(\)"),
    ],
)
def test_a_law_that_fails_is_found_before_the_flight(fail: object, says: str) -> None:
    prepared = build(load("flight", known_vehicle="px4_sih"))
    law: Controller = failing(fail, after=0)(prepared.controller)  # type: ignore[arg-type]
    with pytest.raises(DocumentError, match=says):
        rehearse(replace(prepared, controller=law), keeps_deadline=False)


def test_a_wrong_scenario_is_found_before_the_flight(tmp_path: Path) -> None:
    scenario = tmp_path / "bad.yaml"
    scenario.write_text("conditions: {wind_ned_mps: [1, 2]}\n")
    with pytest.raises(DocumentError, match="wind_ned_mps"):
        Simulated(scenario=str(scenario)).check()
