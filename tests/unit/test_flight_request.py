"""The vehicle parameters that a flight begins with."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from offboard.campaign.cases import Case
from offboard.campaign.execution import ConnectedVehicle
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


@pytest.mark.parametrize(
    ("assignments", "allowed"), [((), False), (("limits.begin_armed=true",), True)]
)
def test_a_flight_that_is_compared_begins_disarmed_unless_told_otherwise(
    tmp_path: Path, assignments: tuple[str, ...], allowed: bool
) -> None:
    case = Case("flight", "lqr", "hover", None, None, "px4", "connected", 1, settings=assignments)
    request = ConnectedVehicle("udpin:127.0.0.1:0").request(case, tmp_path)
    assert request.resolve().limits.begin_armed is allowed
    assert FlightRequest(tmp_path).resolve().limits.begin_armed
