"""A step of the reference at 7 rad/s; the attitude loop limits its angular acceleration."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from pair import Pair, in_phase, make, on_arducopter

from offboard.analysis import history
from offboard.flight.phases import Phase
from simulator import config as simulated

SETTLED_S, END_S = 15.0, 19.0
HOVER = (f"reference.duration_s={END_S}", "controller.bandwidth_radps=7")


def like_arducopter(personality: str, *assignments: str) -> Pair:
    """ArduCopter's vehicle (1100 deg/s2) with either firmware, in hover; after two seconds the
    reference jumps by 2.4 m, and returns slowly."""
    if personality == "ardupilot":
        pair = on_arducopter(*HOVER, *assignments, reference="hover", seed=2)
    else:
        vehicle = simulated.vehicle("arducopter")
        pair = make(
            *HOVER, *assignments, reference="hover", seed=2, vehicle="arducopter", flies=vehicle
        )
    off = np.array([2.4, 0.0, 0.0])

    def step(flying: Pair) -> None:
        state = flying.companion
        state.plan.follow_jump(state.time_s, off)

    pair.at.append((in_phase(Phase.TRACK, 2.0), step))
    return pair


def swing(pair: Pair, directory: Path) -> tuple[float, float]:
    """Largest distance from the reference (m) and rate (rad/s) after the settling time."""
    pair.track()
    flown = history.gather(pair.log(directory))
    begin_s = next(at_s for at_s, phase in pair.phases if phase is Phase.TRACK)

    def settled(rows):
        inside = (rows["time_s"] > begin_s + SETTLED_S) & (rows["time_s"] < begin_s + END_S)
        return rows[inside]

    reference = settled(flown.reference)["position_ned_m"][0]
    away = settled(flown.position)["position_ned_m"] - reference
    rates = settled(flown.attitude)["rates_radps"][:, :2]
    return float(np.linalg.norm(away, axis=1).max()), float(np.abs(rates).max())


@pytest.mark.parametrize("personality", ["px4", "ardupilot"])
def test_settles_after_a_step_of_the_reference(personality: str, tmp_path: Path) -> None:
    away_m, rate_radps = swing(like_arducopter(personality), tmp_path)
    assert away_m < 0.005
    assert rate_radps < 0.02


@pytest.mark.parametrize("personality", [pytest.param("px4", marks=pytest.mark.slow), "ardupilot"])
def test_limit_cycle_without_the_feedback_limit(personality: str, tmp_path: Path) -> None:
    """Shows that `feedback_limit` prevents the limit cycle."""
    lifted = like_arducopter(personality, "controller.feedback_limit=1.0")
    away_m, rate_radps = swing(lifted, tmp_path)
    assert away_m > 0.005
    assert rate_radps > 0.3
