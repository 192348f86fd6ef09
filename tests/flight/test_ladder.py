"""The ladder: how long a condition must hold, how it is forgotten, and which row counts.

Steps of 1/8 s, which add up exactly. Row "link" takes HOLD after 0.5 s, "tilt error" LAND after
0.5 s, "battery" LAND after 2 s; "authority" takes LAND at once.
"""

from __future__ import annotations

from dataclasses import replace

import pytest
from uneventful import UNEVENTFUL

from offboard.flight.facts import Facts
from offboard.flight.ladder import Ladder
from offboard.flight.phases import Limits, Rung

STEP_S = 0.125
QUIET = UNEVENTFUL
LINK = replace(QUIET, link_growth_s=0.31)
TILT_ERROR = replace(QUIET, tilt_error_rad=0.51)
BATTERY = replace(QUIET, battery=0.09)


def rungs(*facts: Facts) -> list[Rung]:
    ladder, seen = Ladder(), []
    for number, now in enumerate(facts):
        ladder.step(now, 100.0 + STEP_S * number)
        seen.append(ladder.rung)
    return seen


def test_nothing_happens() -> None:
    assert set(rungs(*[QUIET] * 100)) == {Rung.FLY}


def test_a_condition_counts_for_as_long_as_it_holds() -> None:
    assert rungs(*[LINK] * 6) == [Rung.FLY] * 4 + [Rung.HOLD] * 2
    assert rungs(QUIET, *[BATTERY] * 17)[-3:] == [Rung.FLY, Rung.LAND, Rung.LAND]


def test_a_row_is_active_only_while_its_condition_holds() -> None:
    assert rungs(*[LINK] * 5, QUIET)[-2:] == [Rung.HOLD, Rung.FLY]


@pytest.mark.parametrize(("pause", "again"), [(1, 1), (4, 1), (8, 2), (16, 4), (100, 4)])
def test_it_is_forgotten_at_a_quarter_of_the_speed(pause: int, again: int) -> None:
    """Four steps of condition, `pause` of none; then it takes `again` steps to be active."""
    seen = rungs(QUIET, *[LINK] * 4, *[QUIET] * pause, *[LINK] * 8)
    after = seen[5 + pause :]
    assert after.index(Rung.HOLD) + 1 == again


def test_a_condition_that_comes_and_goes() -> None:
    """Half of the time it gains 3/32 s in two steps: active in the fifth; a fifth: never."""
    half = rungs(QUIET, *[LINK, QUIET] * 40)
    assert half.index(Rung.HOLD) == 9
    assert Rung.HOLD not in rungs(QUIET, *[LINK, QUIET, QUIET, QUIET, QUIET] * 100)


def test_the_worst_active_row_counts() -> None:
    both = replace(LINK, tilt_error_rad=0.51)
    assert rungs(QUIET, *[both] * 4)[-1] is Rung.LAND
    assert rungs(QUIET, *[both] * 4, *[LINK] * 2)[-1] is Rung.HOLD
    assert rungs(QUIET, *[TILT_ERROR] * 2, *[LINK] * 3)[-1] is Rung.FLY


def test_of_rows_of_one_rung_the_report_of_the_mode_is_named() -> None:
    """Without it no other row has an effect."""
    unknown = replace(LINK, authority_known=False, tilt_rad=1.4, battery=0.0)
    ladder = Ladder()
    ladder.step(unknown, 0.0)
    assert ladder.rung is Rung.LAND
    assert ladder.worst is not None
    assert ladder.worst.name == "authority"


@pytest.mark.parametrize(
    ("name", "limit", "rung"),
    [
        ("silence_s", Limits().silence_s, Rung.LAND),
        ("blind_s", Limits().blind_s, Rung.LAND),
        ("telemetry_age_s", Limits().setpoint_age_s, Rung.LEVEL),
        ("tilt_rad", Limits().tilt_rad, Rung.LAND),
        ("position_error_m", Limits().position_error_m, Rung.LAND),
        ("height_m", Limits().ceiling_m, Rung.LAND),
        ("distance_m", Limits().radius_m, Rung.LAND),
        ("clock_jump_s", 0.0, Rung.LAND),
        ("missed_decisions", 0, Rung.LEVEL),
        ("missed_decisions", 2, Rung.LAND),
    ],
)
def test_rows_without_delay(name: str, limit: float, rung: Rung) -> None:
    at_limit, beyond = (replace(QUIET, **{name: value}) for value in (limit, limit + 1))
    assert rungs(beyond) == [rung]
    assert rungs(at_limit)[0] < rung


@pytest.mark.parametrize(("allowed", "rung"), [(False, Rung.HOLD), (True, Rung.FLY)])
def test_a_second_sender(allowed: bool, rung: Rung) -> None:
    limits = Limits(begin_with_other_sender=allowed)
    assert rungs(replace(QUIET, other_sender=True, limits=limits)) == [rung]


@pytest.mark.parametrize(("sink_mps", "rung"), [(0.4, Rung.LAND), (0.2, Rung.FLY)])
def test_a_vehicle_that_sinks_with_full_thrust(sink_mps: float, rung: Rung) -> None:
    """After a second: full thrust brakes a normal descent sooner."""
    now = replace(QUIET, full_thrust_sink_mps=sink_mps)
    seen = rungs(QUIET, *[now] * 9)
    assert set(seen[:8]) == {Rung.FLY}
    assert seen[8] == rung


@pytest.mark.parametrize(
    ("engaged", "allowed", "rung"),
    [(True, False, Rung.HOLD), (False, False, Rung.FLY), (True, True, Rung.FLY)],
)
def test_a_vehicle_that_follows_other_setpoints(engaged: bool, allowed: bool, rung: Rung) -> None:
    """Only while the vehicle is in our mode; allowed like a second sender."""
    limits = Limits(begin_with_other_sender=allowed)
    now = replace(QUIET, follows_others=True, engaged=engaged, limits=limits)
    assert rungs(now, *[now] * 25)[-1] == rung


def test_time_that_steps_back_counts_for_nothing() -> None:
    ladder = Ladder()
    for time_s in (100.0, 100.1875, 100.375, 50.0, 50.125):
        ladder.step(LINK, time_s)
    assert ladder.rung is Rung.HOLD
    ladder = Ladder()
    for time_s in (100.0, 100.1875, 100.375, 50.0, 50.0625):
        ladder.step(LINK, time_s)
    assert ladder.rung is Rung.FLY


def test_one_sample_after_a_gap_of_telemetry_is_no_condition_that_has_held() -> None:
    ladder = Ladder()
    ladder.step(QUIET, 100.0)
    ladder.step(TILT_ERROR, 100.8)
    assert ladder.rung is Rung.FLY
