"""Whole flights at every heading, through the wrap, climbing and descending; and one sign swapped
on the wire, which none of them survives."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pair import Pair, make

from offboard.mavlink.outgoing import AttitudeTarget

Triple = tuple[int, int, int]

TURNING = ("reference.course=along_velocity", "reference.laps=1", "reference.period_s=6",
           "reference.radius_m=1")  # fmt: skip


def on_a_helix(climb_mps: float, height_m: float) -> Pair:
    """One lap with the nose ahead: from east through south, west and north to east again."""
    climb = f"reference.climb_mps={climb_mps}"
    return make(*TURNING, climb, f"reference.height_m={height_m}", reference="helix", aloft=True)


@pytest.mark.parametrize(("climb_mps", "height_m"), [(0.4, 3.0), (-0.4, 7.0)])
def test_turning_through_all_headings(climb_mps: float, height_m: float, tmp_path: Path) -> None:
    pair = on_a_helix(climb_mps, height_m)
    pair.track()
    score = pair.score(tmp_path)
    assert score.rmse_position_m < 0.01
    assert score.rmse_heading_deg < 2.0


def test_facing_south(tmp_path: Path) -> None:
    """The reported heading jumps between both sides of the wrap."""
    pair = make("reference.course_deg=180", "reference.laps=1", scenario="px4_like", aloft=True)
    pair.track()
    score = pair.score(tmp_path)
    assert score.rmse_position_m < 0.05
    assert score.rmse_heading_deg < 2.0


def swapped(monkeypatch: pytest.MonkeyPatch, sign: Callable[[AttitudeTarget], Any]) -> Pair:
    """The climbing flight, with what `sign` makes of each target on the wire."""
    unchanged = AttitudeTarget.attitude
    monkeypatch.setattr(AttitudeTarget, "attitude", lambda target: unchanged(sign(target)))
    return on_a_helix(0.4, 3.0)


@pytest.mark.parametrize("signs", [(-1, 1, 1), (1, -1, 1)])
def test_a_swapped_lean_is_stopped(signs: Triple, monkeypatch: pytest.MonkeyPatch) -> None:
    def sign(target: AttitudeTarget) -> AttitudeTarget:
        north, east, down = np.multiply(signs, target.thrust_direction_ned).tolist()
        return replace(target, thrust_direction_ned=(north, east, down))

    outcome = swapped(monkeypatch, sign).fly()
    assert outcome.exit_code == 4
    assert "deg away from every recent command" in outcome.sentence


def test_a_swapped_heading_is_scored(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pair = swapped(monkeypatch, lambda target: replace(target, heading_rad=-target.heading_rad))
    pair.track()  # b does not depend on it
    assert pair.score(tmp_path).rmse_heading_deg > 60.0
