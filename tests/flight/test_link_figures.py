"""Links that delay, lose or repeat messages: which metrics of the score show this, and how well the
vehicle is flown. The oracle is the parameter of the fault."""

from __future__ import annotations

from itertools import pairwise
from statistics import median

import pytest
from faults import both, late, losing, repeating, stuttering
from pair import Filter, Pair, in_phase, make, through

from offboard.flight.phases import Phase
from offboard.identification.learner import IdentifySettings

LAP = ("controller={law: lqr}", "reference.laps=1", "reference.height_m=1.0")
PLAIN_DELAY_MS = 57.0  # delay of the vehicle itself
SENT_HZ = 50.0


def over(down: Filter, *assignments: str, aloft: bool = True, **options: object) -> Pair:
    lap = assignments or LAP
    learning = options.pop("learning", IdentifySettings())
    return make(*lap, scenario="px4_like", vehicle="px4_sih", down=down, learning=learning,
                aloft=aloft, **options)  # fmt: skip


@pytest.mark.parametrize(
    ("down", "stale_share", "later_ms", "rmse_m"),
    [
        (both(late(0.08), repeating(0.1)), 2.0 / 3.0, 80.0, 0.06),
        pytest.param(stuttering(0.08, 0.4), 0.0, 0.0, 0.10, marks=pytest.mark.slow),
    ],
    ids=["80 ms late, all messages three times", "stops for 80 ms in 400"],
)
def test_score_measures_link_delay_and_duplicates(
    down: Filter, stale_share: float, later_ms: float, rmse_m: float
) -> None:
    pair = over(down)
    pair.track()
    score = pair.score()
    assert score.stale_share == pytest.approx(stale_share, abs=0.01)
    assert score.delay_ms == pytest.approx(PLAIN_DELAY_MS + later_ms, abs=10.0)
    assert 0.0 < score.delay_sd_ms < 10.0
    assert score.link_delay_p50_ms == pytest.approx(later_ms, abs=5.0)
    assert score.rmse_position_m < rmse_m
    assert score.setpoint_hz == pytest.approx(10.0, rel=0.1)  # no setpoint is sent twice
    assert score.position_hz == pytest.approx(SENT_HZ, rel=0.02)
    assert score.position_gap_max_s == pytest.approx(1.0 / SENT_HZ, abs=0.007)


def test_setpoints_are_sent_twice_on_a_lossy_link() -> None:
    """Each setpoint is sent again after half a period. The RMSE of this lap is 0.20 m if they are
    sent once; with the repeats it is 0.035 to 0.049 m for nine of ten seeds."""
    pair = over(through)
    pair.up = losing(0.3, seed=5)
    pair.track()
    times = [at_s for at_s, phase, _ in pair.setpoints if phase is Phase.TRACK]
    gaps = [after - before for before, after in pairwise(times)]
    assert median(gaps) == pytest.approx(0.05, abs=0.011)  # telemetry comes every 20 ms
    score = pair.score()
    assert score.setpoint_hz == pytest.approx(20.0, rel=0.1)
    assert score.rmse_position_m < 0.06
    assert sum("each setpoint is sent twice" in line for line in pair.companion.announced) == 1


# -- a link that becomes later in flight: TIMESYNC and the age of telemetry show it ----------------

CHANGED_S, BACK_S = 2.0, 8.0  # times since the begin of TRACK
CONFIGURED_RADPS = 7.0


@pytest.mark.parametrize(
    ("direction", "most_m"), [("down", 0.15), pytest.param("up", 0.2, marks=pytest.mark.slow)]
)
def test_growing_link_delay_lowers_the_bandwidth(direction: str, most_m: float) -> None:
    """The link becomes late in flight, and later prompt again. If the delay were assumed to be that
    at takeoff, 0.2 s more would cause an error of 2.1 m."""
    pair = over(through, "reference.height_m=3.0", aloft=False, boot_scale=1.0)
    limits: list[tuple[float, float]] = []  # begin, and limit of the bandwidth

    def note(flying: Pair) -> None:
        limit = flying.companion.controller.bandwidth.lateral_radps
        if in_phase(Phase.TRACK, CHANGED_S)(flying) and limit not in [x for _, x in limits[-1:]]:
            limits.append((flying.time_s, limit))

    for at_s, link in ((CHANGED_S, late(0.2)), (BACK_S, through)):
        change = lambda flying, link=link: setattr(flying, direction, link)  # noqa: E731
        pair.at.append((in_phase(Phase.TRACK, at_s), change))
    pair.every(1, note)
    pair.track()
    (changed_s, configured), (lowered_s, lowered), *_ = limits
    assert configured == CONFIGURED_RADPS
    assert lowered_s - changed_s <= 0.9
    assert 3.5 <= lowered < CONFIGURED_RADPS - 0.5
    stayed = [limit for at_s, limit in limits if at_s - changed_s < BACK_S - CHANGED_S]
    assert stayed[-1] == CONFIGURED_RADPS  # a delay that stays is compensated
    assert limits[-1][1] == CONFIGURED_RADPS  # also when the link is prompt again
    assert pair.score().max_position_m < most_m
    lines = pair.companion.announced
    grown, *_ = (line for line in lines if "limited" in line and "grown" in line)
    assert ": the link's delay has grown by 200 ms" in grown
    assert not any("grown by 0 ms" in line for line in lines)
    assert not any("contradicts" in line for line in lines)
    assert any("the link's delay has changed by 200 ms lately" in line for line in lines)
