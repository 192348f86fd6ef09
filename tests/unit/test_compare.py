"""Comparisons: best controllers, failures with their reasons, table, page, files, progress."""

from __future__ import annotations

import csv
import io
import itertools
import json
import math
import os
import signal
from pathlib import Path

import pytest
from browser import Opened, opening
from rich.console import Console
from typer.testing import CliRunner

from offboard.analysis.compare import (
    FIGURES,
    Failure,
    Result,
    Row,
    Trial,
    as_csv,
    as_json,
    table,
    trials,
)
from offboard.analysis.compare_page import page
from offboard.analysis.compare_table import show
from offboard.analysis.comparison import compare_all
from offboard.analysis.workers import processors
from offboard.cli.commands import app
from offboard.documents.reading import DocumentError

LAWS = ("pso", "lqr", "an/uncommonly/long/name.yaml", "lost")
SCENARIOS = ("calm", "all_together")
# Position RMSE in m of seeds 1, 2, 3
ERRORS_M = {
    ("pso", "calm"): (0.010, 0.012, 0.011),
    ("lqr", "calm"): (0.0109, 0.0119, 0.0121),  # within the range of pso's flights
    (LAWS[2], "calm"): (0.0125, 0.0125, 0.0125),
    ("lost", "calm"): (0.001, 0.001, math.nan),  # the lowest, but one failed
    ("pso", "all_together"): (0.2, 0.2, 0.2),
    ("lqr", "all_together"): (0.201, 0.201, 0.201),  # within one per cent
    (LAWS[2], "all_together"): (0.21, 0.19, 0.21),
    ("lost", "all_together"): (math.nan,) * 3,
}
WHY = "7.1 m <b>away</b>"


def flown(trial: Trial) -> Result:
    error_m = ERRORS_M[trial.controller, trial.scenario][trial.seed - 1]
    if math.isnan(error_m):
        return Result(trial, 4, WHY, {})
    figures = {name: error_m * (1 + index) for index, name in enumerate(FIGURES)}
    return Result(trial, 0, "flown and landed", figures)


@pytest.fixture(scope="module")
def rows() -> list[Row]:
    planned = trials(LAWS, ["lemniscate"], SCENARIOS, range(1, 4), Path("x"))
    return table(map(flown, planned))


def row_of(rows: list[Row], law: str, scenario: str) -> Row:
    (found,) = [row for row in rows if (row.controller, row.scenario) == (law, scenario)]
    return found


def test_best_is_the_lowest_median_of_those_that_all_flew_and_its_equals(rows: list[Row]) -> None:
    best = {(row.controller, row.scenario) for row in rows if row.best}
    assert best == {(law, scenario) for law in ("pso", "lqr") for scenario in SCENARIOS}


def test_median_and_range_are_of_the_flights_that_landed(rows: list[Row]) -> None:
    lqr, lost = row_of(rows, "lqr", "calm"), row_of(rows, "lost", "calm")
    ends = (lqr.lowest, lqr.median, lqr.highest)
    assert [end["rmse_position_m"] for end in ends] == [0.0109, 0.0119, 0.0121]
    assert (lost.flown, lost.median["rmse_position_m"]) == (2, 0.001)
    assert lost.failures == (Failure(3, WHY),)


def test_files_hold_every_figure(rows: list[Row]) -> None:
    read = list(csv.DictReader(io.StringIO(as_csv(rows))))
    document = json.loads(as_json(rows))
    assert len(read) == len(document) == len(rows)
    for name, which in itertools.product(FIGURES, ("median", "lowest", "highest")):
        for row, line, entry in zip(rows, read, document, strict=True):
            value = getattr(row, which)[name]
            assert entry[which][name] == (value if row.flown else None)
            assert line[f"{name}_{which}"] == (f"{value:.6g}" if row.flown else "")
    assert document[-1]["failures"] == [{"seed": seed, "sentence": WHY} for seed in (1, 2, 3)]


