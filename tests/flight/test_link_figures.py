"""What the link was like, in the score, and that telemetry is taken at its vehicle time.

Each link is one fault laid over the same flight; the oracle is what the fault was told to do.
"""

from __future__ import annotations

from pathlib import Path

import pytest
from faults import late, losing, repeating, stuttering
from pair import Filter, make, through

from offboard.analysis.score import Score
from offboard.flight.learning import IdentifySettings

LAP = ("controller={law: lqr}", "reference.laps=1", "reference.height_m=1.0")
PLAIN_DELAY_MS = 57.0  # of the vehicle itself
SENT_HZ = 100.0


def flown_over(down: Filter, directory: Path) -> Score:
    pair = make(
        *LAP, scenario="px4_like", vehicle="px4_sih", down=down, learning=IdentifySettings()
    )
    assert pair.fly().exit_code == 0
    return pair.score(directory)


@pytest.mark.parametrize(
    ("down", "stale_share", "later_ms", "rmse_m"),
    [
        (through, 0.0, 0.0, 0.05),
        (late(0.08), 0.0, 80.0, 0.06),
        (repeating(0.1), 2.0 / 3.0, 0.0, 0.05),
        (stuttering(0.08, 0.4), 0.0, 0.0, 0.10),
    ],
    ids=["plain", "80 ms late", "everything three times", "stops for 80 ms in 400"],
)
def test_delay_and_repetitions_are_told(
    down: Filter, stale_share: float, later_ms: float, rmse_m: float, tmp_path: Path
) -> None:
    score = flown_over(down, tmp_path)
    assert score.stale_share == pytest.approx(stale_share, abs=0.01)
    assert score.delay_ms == pytest.approx(PLAIN_DELAY_MS + later_ms, abs=10.0)
    assert 0.0 < score.delay_sd_ms < 10.0
    assert score.rmse_position_m < rmse_m
    assert score.position_hz == pytest.approx(SENT_HZ, rel=0.02)
    assert score.position_gap_max_s == pytest.approx(1.0 / SENT_HZ, abs=0.007)


def test_gaps_of_a_link_that_loses_are_told(tmp_path: Path) -> None:
    score = flown_over(losing(0.3), tmp_path)
    assert 0.04 <= score.position_gap_max_s < 0.3
    assert score.position_hz == pytest.approx(0.7 * SENT_HZ, rel=0.1)
