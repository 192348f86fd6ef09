"""`--worst` and `tune`: failures reduced to their causes, a minimum confirmed, a profile flown."""

from __future__ import annotations

import io
import math
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

from offboard.campaign.cases import Case
from offboard.campaign.document import CampaignFile, Promises
from offboard.campaign.flight import Job
from offboard.campaign.results import Record, Results
from offboard.campaign.run import Campaign, Fly, Incomplete, Progress, flying
from offboard.campaign.search import Failure, FailureSearch, as_csv, ask, study_of
from offboard.campaign.tune import Tuned, TuneFile, Tuning, judge, profile
from offboard.documents.errors import DocumentError, UserError
from offboard.documents.reading import load_document
from offboard.run.configuration import load

SEARCH = """
controllers: [lqr]
references: [hover]
scenarios: [promises]
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
LIMIT = "controller.feedback_limit"


class Known:
    """Flies cases whose records are known, and no more than `most` of them."""

    def __init__(self, record: Callable[[Case], Record], most: float = math.inf) -> None:
        self._record = record
        self.left = most

    def fly(self, jobs: Sequence[Job], ending: Callable[[], bool]) -> Iterator[tuple[Job, Record]]:
        for job in jobs:
            self.left -= 1
            if self.left >= 0:
                yield job, self._record(job.case)


def known(results: Results, flyer: Known) -> AbstractContextManager[Fly]:
    progress = Progress(Console(file=io.StringIO()))
    return flying(results, Promises(), lambda: nullcontext(flyer), progress)


def two_regions(case: Case) -> Record:
    """Flights fail in wind from the south with a high bandwidth (seeds up to 3), and in gusts with
    wind from the west."""
    at = dict(case.values)
    hot = math.hypot(at[NORTH] - 3.4, at[BANDWIDTH] - 7.4) - 0.5 + (case.seed > 3)
    rough = max(3.0 - at[EAST], 4.0 * (0.8 - at[GUSTS]))
    margins = {"error": hot, "tilt": rough}
    weakest = min(margins, key=lambda name: margins[name])
    return Record(0, "flown and landed", margins[weakest], weakest)


def searched(
    directory: Path, most: float = math.inf, record: Callable[[Case], Record] = two_regions
) -> tuple[Campaign, list[Failure]]:
    directory.mkdir(exist_ok=True)
    file = directory / "c.yaml"
    file.write_text(SEARCH)
    campaign = Campaign(*load_document(str(file), "campaign", CampaignFile), directory / "out")
    with known(campaign.results, Known(record, most)) as fly:
        return campaign, FailureSearch(campaign, "c.yaml").find(2, fly)


@pytest.fixture(scope="module")
def whole_search(tmp_path_factory: pytest.TempPathFactory) -> tuple[Campaign, list[Failure]]:
    return searched(tmp_path_factory.mktemp("search") / "whole")


def test_search_reduces_failures_to_their_causes(
    whole_search: tuple[Campaign, list[Failure]],
) -> None:
    campaign, failures = whole_search
    found = {failure.kind: failure for failure in failures}
    assert set(found) == {("error", (NORTH, BANDWIDTH)), ("tilt", (EAST, GUSTS))}
    hot, rough = found["error", (NORTH, BANDWIDTH)], found["tilt", (EAST, GUSTS)]
    assert (hot.failing, hot.seeds) == (2, 4)  # seeds 2 .. 5, of which 4 and 5 do not fail
    assert (rough.failing, rough.seeds) == (4, 4)
    assert "wind_ned_mps:\n  - 0.0\n" in rough.case.scenario_text  # north is back at its default
    assert "--set controller.bandwidth_radps=7." in as_csv(failures)
    shown = (campaign.directory / "campaign.html").read_text()
    assert shown.count(f"{BANDWIDTH}=") < 100  # of the worst flights alone, not of 200 groups


def test_infeasible_values_do_not_count_as_failures(
    whole_search: tuple[Campaign, list[Failure]], tmp_path: Path
) -> None:
    """A third of the bandwidth's range cannot be flown; failures elsewhere are found as before."""

    def flown(case: Case) -> Record:
        if dict(case.values)[BANDWIDTH] < 4.0:
            return Record(2, "controller: it cannot be built", -2.0, "infeasible")
        return two_regions(case)

    _, failures = searched(tmp_path / "search", record=flown)
    assert {one.kind for one in failures} == {one.kind for one in whole_search[1]}


def test_interrupted_search_resumes_with_the_same_result(
    whole_search: tuple[Campaign, list[Failure]], tmp_path: Path
) -> None:
    whole, failures = whole_search
    with pytest.raises(Incomplete):
        searched(tmp_path / "parts", most=70)
    parts, again = searched(tmp_path / "parts")
    assert as_csv(again) == as_csv(failures)
    tables = [(each.directory / "campaign.csv").read_bytes() for each in (parts, whole)]
    assert tables[0] == tables[1]


def test_worst_failure_comes_first_after_its_reduction(tmp_path: Path) -> None:
    """Gusts only make failures of the first kind worse: reduced, the others are the worst."""

    def in_gusts(case: Case) -> Record:
        record, at = two_regions(case), dict(case.values)
        deeper = 5.0 * at[GUSTS] if record.weakest == "error" else 0.6
        return replace(record, margin=record.margin - deeper * (record.margin < 0.0))

    failures = searched(tmp_path, record=in_gusts)[1]
    assert [failure.record.weakest for failure in failures] == ["tilt", "error"]