@pytest.mark.parametrize("width", [60, 80, 120, 200])
def test_no_line_of_the_table_is_wider_than_the_window(rows: list[Row], width: int) -> None:
    text = io.StringIO()
    show(Console(file=text, width=width), rows)
    told = text.getvalue().splitlines()
    assert max(map(len, told)) <= width
    whole = "\n".join(told)
    for words in (*LAWS[:2], *SCENARIOS, "[0.0109\N{EN DASH}0.0121]", "0.0119", "lost (2 of 3)"):
        assert words in whole, words
    assert [line.split()[1] for line in told if line.startswith("* ")][:4] == ["pso", "lqr"] * 2


def test_the_page_opens_without_an_error_and_shows_every_row(
    rows: list[Row], tmp_path: Path
) -> None:
    file = tmp_path / "compare.html"
    file.write_text(page(rows, ["not flown: <i>calm</i>"]), encoding="utf-8")
    with opening(file) as opened:
        assert opened.problems == opened.fetched == []
        dots = opened.page.locator(".scatterlayer .point").count()
        assert dots == 3 * sum(row.flown > 0 for row in rows)  # error, tilt, rates
        assert opened.page.locator("table tr").count() == 1 + len(rows)
        assert opened.page.locator("tr.best").count() == 4
        told = opened.page.inner_text("main")
    for words in (*LAWS, *SCENARIOS, WHY, "3 of 3 failed", "<i>calm</i>"):
        assert words in told, words


def test_titles_and_numbers_of_the_axes_keep_clear_of_each_other(
    rows: list[Row], tmp_path: Path
) -> None:
    """In a window of 1100 pixels; every panel shows two numbers or more."""
    file = tmp_path / "compare.html"
    file.write_text(page(rows), encoding="utf-8")
    axes = ("x", "x2", "x3")
    with opening(file, width=1100) as opened:
        titles = [_boxes(opened, f".g-{axis}title") for axis in axes]
        numbers = [_boxes(opened, f".{axis}tick text") for axis in axes]
    assert min(map(len, numbers)) >= 2
    for panels in (titles, numbers):
        for (_, right), (left, _) in itertools.pairwise(itertools.chain.from_iterable(panels)):
            assert right < left


def test_the_page_follows_the_colour_scheme_and_fits_a_narrow_window(
    rows: list[Row], tmp_path: Path
) -> None:
    file = tmp_path / "compare.html"
    file.write_text(page(rows, ["not flown: <i>calm</i>"]), encoding="utf-8")
    with opening(file, width=400) as opened:
        assert opened.width_px() == 400
        assert opened.colliding() == []
        assert opened.unreadable() == []
        opened.switch("dark")
        assert opened.unreadable() == []
        assert opened.problems == []


def _boxes(opened: Opened, selector: str) -> list[tuple[float, float]]:
    """Left and right edges in pixels, from left to right."""
    found = [each.bounding_box() for each in opened.page.locator(selector).all()]
    return sorted((box["x"], box["x"] + box["width"]) for box in found if box)


def dies_with_seed_2(trial: Trial) -> Result:
    if trial.seed == 2:
        os.kill(os.getpid(), signal.SIGKILL)
    return Result(trial, 0, "flown and landed", dict.fromkeys(FIGURES, 1.0))


def test_a_worker_that_dies_fails_its_own_flight_only(tmp_path: Path) -> None:
    problem = compare_all(
        dies_with_seed_2,
        controllers=["pso"],
        references=["hover"],
        scenarios=["calm"],
        seeds=range(1, 5),
        directory=tmp_path / "all",
        workers=1,
        console=Console(file=io.StringIO()),
    )
    assert problem == "1 of 4 flights failed; the table says why"
    (row,) = csv.DictReader((tmp_path / "all" / "compare.csv").open(encoding="utf-8"))
    assert row["failed"] == "1"
    assert row["why"] == "the process that flew it ended"


