"""Campaigns with known results: groups, best law, margin, table, page, flights of one vehicle."""

from __future__ import annotations

import csv
import io
import itertools
import math
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from browser import opening
from rich.console import Console

from offboard.campaign import workers
from offboard.campaign.cases import Case
from offboard.campaign.document import CampaignFile, Promises
from offboard.campaign.flight import LOWEST, Job, terms
from offboard.campaign.results import Record
from offboard.campaign.run import Campaign, Summary
from offboard.campaign.table import TABLE_METRICS, Group, groups, page, row_of, show
from offboard.campaign.workers import ConnectedVehicle
from offboard.cli.campaign import conclude
from offboard.documents.errors import UserError

LAWS = ("pso", "lqr", "an/uncommonly/long/name.yaml", "lost")
SCENARIOS = ("calm", "all_together")
# Position RMSE in m of seeds 1, 2, 3
ERRORS_M = {
    ("pso", "calm"): (0.010, 0.012, 0.011),
    ("lqr", "calm"): (0.0109, 0.0119, 0.0121),  # within the range of pso's flights
    (LAWS[2], "calm"): (0.0125, 0.0125, 0.0125),
    ("lost", "calm"): (0.001, 0.001, math.nan),  # the lowest error, but one flight failed
    ("pso", "all_together"): (0.2, 0.2, 0.2),
    ("lqr", "all_together"): (0.201, 0.201, 0.201),  # within one per cent
    (LAWS[2], "all_together"): (0.21, 0.19, 0.21),
    ("lost", "all_together"): (math.nan,) * 3,
}
WHY = "7.1 m <b>away</b>"


def record(error_m: float) -> Record:
    if math.isnan(error_m):
        return Record(4, WHY, -1.0, "completed")
    figures = {name: error_m * (1 + index) for index, name in enumerate(TABLE_METRICS)}
    return Record(0, "flown and landed", 0.9, "error", figures)


@pytest.fixture(scope="module")
def flown() -> list[Group]:
    rows = [
        row_of(Case("flight", law, "lemniscate", None, None, "px4", scenario, seed), ended, ())
        for scenario, law in itertools.product(SCENARIOS, LAWS)
        for seed, ended in enumerate(map(record, ERRORS_M[law, scenario]), 1)
    ]
    return groups(rows)


def test_best_groups_have_the_lowest_median_without_failures(
    flown: list[Group],
) -> None:
    """Median and range of a group count only the flights that landed."""
    best = {(group.name, group.block.rpartition(" ")[2]) for group in flown if group.best}
    assert best == {(law, scenario) for law in ("pso", "lqr") for scenario in SCENARIOS}
    calm = {group.name: group for group in flown if group.block == "lemniscate, calm"}
    assert calm["lqr"].spread("rmse_position_m") == (0.0109, 0.0119, 0.0121)
    lost = calm["lost"]
    assert (lost.successes, lost.spread("rmse_position_m")[1]) == (2, 0.001)
    assert lost.reasons == {WHY: [3]}


def test_group_names_show_only_differing_values() -> None:
    """A key is shown by its last part, a file by its stem, if nothing else has the same."""

    def names(*cases: tuple[str, dict[str, int]], drawn: frozenset[str] = frozenset()) -> list[str]:
        case = Case("flight", None, "an/hover.csv", None, None, "px4", "calm", 1)
        rows = [
            row_of(replace(case, controller=law, values=tuple(values.items())), record(0.1), ())
            for law, values in cases
        ]
        flown = groups(rows, drawn)
        assert {group.block for group in flown} == {"hover, calm"}
        return [group.name for group in flown]

    cases = [("lqr", {"a.b": 1, "a.c": value}) for value in (2, 3)]
    assert names(*cases) == ["lqr c=2", "lqr c=3"]
    assert names(*cases, drawn=frozenset({"a.c"})) == ["lqr"]
    same = ("x/soft.yaml", {"a.c": 1, "d.c": 1, "d.e": 1}), ("lqr", {"a.c": 2, "d.c": 2, "d.e": 2})
    assert names(*same) == ["soft a.c=1 d.c=1 e=1", "lqr a.c=2 d.c=2 e=2"]
    assert names(("x/lqr.yaml", {}), ("lqr", {})) == ["x/lqr.yaml", "lqr"]


def test_table_fits_the_terminal_width(flown: list[Group]) -> None:
    text = io.StringIO()
    show(Console(file=text, width=80), flown)
    told = text.getvalue().splitlines()
    assert max(map(len, told)) <= 80
    whole = "\n".join(told)
    for words in (*LAWS[:2], *SCENARIOS, "[0.0109\N{EN DASH}0.0121]", "0.0119", "lost (2 of 3)"):
        assert words in whole, words
    assert [line.split()[1] for line in told if line.startswith("* ")][:4] == ["pso", "lqr"] * 2
    assert f"seed 1, 2, 3: {WHY}" in " ".join(whole.split())


