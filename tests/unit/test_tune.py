"""Tuning: the verdict on paired flights, the swarm as a sampler, a profile that flies."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np
import pytest

from offboard.campaign.evaluate import Evaluator, Interrupted
from offboard.campaign.execution import Workers
from offboard.campaign.flight import Job
from offboard.campaign.margin import Promises
from offboard.campaign.results import Record, Results
from offboard.campaign.tune import Tuned, Tuning, profile, read_tune
from offboard.campaign.verdict import judge
from offboard.documents.errors import DocumentError
from offboard.run.configuration import load

FILE = """
ranges:
  controller.bandwidth_radps: [3, 9]
  controller.feedback_limit: [0.1, 0.5]
training: {scenarios: [calm, px4_like], seeds: 2}
validation: {scenarios: [gusts, noise], seeds: 6}
trials: 40
sampler: swarm
"""
BANDWIDTH, LIMIT = "controller.bandwidth_radps", "controller.feedback_limit"


class Bowl(Workers):
    """Flights whose error is least at 4 rad/s and 0.4, plus a figure of scenario and seed. With
    `shift` that minimum is gone on the validation flights."""

    shift = 0.0

    def fly(self, jobs: Sequence[Job], ending: Callable[[], bool]) -> Iterator[tuple[Job, Record]]:
        for job in jobs:
            if not ending():
                at = {BANDWIDTH: 7.0, LIMIT: 0.3, **dict(job.case.values)}
                cost = (at[BANDWIDTH] - 4.0) ** 2 / 36 + (at[LIMIT] - 0.4) ** 2
                if job.case.scenario in ("gusts", "noise"):
                    cost = abs(self.shift - cost)
                cost += 0.01 * job.case.seed + 0.002 * len(job.case.scenario)
                yield job, Record(0, "flown and landed", 1.0, "error", {"rmse_position_m": cost})


def tuned(
    directory: Path,
    text: str = FILE,
    workers: type[Bowl] = Bowl,
    ending: Callable[[], bool] = lambda: False,
    told: Callable[[int, float], None] = lambda number, cost: None,
) -> Tuned:
    directory.mkdir(exist_ok=True)
    (directory / "tune.yaml").write_text(text)
    tuning = Tuning(*read_tune(str(directory / "tune.yaml")))
    results = Results(directory / "study", "0123456789ab")
    flyers = workers(1, lambda: pytest.fail("not used"))
    evaluator = Evaluator(results, Promises(), flyers, ending)
    return tuning.run(results.directory, evaluator, told)


@pytest.mark.parametrize("sampler", ["swarm", "tpe", "cma"])
def test_the_minimum_is_found_and_confirmed(tmp_path: Path, sampler: str) -> None:
    found = tuned(tmp_path / "t", FILE.replace("sampler: swarm", f"sampler: {sampler}"))
    values = dict(found.values)
    assert values[BANDWIDTH] == pytest.approx(4.0, abs=1.0)
    assert found.verdict.flights == 12
    assert found.verdict.better, str(found.verdict)


def test_what_is_better_only_in_training_is_refused(tmp_path: Path) -> None:
    class Elsewhere(Bowl):
        shift = 0.5

    assert not tuned(tmp_path / "t", workers=Elsewhere).verdict.better


@pytest.mark.parametrize("flights", [2, 50])
def test_an_interrupted_tuning_goes_on(flights: int, tmp_path: Path) -> None:
    """The first trial, of four flights, has the present values also if it was interrupted."""
    left = [flights]

    def ending() -> bool:
        left[0] -= 1
        return left[0] < 0

    costs: list[float] = []
    with pytest.raises(Interrupted):
        tuned(tmp_path / "t", ending=ending, told=lambda number, cost: costs.append(cost))
    assert len(costs) == flights // 4
    found = tuned(tmp_path / "t", told=lambda number, cost: costs.append(cost))
    assert len(costs) == 40
    assert costs[0] == pytest.approx(0.287)  # 0.26 of the present values, seeds and scenarios
    assert dict(found.values)[BANDWIDTH] == pytest.approx(4.0, abs=1.0)
    assert found.verdict.better


def test_trials_of_another_tuning_do_not_count(tmp_path: Path) -> None:
    one_range = FILE.replace(f"  {LIMIT}: [0.1, 0.5]\n", "")
    numbers: list[int] = []
    for text in (one_range, FILE):
        tuned(tmp_path / "t", text, told=lambda number, cost: numbers.append(number))
    assert numbers == [*range(1, 41)] * 2


def test_the_profile_is_a_configuration_with_the_tuned_values(tmp_path: Path) -> None:
    found = tuned(tmp_path / "t")
    file = tmp_path / "profile.yaml"
    file.write_text(profile(read_tune(str(tmp_path / "t" / "tune.yaml"))[0], found))
    config = load(str(file), known_vehicle="px4_sih").model_dump()
    shipped = load("flight", known_vehicle="px4_sih").model_dump()
    assert config["controller"]["bandwidth_radps"] == dict(found.values)[BANDWIDTH]
    for part in ("vehicle", "reference", "limits", "seed"):
        assert config[part] == shipped[part]


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (("[gusts, noise]", "[calm, noise]"), "2 flights are in training and in validation"),
        (("feedback_limit", "feedback"), "ranges.controller.feedback is no number"),
        (("trials: 40", "objective: solve_time_p50_ms"), "is no figure of a lockstep flight"),
        (("trials: 40", "trails: 40"), "did you mean trials?"),
        ((LIMIT, "scenario.conditions.mass_scale"), "no scenario and no vehicle is tuned"),
        ((LIMIT, "vehicle.tilt.delay_s"), "no scenario and no vehicle is tuned"),
    ],
)
def test_a_file_that_cannot_be_tuned_is_refused(
    change: tuple[str, str], sentence: str, tmp_path: Path
) -> None:
    with pytest.raises(DocumentError, match=sentence.replace("?", r"\?").replace(".", r"\.")):
        tuned(tmp_path / "t", FILE.replace(*change))


def test_a_verdict_needs_a_difference_that_is_no_chance() -> None:
    random = np.random.default_rng(3)
    base = random.uniform(0.02, 0.2, 20)
    noise = random.normal(0.0, 0.01, 20)
    assert judge(base, base - 0.02 + noise).better
    assert not judge(base, base + noise - noise.mean()).better
    assert not judge(base, base + 0.02).better
    assert not judge(base, base).better  # the same: p = 1
