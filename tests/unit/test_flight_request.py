"""The vehicle parameters that a flight begins with."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from offboard.run.request import FlightRequest


@pytest.mark.parametrize(
    ("asked", "expected"),
    [
        ({}, "neutral"),
        ({"sitl": True}, "px4_sih"),
        ({"sitl": True, "firmware": "ardupilot"}, "arducopter"),
        ({"sitl": True, "choices": {"vehicle": "neutral"}}, "neutral"),
        ({"sitl": True, "assignments": ("vehicle=neutral",)}, "neutral"),
        ({"sitl": True, "firmware": "ardupilot", "config": "paper"}, "px4_sih"),
        ({"choices": {"vehicle": "arducopter"}}, "arducopter"),
    ],
)
def test_vehicle_is_neutral_unless_one_is_named_or_the_simulator_flies_its_own(
    asked: dict[str, Any], expected: str
) -> None:
    assert FlightRequest(Path("unused"), **asked).resolve().vehicle.name == expected
