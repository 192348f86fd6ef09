"""The page of `offboard paper`, opened in Chromium without a network."""

from __future__ import annotations

import io
import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
from browser import Opened, opening
from rich.console import Console

from offboard.paper.study import plan
from offboard.paper.study.closed_loop import fly
from offboard.paper.study.options import FIGURES, TABLES, PaperOptions
from offboard.paper.study.run import Outcome, reproduce

PNG = b"\x89PNG\r\n\x1a\n"


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Outcome:
    """Everything, with flights of 15 s."""
    options = PaperOptions(tmp_path_factory.mktemp("paper"), quick=True, seeds=1, workers=1)
    with pytest.MonkeyPatch.context() as short:
        short.setattr(plan, "fly", lambda task: fly(replace(task, steps=150)))
        return reproduce(options, Console(file=io.StringIO()))


@pytest.fixture(scope="module")
def opened(run: Outcome) -> Iterator[Opened]:
    with opening(run.page) as opened:
        yield opened


def test_everything_is_on_the_page(run: Outcome) -> None:
    assert not run.missing
    wanted = {f"table {name}" for name in TABLES} | {f"figure {name}" for name in FIGURES}
    assert set(run.finished) == wanted


def test_the_page_opens_without_an_error_and_without_the_network(opened: Opened) -> None:
    assert opened.problems == []
    assert opened.fetched == []


@pytest.mark.parametrize("scheme", ["dark", "light"])
def test_every_text_is_readable_after_a_switch_of_the_colour_scheme(
    opened: Opened, scheme: str
) -> None:
    opened.switch(scheme)
    assert opened.unreadable() == []
    assert opened.problems == []


def test_the_page_fits_a_narrow_window(opened: Opened) -> None:
    opened.resize(400)
    try:
        assert opened.width_px() == 400
        assert opened.colliding() == []
    finally:
        opened.resize(1280)
    assert opened.colliding() == []
    assert opened.problems == []


def test_every_figure_is_drawn(opened: Opened) -> None:
    drawn = opened.page.evaluate(
        "[...document.querySelectorAll('.figure')].map(f => [f.id.replace('figure_', ''), "
        "!!f.querySelector('.main-svg'), "
        "f.querySelectorAll('.scatterlayer .trace path, .scatterlayer .trace').length "
        "+ f.querySelectorAll('.gl-container canvas').length, f.clientHeight])"
    )
    assert {name for name, *_ in drawn} == set(FIGURES)
    for name, svg, marks, height in drawn:
        assert svg, name
        assert marks > 0, name
        assert height > 300, name


def test_every_table_is_there_with_its_rows(opened: Opened) -> None:
    rows = opened.page.evaluate(
        "Object.fromEntries([...document.querySelectorAll('article[id^=table]')]"
        ".map(a => [a.id.replace('table_', ''), a.querySelectorAll('tr').length - 1]))"
    )
    assert set(rows) == set(TABLES)
    assert rows["2"] == 24
    assert rows["4"] == 8
    assert rows["bd"] == 12


def test_unequal_weights_speed_one_step_up_and_then_break_it(run: Outcome) -> None:
    table = json.loads((run.page.parent / "table_weights.json").read_text(encoding="utf-8"))
    rows = {row["weights"]: row["time_constant_s"] for row in table["rows"]}
    assert rows["Q_y = 1 Q_v"] == pytest.approx(39.16, rel=1e-3)
    assert rows["Q_y = 10 Q_v"] < 4.0
    assert rows["Q_y = 80 Q_v"] is None


def test_a_figure_is_saved_as_an_image(opened: Opened, tmp_path: Path) -> None:
    figure = opened.page.locator("#figure_5")
    figure.scroll_into_view_if_needed()
    assert opened.page.locator(".figure .modebar-btn").count() >= 2 * len(FIGURES)
    with opened.page.expect_download(timeout=30_000) as download:
        figure.locator(".modebar-btn").first.click()
    download.value.save_as(tmp_path / "figure.png")
    assert (tmp_path / "figure.png").read_bytes().startswith(PNG)
