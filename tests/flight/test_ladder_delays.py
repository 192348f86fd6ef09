"""Delays of the ladder: when a row counts, and how a condition that comes and goes adds up."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import pytest
from uneventful import UNEVENTFUL

from offboard.flight.ladder import Ladder
from offboard.flight.phases import Rung

BAD = replace(UNEVENTFUL, tilt_error_rad=1.0)  # for 0.5 s
TICK_S = 0.1


def first_active_s(steps: Sequence[tuple[float, bool]]) -> float | None:
    """Time of the first step (time, exceeded) at which the vehicle shall land."""
    ladder = Ladder()
    for time_s, exceeded in steps:
        ladder.step(BAD if exceeded else UNEVENTFUL, time_s)
        if ladder.rung is Rung.LAND:
            return time_s
    return None


def ticks(pattern: str) -> list[tuple[float, bool]]:
    return [(TICK_S * number, mark == "x") for number, mark in enumerate(pattern)]


def test_a_row_counts_once_its_condition_has_held_for_its_delay() -> None:
    assert first_active_s(ticks("..xxxxxxxx")) == pytest.approx(0.7)
    assert first_active_s(ticks("..xxxxx...")) is None


def test_the_time_that_a_condition_has_held_runs_back_slowly() -> None:
    """0.4 s, less 0.4 s / 4, and 0.2 s more."""
    assert first_active_s(ticks("xxxxx....xxxx")) == pytest.approx(1.1)


def test_one_sample_after_a_gap_of_telemetry_is_no_condition_that_has_held() -> None:
    assert first_active_s([(0.0, False), (0.8, True), (0.9, False)]) is None