def test_campaign_page_opens_offline_and_shows_all_groups(
    flown: list[Group], tmp_path: Path
) -> None:
    file = tmp_path / "campaign.html"
    file.write_text(page(flown, ["not flown: <i>calm</i>"]), encoding="utf-8")
    with opening(file, width=1280) as opened:
        assert opened.problems == opened.fetched == opened.colliding() == []
        assert opened.page.locator("article").first.locator(".boxlayer .trace").count() > 0
        assert opened.page.locator("table").first.locator("tr").count() == 1 + len(flown)
        assert opened.page.locator("tr.best").count() == 4
        told = opened.page.inner_text("main")
        opened.resize(400)
        assert opened.width_px() == 400
        for scheme in ("light", "dark"):
            opened.switch(scheme)
            assert opened.unreadable() == opened.problems == []
    for words in (*LAWS, *SCENARIOS, WHY, "3 of 3 failed", "<i>calm</i>", "--seed 3"):
        assert words in told, words


def test_a_table_that_could_not_be_written_is_not_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    campaign = Campaign(CampaignFile(references=("hover",)), "x", tmp_path)
    with pytest.raises(UserError, match="No space left: 1 of 1 flight is missing"):
        conclude(Summary(1, [], 1, "No space left", []), campaign)
    assert "campaign.html" not in capsys.readouterr().out


@pytest.mark.parametrize(
    ("exit_code", "begun", "rows"),
    [
        (2, "pso lqr pid mpc", "pso lqr pid mpc"),  # a file that cannot be flown
        (3, "pso lqr", "pso"),  # refused: flown by the next run
        (4, "pso lqr", "pso lqr"),  # aborted
    ],
)
def test_campaign_on_one_vehicle_stops_after_a_refusal_or_abort(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, exit_code: int, begun: str, rows: str
) -> None:
    flown: list[str] = []

    def fly(job: Job, directory: Path, *_: object) -> Record:
        flown.append(job.case.load().controller.law)
        directory.mkdir(parents=True)
        if flown[-1] == "lqr":
            return Record(exit_code, "left OFFBOARD for AUTO.LOITER", -1.0, "completed")
        return record(1.0)

    monkeypatch.setattr(workers, "recorded", fly)
    laws = ("pso", "lqr", "pid", "mpc")
    file = CampaignFile(controllers=laws, references=("hover",), keep=True)

    def again() -> str:
        campaign = Campaign(file, "x", tmp_path, link="udpin:127.0.0.1:0")
        return campaign.fly(
            lambda: nullcontext(ConnectedVehicle()), Console(file=io.StringIO())
        ).stopped

    stopped = again()
    lines = list(csv.DictReader((tmp_path / "campaign.csv").open(encoding="utf-8")))
    assert " ".join(flown) == begun
    assert " ".join(line["controller"] for line in lines) == rows
    assert "--connect udpin:127.0.0.1:0" in lines[0]["fly_again"]
    words = "ended with lqr on hover, seed 1 (left OFFBOARD for AUTO.LOITER)"
    page_says = (tmp_path / "campaign.html").read_text(encoding="utf-8")
    assert (words in stopped) == (words in page_says) == (exit_code != 2)
    if exit_code == 3:
        again()
        assert " ".join(flown) == "pso lqr lqr"
        folders = list((tmp_path / "flights").glob("lqr*"))
        assert len(folders) == 2, "the log of the refused flight stays"


class Empty:
    """The history of a flight without phases and positions."""

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
    ],
)
def test_margin_is_that_of_the_weakest_promise(
    changes: dict[str, float], expected: tuple[str, float]
) -> None:
    figures = {
        "max_position_m": 0.0, "tilt_max_deg": 0.0, "link_delay_p99_ms": 0.0,
        "at_bound_share": 0.0, "touchdown_mps": 0.5, "completed": 1.0, **changes,
    }  # fmt: skip
    found = terms(Promises(), figures, Empty(), None)  # type: ignore[arg-type]
    weakest = min(found, key=lambda name: found[name])
    assert (weakest, found[weakest]) == (expected[0], pytest.approx(expected[1]))


def test_connected_cases_begin_disarmed_in_separate_directories() -> None:
    """Two files of the same name get two directories; a given `limits.begin_armed` is kept."""
    case = Case("flight", "lqr", "hover", None, None, "px4", "connected", 1, link="udpin::0")
    armed = replace(case, values=(("limits.begin_armed", True),))
    begins = [each.load().limits.begin_armed for each in (case, armed, replace(case, link=None))]
    assert begins == [False, True, True]
    cases = [replace(case, controller=name) for name in ("a/fast.yaml", "b/fast.yaml")]
    folders = {each.folder for each in cases}
    assert len(folders) == 2
    assert all(folder.startswith("fast-hover-connected-1-") for folder in folders)
