"""Comparisons: best controllers, failures with their reasons, table, page, files, progress."""

from __future__ import annotations

import csv
import io
import itertools
import json
import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import nullcontext
from pathlib import Path

import pytest
from browser import Opened, opening
from rich.console import Console
from typer.testing import CliRunner

from offboard.campaign import execution
from offboard.campaign.cases import Case
from offboard.campaign.compare import WHOLE_RANGE, as_csv, as_json, compare, plan
from offboard.campaign.compare_table import show
from offboard.campaign.document import CampaignFile
from offboard.campaign.execution import ConnectedVehicle
from offboard.campaign.flight import Job
from offboard.campaign.page import COMPARISON, page
from offboard.campaign.results import Record
from offboard.campaign.statistics import Group, groups, marked
from offboard.campaign.table import row_of
from offboard.cli.commands import app
from offboard.documents.errors import DocumentError
from offboard.run.request import FlightRequest

FIGURES = COMPARISON.figures

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


def record(error_m: float) -> Record:
    if math.isnan(error_m):
        return Record(4, WHY, -1.0, "completed")
    figures = {name: error_m * (1 + index) for index, name in enumerate(FIGURES)}
    return Record(0, "flown and landed", 0.9, "error", figures)


@pytest.fixture(scope="module")
def rows() -> list[Group]:
    flown = [
        row_of(Case("flight", law, "lemniscate", None, None, "px4", scenario, seed), ended, ())
        for scenario, law in itertools.product(SCENARIOS, LAWS)
        for seed, ended in enumerate(map(record, ERRORS_M[law, scenario]), 1)
    ]
    return marked(groups(flown, ends=WHOLE_RANGE))


def row_of_law(rows: list[Group], law: str, scenario: str) -> Group:
    (found,) = [row for row in rows if (row.case.controller, row.scenario) == (law, scenario)]
    return found


def test_best_is_the_lowest_median_of_those_that_all_flew_and_its_equals(rows: list[Group]) -> None:
    best = {(row.case.controller, row.scenario) for row in rows if row.best}
    assert best == {(law, scenario) for law in ("pso", "lqr") for scenario in SCENARIOS}


def test_median_and_range_are_of_the_flights_that_landed(rows: list[Group]) -> None:
    lqr, lost = row_of_law(rows, "lqr", "calm"), row_of_law(rows, "lost", "calm")
    assert lqr.spread("rmse_position_m") == (0.0109, 0.0119, 0.0121)
    assert (lost.successes, lost.spread("rmse_position_m")[1]) == (2, 0.001)
    assert lost.reasons == [WHY]


def test_files_hold_every_figure(rows: list[Group]) -> None:
    read = list(csv.DictReader(io.StringIO(as_csv(rows))))
    document = json.loads(as_json(rows))
    assert len(read) == len(document) == len(rows)
    for name, row, line, entry in (
        (name, *each) for name in FIGURES for each in zip(rows, read, document, strict=True)
    ):
        for which, value in zip(("lowest", "median", "highest"), row.spread(name), strict=True):
            assert entry[which][name] == (value if row.successes else None)
            assert line[f"{name}_{which}"] == (str(value) if row.successes else "")
    assert document[-1]["failures"] == [{"seed": seed, "sentence": WHY} for seed in (1, 2, 3)]


@pytest.mark.parametrize("width", [60, 80, 120, 200])
def test_no_line_of_the_table_is_wider_than_the_window(rows: list[Group], width: int) -> None:
    text = io.StringIO()
    show(Console(file=text, width=width), rows)
    told = text.getvalue().splitlines()
    assert max(map(len, told)) <= width
    whole = "\n".join(told)
    for words in (*LAWS[:2], *SCENARIOS, "[0.0109\N{EN DASH}0.0121]", "0.0119", "lost (2 of 3)"):
        assert words in whole, words
    assert [line.split()[1] for line in told if line.startswith("* ")][:4] == ["pso", "lqr"] * 2


def test_the_page_opens_without_an_error_and_shows_every_row(
    rows: list[Group], tmp_path: Path
) -> None:
    file = tmp_path / "compare.html"
    file.write_text(page(rows, COMPARISON, ["not flown: <i>calm</i>"]), encoding="utf-8")
    with opening(file) as opened:
        assert opened.problems == opened.fetched == []
        dots = opened.page.locator(".scatterlayer .point").count()
        assert dots == 3 * sum(row.successes > 0 for row in rows)  # error, tilt, rates
        assert opened.page.locator("table tr").count() == 1 + len(rows)
        assert opened.page.locator("tr.best").count() == 4
        told = opened.page.inner_text("main")
    for words in (*LAWS, *SCENARIOS, WHY, "3 of 3 failed", "<i>calm</i>"):
        assert words in told, words


def test_titles_and_numbers_of_the_axes_keep_clear_of_each_other(
    rows: list[Group], tmp_path: Path
) -> None:
    """In a window of 1100 pixels; every panel shows two numbers or more."""
    file = tmp_path / "compare.html"
    file.write_text(page(rows, COMPARISON), encoding="utf-8")
    axes = ("x", "x2", "x3")
    with opening(file, width=1100) as opened:
        titles = [_boxes(opened, f".g-{axis}title") for axis in axes]
        numbers = [_boxes(opened, f".{axis}tick text") for axis in axes]
    assert min(map(len, numbers)) >= 2
    for panels in (titles, numbers):
        for (_, right), (left, _) in itertools.pairwise(itertools.chain.from_iterable(panels)):
            assert right < left


