"""Off the path at bandwidth 7, on a vehicle whose attitude loop has a limit on its acceleration."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from pair import Pair, in_phase, make
from test_ardupilot import on_arducopter

from offboard.analysis import history
from offboard.flight.phases import Phase
from simulator import config as simulated

SETTLED_S, END_S = 9.0, 14.0
HOVER = (f"reference.duration_s={END_S}", "controller.bandwidth_radps=7")


def like_arducopter(personality: str, *assignments: str) -> Pair:
    """ArduCopter's vehicle (1100 deg/s2) behind either firmware, hovering; after two seconds it
    finds itself 2.4 m off."""
    if personality == "ardupilot":
        pair = on_arducopter(*HOVER, *assignments, reference="hover", seed=2)
    else:
        vehicle = simulated.vehicle("arducopter")
        pair = make(
            *HOVER, *assignments, reference="hover", seed=2, vehicle="arducopter", flies=vehicle
        )
    off = (2.4, 0.0, 0.0)
    jump = (
        in_phase(Phase.TRACK, 2.0),
        lambda flying: flying.instance.autopilot.plant.reset_estimate(off),
    )
    pair.at.append(jump)
    return pair


def swing(pair: Pair, directory: Path) -> tuple[float, float]:
    """Largest distance from the path (m) and rate (rad/s) once it should have settled."""
    assert pair.fly().exit_code == 0
    flown = history.gather(pair.log(directory))
    begin_s = next(at_s for at_s, phase in pair.phases if phase is Phase.TRACK)

    def settled(rows):
        inside = (rows[:, 0] > begin_s + SETTLED_S) & (rows[:, 0] < begin_s + END_S)
        return rows[inside]

    reference = settled(flown.reference)[0, 1:4]
    away = settled(flown.position)[:, 1:4] - reference
    rates = settled(flown.attitude)[:, 5:7]
    return float(np.linalg.norm(away, axis=1).max()), float(np.abs(rates).max())


@pytest.mark.parametrize("personality", ["px4", "ardupilot"])
def test_engaged_off_the_path_it_settles(personality: str, tmp_path: Path) -> None:
    away_m, rate_radps = swing(like_arducopter(personality), tmp_path)
    assert away_m < 0.005
    assert rate_radps < 0.02


@pytest.mark.parametrize("personality", ["px4", "ardupilot"])
def test_without_the_feedback_limit_it_cycles_for_good(personality: str, tmp_path: Path) -> None:
    """Which shows that the limit is what keeps it from cycling."""
    lifted = like_arducopter(personality, "controller.feedback_limit=1.0")
    away_m, rate_radps = swing(lifted, tmp_path)
    assert away_m > 0.005
    assert rate_radps > 0.3
