"""The search for failures, and the figures of campaigns, against known answers."""

from __future__ import annotations

import io
import math
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from browser import opening
from rich.console import Console

from offboard.campaign.campaign import Campaign
from offboard.campaign.cases import Case
from offboard.campaign.document import read_campaign
from offboard.campaign.evaluate import Evaluator, Interrupted
from offboard.campaign.execution import Workers
from offboard.campaign.flight import Job
from offboard.campaign.margin import LOWEST, Promises, terms
from offboard.campaign.page import CAMPAIGN, page
from offboard.campaign.progress import Counter
from offboard.campaign.results import Record
from offboard.campaign.searchers import SEARCHERS
from offboard.campaign.statistics import groups, wilson
from offboard.campaign.table import row_of
from offboard.campaign.worst import as_csv, search_of
from offboard.documents.errors import UserError
from offboard.link import clock

SEARCH = """
controllers: [lqr]
references: [hover]
scenarios: [{name: still, conditions: {wind_ned_mps: [0, 0, 0], gusts: {intensity_mps: 0}}}]
search:
  flights: 200
  seeds: 4
  ranges:
    scenario.conditions.wind_ned_mps.0: [-4, 4]
    scenario.conditions.wind_ned_mps.1: [-4, 4]
    scenario.conditions.gusts.intensity_mps: [0, 1]
    controller.bandwidth_radps: [2, 8]
  defaults: {controller.bandwidth_radps: 5}
"""
NORTH, EAST = "scenario.conditions.wind_ned_mps.0", "scenario.conditions.wind_ned_mps.1"
GUSTS, BANDWIDTH = "scenario.conditions.gusts.intensity_mps", "controller.bandwidth_radps"


class Known(Workers):
    """Workers whose flights fail in two small regions: wind from the south with a high bandwidth
    (seeds up to 3), and gusts with wind from the west."""

    def fly(self, jobs: Sequence[Job], ending: Callable[[], bool]) -> Iterator[tuple[Job, Record]]:
        for job in jobs:
            if not ending():
                yield job, self.record(job.case)

    @staticmethod
    def record(case: Case) -> Record:
        at = dict(case.values)
        hot = math.hypot(at[NORTH] - 3.4, at[BANDWIDTH] - 7.4) - 0.5 + (case.seed > 3)
        rough = max(3.0 - at[EAST], 4.0 * (0.8 - at[GUSTS]))
        margins = {"error": hot, "tilt": rough}
        weakest = min(margins, key=lambda name: margins[name])
        return Record(0, "flown and landed", margins[weakest], weakest, {}, margins)


def searched(directory: Path, text: str = SEARCH, **options: Any) -> tuple[Campaign, Evaluator]:
    file = directory / "c.yaml"
    file.write_text(text)
    campaign = Campaign(*read_campaign(str(file)), directory / "out")
    ending = options.get("ending", lambda: False)
    workers = Known(1, lambda: pytest.fail("not used"))
    return campaign, Evaluator(campaign.results, Promises(), workers, ending)


def test_failures_that_differ_are_found_and_reduced_to_their_causes(tmp_path: Path) -> None:
    campaign, evaluator = searched(tmp_path)
    failures = search_of(campaign, "c.yaml", evaluator).find(2)
    found = {failure.kind: failure for failure in failures}
    assert set(found) == {("error", (NORTH, BANDWIDTH)), ("tilt", (EAST, GUSTS))}
    hot, rough = found["error", (NORTH, BANDWIDTH)], found["tilt", (EAST, GUSTS)]
    assert (hot.failing, hot.seeds) == (2, 4)  # seeds 2 .. 5, of which 4 and 5 do not fail
    assert (rough.failing, rough.seeds) == (4, 4)
    assert "wind_ned_mps:\n  - 0.0\n" in rough.case.text  # north is back at its default
    assert "--set controller.bandwidth_radps=7." in as_csv(failures)


def test_an_interrupted_search_goes_on_and_finds_the_same(tmp_path: Path) -> None:
    for name in ("whole", "parts"):
        (tmp_path / name).mkdir()
    whole = search_of(*_named(searched(tmp_path / "whole"))).find(2)
    left = [70]

    def ending() -> bool:
        left[0] -= 1
        return left[0] < 0

    campaign, evaluator = searched(tmp_path / "parts", ending=ending)
    with pytest.raises(Interrupted):
        search_of(campaign, "c.yaml", evaluator).find(2)
    assert campaign.results.finished() == 70
    parts = search_of(*_named(searched(tmp_path / "parts"))).find(2)
    assert as_csv(parts) == as_csv(whole)


def test_a_search_without_the_package_of_its_method_flies_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    campaign, evaluator = searched(tmp_path)
    monkeypatch.setitem(sys.modules, "cma", None)
    with pytest.raises(UserError, match="needs the package cma"):
        search_of(campaign, "c.yaml", evaluator).find(2)
    assert campaign.results.finished() == 0