def test_the_page_follows_the_colour_scheme_and_fits_a_narrow_window(
    rows: list[Group], tmp_path: Path
) -> None:
    file = tmp_path / "compare.html"
    file.write_text(page(rows, COMPARISON, ["not flown: <i>calm</i>"]), encoding="utf-8")
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


def campaign(controllers: Sequence[str], references: Sequence[str] = ("hover",)) -> CampaignFile:
    return CampaignFile(controllers=tuple(controllers), references=tuple(references))


@pytest.mark.parametrize(
    ("exit_code", "flown"),
    [(2, "pso lqr pid mpc"), (3, "pso lqr"), (4, "pso lqr")],  # a file; refused; aborted
)
def test_on_one_vehicle_nothing_is_flown_after_a_refused_or_aborted_flight(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, exit_code: int, flown: str
) -> None:
    begun: list[str] = []

    def fly(request: FlightRequest, *_: object) -> Record:
        begun.append(str(request.choices["controller"]))
        if begun[-1] == "lqr":
            return Record(exit_code, "left OFFBOARD for AUTO.LOITER", -1.0, "completed")
        return record(1.0)

    monkeypatch.setattr(execution, "recorded", fly)
    vehicle = ConnectedVehicle("udpin:127.0.0.1:0")
    jobs = plan(campaign(["pso", "lqr", "pid", "mpc"]), tmp_path, vehicle=vehicle)
    problem = compare(jobs, nullcontext(vehicle), tmp_path, Console(file=io.StringIO()))
    assert " ".join(begun) == flown
    lines = csv.DictReader((tmp_path / "compare.csv").open(encoding="utf-8"))
    assert [(line["controller"], line["scenario"]) for line in lines] == [
        (law, "connected") for law in begun
    ]
    words = "ended with lqr on hover, seed 1 (left OFFBOARD for AUTO.LOITER)"
    failed = "1 of 2 flights failed; the table says why"
    assert (problem == f"{failed}; {words}: 2 of 4 flights missing") == (exit_code != 2)
    assert (words in (tmp_path / "compare.html").read_text(encoding="utf-8")) == (exit_code != 2)


@pytest.mark.parametrize(
    ("controllers", "references"),
    [
        (["a/fast.yaml", "b/fast.yaml"], ["hover"]),
        (["pso"], ["a/way.yaml", "hover", "b/way.csv"]),
        (["pso", "./pso-slow.yaml"], ["./slow-hover.yaml", "hover"]),
    ],
)
def test_flights_that_would_share_a_directory_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, controllers: list[str], references: list[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    for file in (Path(name) for name in controllers + references if "." in name):
        file.parent.mkdir(exist_ok=True)
        file.write_text("")
    with pytest.raises(DocumentError, match="would both be recorded in") as refused:
        plan(campaign(controllers, references), tmp_path / "all")
    assert len(refused.value.problems) == 1


class Watched:
    """Flies without a vehicle; calls `begun` before each flight."""

    def __init__(self, begun: Callable[[], None]) -> None:
        self._begun = begun

    def fly(self, jobs: Sequence[Job], ending: Callable[[], bool]) -> Iterator[tuple[Job, Record]]:
        for job in jobs:
            self._begun()
            yield job, record(1.0)


@pytest.mark.parametrize("terminal", [False, True], ids=["piped", "terminal"])
def test_progress_is_shown_before_the_first_flight_ends(
    tmp_path: Path, terminal: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Piped, a line for each flight; on a terminal, a bar that is gone at the end."""
    monkeypatch.setenv("TERM", "xterm")
    text = io.StringIO()
    shown: list[str] = []
    flyer = Watched(lambda: shown.append(text.getvalue()))
    jobs = plan(campaign(["pso", "lqr"]), tmp_path)
    console = Console(file=text, width=80, force_terminal=terminal)
    assert compare(jobs, nullcontext(flyer), tmp_path, console) == ""
    assert ("0/" if terminal else "0 of 2 flights\n") in shown[0]
    lines = [line for line in text.getvalue().splitlines() if " of 2 flights, " in line]
    ended = [line.partition(" left: ")[2] for line in lines]
    assert ended == ([] if terminal else [f"{law}-hover-px4_like-1: 1.00 m" for law in LAWS[:2]])


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (("compare", "--system", "3"), "are options of --connect"),
        (("compare", "--connect", "tcp:127.0.0.1:1", "--signing-key", "none"), "signing key none"),
        (("compare", "--connect", "tcp:1:1", "--workers", "2"), "options of the simulator"),
        (("compare", "--scenario", ","), "--scenario is an empty list of names"),
        (("identify", "x.tlog", "--system", "3"), "a log needs no --system,"),
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


def test_an_unknown_controller_is_answered_with_every_known_one_once(tmp_path: Path) -> None:
    with pytest.raises(DocumentError, match="there is no controller named 'nope'") as refused:
        plan(CampaignFile(controllers=("nope",)), tmp_path)
    known = str(refused.value).partition("known are ")[2].split(", ")
    assert len(known) == len(set(known)) > 5
