"""Every controller of the table flies, from its shipped file, through the whole flight."""

from __future__ import annotations

from pathlib import Path

import pytest
from pair import Pair, make

from offboard.control.catalogue import LAWS

# RMSE in m that is to be undercut in calm; the paper's law has a time constant of 39 s
MOST_M = dict.fromkeys(LAWS, 0.01) | {"paper": 2.5}
SHORT = ("reference.laps=1", "reference.period_s=6", "reference.half_length_m=1")


def flying(controller: str, tmp_path: Path, *assignments: str, **options: object) -> Pair:
    """A pair that flies the shipped `controller`."""
    chosen = tmp_path / "chosen.yaml"
    chosen.write_text(f"vehicle: px4_sih\ncontroller: {controller}\nreference: lemniscate\n")
    return make(*assignments, name=str(chosen), **options)


@pytest.mark.parametrize("law", LAWS)
def test_flies_a_short_lemniscate_and_lands(law: str, tmp_path: Path) -> None:
    pair = flying(law, tmp_path, *SHORT)
    outcome = pair.fly()
    assert (outcome.exit_code, outcome.sentence) == (0, "flown and landed")
    score = pair.score(tmp_path)
    assert score.rmse_position_m < MOST_M[law]
    assert score.tracked_s == pytest.approx(6.0, abs=0.3)
    assert not pair.instance.autopilot.armed
