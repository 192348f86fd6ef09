"""The vehicle parameters that a flight begins with."""

from __future__ import annotations

from typing import Any

import pytest

from offboard.run.configuration import load
from offboard.run.flight import Simulated


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
def test_vehicle_is_neutral_unless_one_is_named_or_the_simulator_flies_its_own(
    asked: dict[str, Any], expected: str
) -> None:
    firmware, name = asked.pop("firmware", None), asked.pop("name", "flight")
    known = Simulated(firmware).known_vehicle if firmware else None
    assert load(name, known_vehicle=known, **asked).vehicle.name == expected