@pytest.mark.parametrize(
    ("exit_code", "flown"),
    [(2, "pso lqr pid mpc"), (3, "pso lqr"), (4, "pso lqr")],  # a file; refused; aborted
)
def test_on_one_vehicle_nothing_is_flown_after_a_refused_or_aborted_flight(
    tmp_path: Path, exit_code: int, flown: str
) -> None:
    begun: list[str] = []

    def fly(trial: Trial) -> Result:
        begun.append(trial.controller)
        if trial.controller == "lqr":
            return Result(trial, exit_code, "left OFFBOARD for AUTO.LOITER", {})
        return Result(trial, 0, "flown and landed", dict.fromkeys(FIGURES, 1.0))

    console = Console(file=io.StringIO())
    problem = compare_all(
        fly,
        controllers=["pso", "lqr", "pid", "mpc"],
        references=["hover"],
        scenarios=["connected"],
        seeds=[1],
        directory=tmp_path,
        workers=0,
        console=console,
    )
    assert " ".join(begun) == flown
    rows = csv.DictReader((tmp_path / "compare.csv").open(encoding="utf-8"))
    assert [row["controller"] for row in rows] == begun
    words = "ended with lqr on hover, seed 1 (left OFFBOARD for AUTO.LOITER)"
    failed = "1 of 2 flights failed; the table says why"
    assert (problem == f"{failed}; {words}: 2 of 4 flights missing") == (exit_code != 2)
    assert (words in (tmp_path / "compare.html").read_text(encoding="utf-8")) == (exit_code != 2)


@pytest.mark.parametrize(
    ("controllers", "references"),
    [
        (["a/fast.yaml", "b/fast.yaml"], ["hover"]),
        (["pso", "lqr", "pso"], ["hover"]),
        (["pso"], ["a/way.yaml", "hover", "b/way.csv"]),
        (["pso", "pso-slow"], ["slow-hover", "hover"]),
    ],
)
def test_flights_that_would_share_a_directory_are_refused_before_the_first(
    tmp_path: Path, controllers: list[str], references: list[str]
) -> None:
    with pytest.raises(DocumentError, match="would both be recorded in") as refused:
        compare_all(
            flown,
            controllers=controllers,
            references=references,
            scenarios=["calm"],
            seeds=[1],
            directory=tmp_path / "all",
            workers=0,
            console=Console(file=io.StringIO()),
        )
    assert len(refused.value.problems) == 1
    assert not (tmp_path / "all").exists()


@pytest.mark.parametrize("terminal", [False, True], ids=["piped", "terminal"])
def test_progress_is_shown_before_the_first_flight_ends(
    tmp_path: Path, terminal: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Piped, a line for each flight; on a terminal, a bar that is gone at the end."""
    monkeypatch.setenv("TERM", "xterm")
    text = io.StringIO()
    shown: list[str] = []

    def fly(trial: Trial) -> Result:
        shown.append(text.getvalue())
        return lands(trial)

    compare_all(
        fly,
        controllers=["pso", "lqr"],
        references=["hover"],
        scenarios=["calm"],
        seeds=[1],
        directory=tmp_path / "all",
        workers=0,
        console=Console(file=text, width=80, force_terminal=terminal),
    )
    assert "2 flights, 1 at a time" in shown[0]
    assert ("0/2" in shown[0]) is terminal
    lines = ["   1  pso-hover-calm-1: 1.00 m", "   2  lqr-hover-calm-1: 1.00 m"]
    assert [line for line in text.getvalue().splitlines() if line in lines] == (
        [] if terminal else lines
    )


def lands(trial: Trial) -> Result:
    return Result(trial, 0, "flown and landed", dict.fromkeys(FIGURES, 1.0))


def test_without_cpu_affinity_all_processors_are_used(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert processors() == len(os.sched_getaffinity(0))
    monkeypatch.delattr(os, "sched_getaffinity")
    assert processors() == os.cpu_count()
    problem = compare_all(
        lands,
        controllers=["pso"],
        references=["hover"],
        scenarios=["calm"],
        seeds=[1],
        directory=tmp_path / "all",
        workers=None,
        console=Console(file=io.StringIO()),
    )
    assert not problem


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (("compare", "--system", "3"), "are options of --connect"),
        (("compare", "--connect", "tcp:127.0.0.1:1", "--signing-key", "none"), "signing key none"),
        (("identify", "x.tlog", "--system", "3"), "a log needs neither --system nor"),
        (("identify", "--sitl", "--system", "3"), "--system is an option of --connect"),
    ],
)
def test_the_vehicle_and_its_key_are_chosen_where_a_command_flies_one(
    arguments: tuple[str, ...], says: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    answer = CliRunner().invoke(app, arguments)
    assert answer.exit_code != 0
    assert says in f"{answer.exception} {answer.output}"