def test_searched_seeds_are_whole_numbers() -> None:
    study = study_of(1)
    asked = [ask(study, {"seed": (3, 50), BANDWIDTH: (2, 8)})[1] for _ in range(20)]
    assert all(values["seed"] in range(3, 51) for values in asked)
    assert len({values[BANDWIDTH] for values in asked}) == 20


def test_search_without_optuna_flies_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "optuna", None)
    with pytest.raises(UserError, match="a search needs optuna"):
        searched(tmp_path)
    assert not list(tmp_path.rglob("*.json"))


TUNE = """
ranges:
  controller.bandwidth_radps: [3, 9]
  controller.feedback_limit: [0.1, 0.5]
training: {scenarios: [calm, px4_like], seeds: 2}
validation: {scenarios: [gusts, noise], seeds: 6}
trials: 40
"""


def bowl(case: Case) -> Record:
    """A flight whose error is least at 4 rad/s and 0.4, plus a term for scenario and seed."""
    at = {BANDWIDTH: 7.0, LIMIT: 0.3, **dict(case.values)}
    cost = (at[BANDWIDTH] - 4.0) ** 2 / 36 + (at[LIMIT] - 0.4) ** 2
    cost += 0.01 * case.seed + 0.002 * len(case.scenario)
    return Record(0, "flown and landed", 1.0, "error", {"rmse_position_m": cost})


def tuned(
    directory: Path,
    text: str = TUNE,
    most: float = math.inf,
    told: Callable[[int, float], None] = lambda number, cost: None,
) -> Tuned:
    directory.mkdir(exist_ok=True)
    (directory / "tune.yaml").write_text(text)
    tuning = Tuning(*load_document(str(directory / "tune.yaml"), "tuning", TuneFile))
    with known(Results(directory / "study", "0123456789ab"), Known(bowl, most)) as fly:
        return tuning.run(fly, told)


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> tuple[Tuned, Path]:
    directory = tmp_path_factory.mktemp("tune") / "whole"
    return tuned(directory), directory / "tune.yaml"


def test_tuning_confirms_the_minimum_and_writes_a_profile(
    whole: tuple[Tuned, Path], tmp_path: Path
) -> None:
    found, tuning = whole
    assert dict(found.values)[BANDWIDTH] == pytest.approx(4.0, abs=1.0)
    assert found.flights == 12
    assert found.better, str(found)
    file = tmp_path / "profile.yaml"
    file.write_text(profile(load_document(str(tuning), "tuning", TuneFile)[0], found))
    config = load(str(file), known_vehicle="px4_sih").model_dump()
    shipped = load("flight", known_vehicle="px4_sih").model_dump()
    assert config["controller"]["bandwidth_radps"] == dict(found.values)[BANDWIDTH]
    for part in ("vehicle", "reference", "limits", "seed"):
        assert config[part] == shipped[part]


def test_interrupted_tuning_resumes_with_the_same_result(
    whole: tuple[Tuned, Path], tmp_path: Path
) -> None:
    """A trial is four flights; the first trial has the present values, interrupted or not."""
    costs: list[float] = []
    with pytest.raises(Incomplete):
        tuned(tmp_path / "t", most=10, told=lambda number, cost: costs.append(cost))
    assert len(costs) == 2
    costs.clear()
    found = tuned(tmp_path / "t", told=lambda number, cost: costs.append(cost))
    assert len(costs) == 40
    assert costs[0] == pytest.approx(0.287)  # 0.26 by the values, the rest by seeds and scenarios
    assert found == whole[0]


def test_invalid_tuning_file_is_refused(tmp_path: Path) -> None:
    for change, sentence in (
        (("[gusts, noise]", "[calm, noise]"), "2 flights are in training and in validation"),
        (("feedback_limit", "feedback"), "ranges.controller.feedback is no real number"),
        # before, it was refused as `--set controller.swarm.particles=40.0`
        (("feedback_limit", "swarm.particles"), "ranges.controller.swarm.particles is no real"),
        # before, each trial above the limit was a failed flight
        ((LIMIT + ":", LIMIT + ": [0.1, 1.5] #"), "feedback_limit: 1.5 should be less than or"),
        (("trials: 40", "objective: solve_time_p50_ms"), "is no metric of a lockstep flight"),
        ((LIMIT, "scenario.conditions.mass_scale"), "no scenario and no vehicle is tuned"),
    ):
        with pytest.raises(DocumentError, match=sentence):
            tuned(tmp_path / "t", TUNE.replace(*change))


def test_tuning_verdict_needs_a_significant_difference() -> None:
    random = np.random.default_rng(3)
    base = random.uniform(0.02, 0.2, 20)
    noise = random.normal(0.0, 0.01, 20)
    assert judge(base, base - 0.02 + noise).better
    assert not judge(base, base + noise - noise.mean()).better
    assert not judge(base, base + 0.02).better
    assert not judge(base, base).better  # the same: p = 1
    crashed = base - 0.02
    crashed[0] = 5.0  # nineteen are better, but one is not completed
    assert not judge(base, crashed).better