def test_the_flights_of_a_search_are_one_group(tmp_path: Path) -> None:
    campaign, evaluator = searched(tmp_path)
    search_of(campaign, "c.yaml", evaluator).find(2)
    campaign.cases = list(evaluator.flown)
    campaign.write(campaign.rows())
    shown = (tmp_path / "out" / "campaign.html").read_text()
    assert shown.count(f"{BANDWIDTH}=") < 100  # of the worst flights alone, not of 200 groups


def _named(made: tuple[Campaign, Evaluator]) -> tuple[Campaign, str, Evaluator]:
    return made[0], "c.yaml", made[1]


@pytest.mark.parametrize("method", ["swarm", "cma"])
def test_a_searcher_finds_a_corner_that_random_points_miss(method: str) -> None:
    """Six dimensions, 300 points: the mean distance of the best to the minimum, over five seeds."""
    centre = np.array([0.9, 0.1, 0.8, 0.3, 0.95, 0.6])

    def best(name: str, seed: int) -> float:
        searcher, found = SEARCHERS[name](6, 20, seed), math.inf
        for _ in range(15):
            points = searcher.ask()
            assert points.shape == (20, 6)
            assert np.all((points >= 0.0) & (points <= 1.0))
            costs = np.linalg.norm(points - centre, axis=1)
            searcher.tell(costs.tolist())
            found = min(found, float(costs.min()))
        return found

    means = [np.mean([best(name, seed) for seed in range(5)]) for name in (method, "random")]
    assert means[0] < 0.5 * means[1]


def test_the_interval_of_a_success_rate_is_wilsons() -> None:
    z, n, p = 1.959963985, 20, 18 / 20
    middle = (p + z * z / (2 * n)) / (1 + z * z / n)
    half = z / (1 + z * z / n) * math.sqrt(p * (1 - p) / n + z * z / (4 * n * n))
    assert wilson(18, 20) == pytest.approx((middle - half, middle + half), rel=1e-8)
    assert wilson(0, 5)[0] == 0.0


def test_the_time_left_counts_the_flights_of_this_run(monkeypatch: pytest.MonkeyPatch) -> None:
    """100 flights, of which an earlier run has flown 40; one in 2 s."""
    now_s = [0.0]
    monkeypatch.setattr(clock, "monotonic_s", lambda: now_s[0])
    told = Console(file=io.StringIO(), width=80)
    counter = Counter(told)
    counter.count(0, 100)
    for done in range(41, 101):
        now_s[0] += 2.0
        counter.count(done, 100)
    lines = told.file.getvalue().splitlines()  # type: ignore[attr-defined]
    assert lines[0] == "0 of 100 flights"
    assert "45 of 100 flights, 30 a minute, 2 min left" in lines
    assert "95 of 100 flights, 30 a minute, 10 s left" in lines
    assert len(lines) == 13


class Empty:
    """A flight without positions, and a law without keep-out volumes."""

    phases = ()
    truth = position = np.empty((0, 4))


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({}, ("touchdown", 0.75)),
        ({"max_position_m": 0.6}, ("error", -0.2)),
        ({"tilt_max_deg": 54.0}, ("tilt", 0.1)),
        ({"link_delay_p99_ms": 450.0}, ("age", 0.1)),
        ({"at_bound_share": 0.75}, ("authority", -0.5)),
        ({"completed": 0.0}, ("completed", -1.0)),
        ({"max_position_m": 500.0}, ("error", LOWEST)),
        ({"max_position_m": math.nan}, ("touchdown", 0.75)),
    ],
)
def test_margin(changes: dict[str, float], expected: tuple[str, float]) -> None:
    figures = {
        "max_position_m": 0.0, "tilt_max_deg": 0.0, "link_delay_p99_ms": 0.0,
        "at_bound_share": 0.0, "touchdown_mps": 0.5, "completed": 1.0, **changes,
    }  # fmt: skip
    found = terms(Promises(), figures, Empty(), None)  # type: ignore[arg-type]
    weakest = min(found, key=lambda name: found[name])
    assert (weakest, found[weakest]) == (expected[0], pytest.approx(expected[1]))


def test_the_page_shows_groups_and_worst_flights_without_a_network(tmp_path: Path) -> None:
    case = Case("flight", "pso", "lemniscate", None, None, "px4", "calm", 1)
    rows = [
        row_of(
            replace(case, scenario=scenario, seed=seed),
            Record(
                4 * (seed == 3), "aborted <b>here</b>" if seed == 3 else "flown and landed",
                -1.0 if seed == 3 else 0.9, "error",
                {"rmse_position_m": seed * error_m, "max_position_m": 0.02 * seed},
            ),
            (),
        )
        for scenario, error_m in (("calm", 1e-5), ("px4_like", 0.01))
        for seed in range(1, 7)
    ]  # fmt: skip
    file = tmp_path / "campaign.html"
    file.write_text(page(groups(rows), CAMPAIGN, ["2 of 14 flights"], {}), encoding="utf-8")
    with opening(file, width=400) as opened:
        for width in (1280, 400):
            opened.resize(width)
            assert opened.width_px() == width
            assert opened.unreadable() == opened.colliding() == opened.problems == []
        told = opened.page.inner_text("main")
    for words in ("10 of 12 flights", "5 of 6", "aborted <b>here</b>", "--seed 3", "2 of 14"):
        assert words in told, words
