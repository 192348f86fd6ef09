"""The vehicle parameters that a flight begins with."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from offboard.analysis import trial as trials
from offboard.analysis.compare import Trial
from offboard.io.link import LinkError
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
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    assignments: tuple[str, ...],
    allowed: bool,
) -> None:
    flown: list[FlightRequest] = []

    def refuses(order: FlightRequest, simulator: object) -> None:
        flown.append(order)
        raise LinkError("unused")

    monkeypatch.setattr(trials, "fly_request", refuses)
    trial = Trial("lqr", "hover", "connected", 1, tmp_path)
    trials.fly_trial(FlightRequest(tmp_path, assignments=assignments), trial)
    assert [order.resolve().limits.begin_armed for order in flown] == [allowed]
    assert FlightRequest(tmp_path).resolve().limits.begin_armed
