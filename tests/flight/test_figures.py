"""What a flight must achieve, in numbers: the default, the paper's law, and a bad one."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from pair import calm_hover, make

from offboard.analysis import history
from offboard.analysis.score import score
from offboard.flight.phases import Action, Phase
from offboard.identification.learner import IdentifySettings
from simulator import config as simulated


@pytest.mark.parametrize(
    ("scenario", "most_m"),
    [
        ("calm", 0.01),
        ("px4_like", 0.04),
        pytest.param("noise", 0.04, marks=pytest.mark.slow),
        pytest.param("thrust_minus_15", 0.02, marks=pytest.mark.slow),
        pytest.param("mass_plus_20", 0.03, marks=pytest.mark.slow),
        pytest.param("wind_2mps", 0.03, marks=pytest.mark.slow),
        pytest.param("gusts", 0.06, marks=pytest.mark.slow),
    ],
)
def test_default_flight(scenario: str, most_m: float, tmp_path: Path) -> None:
    """On a vehicle of which nothing is known: one profile for all rows, identified in flight."""
    neutral = simulated.vehicle("neutral")
    pair = make(scenario=scenario, believed=neutral, learning=IdentifySettings(), deadline_s=0.05)
    outcome = pair.fly()
    score = pair.score(tmp_path)
    assert (outcome.exit_code, outcome.sentence) == (0, "flown and landed")
    assert score.rmse_position_m <= most_m
    assert score.tracked_s == pytest.approx(16.0, abs=0.3)
    assert score.setpoint_gap_max_s <= 0.12
    assert score.missed_ticks == 0
    assert score.gap_median <= 1e-9
    assert max(pair.failsafes.values(), default=Action.FLY) <= Action.LEVEL
    assert abs(pair.instance.autopilot.state.truth.position_ned_m[2]) < 0.05
    assert not pair.instance.autopilot.commander.armed


@pytest.mark.slow  # in calm: test_laws
def test_paper_law_flies_and_lands(tmp_path: Path) -> None:
    pair = make("reference.laps=1", "reference.height_m=1.0", name="paper", scenario="px4_like")
    assert pair.fly().exit_code == 0
    assert pair.went_through(Phase.TRACK)
    assert 0.1 < pair.score(tmp_path).rmse_position_m < 2.5


def test_a_log_with_parts_missing_is_scored_as_far_as_it_goes(tmp_path: Path) -> None:
    flown = history.gather(calm_hover().log(tmp_path))
    whole = score(flown)
    assert whole.rmse_position_m < 0.05
    for part in ("position", "attitude", "setpoint", "reference"):
        rows = getattr(flown, part)
        for kept in (rows[:0], rows[:1]):
            assert math.isnan(score(replace(flown, **{part: kept})).rmse_position_m)
    twice = np.concatenate((flown.reference, flown.reference))
    assert score(replace(flown, reference=twice)).rmse_position_m == whole.rmse_position_m


def test_every_setpoint_is_finite_and_within_the_vehicle() -> None:
    fast = ("reference.laps=1", "reference.height_m=1.0")
    pair = make(*fast, scenario="px4_like", reference="lemniscate_4mps")
    assert pair.fly().exit_code == 0
    for _, _, setpoint in pair.setpoints:
        w, x, y, z = setpoint.q
        assert math.sqrt(w * w + x * x + y * y + z * z) == pytest.approx(1.0, abs=1e-6)
        assert 0.0 <= setpoint.thrust <= 1.0
        assert 1.0 - 2.0 * (x * x + y * y) >= math.cos(0.785) - 1e-6
        assert setpoint.type_mask == 7


@pytest.mark.slow
def test_a_wide_fast_circle_that_begins_far_away(tmp_path: Path) -> None:
    """7.5 m/s at 39 degrees of tilt, 60 m from the take-off point."""
    wide = {"radius_m": 30, "period_s": 25, "laps": 1, "run_in_s": 8, "origin_north_m": 50}
    assignments = (f"reference.{key}={value}" for key, value in wide.items())
    pair = make(*assignments, scenario="px4_like", reference="circle_course", aloft=True)
    pair.track()
    assert pair.score(tmp_path).rmse_position_m < 0.08
