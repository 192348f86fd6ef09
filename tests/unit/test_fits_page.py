"""The report of an identification from a recorded flight, opened in Chromium without a network."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from browser import opening

from offboard.analysis.identify import identify_flight, rows
from offboard.report.fits import fits
from offboard.report.flight import read
from offboard.report.report_page import page
from offboard.run.configuration import load

RECORDING = Path(__file__).parents[1] / "wire" / "recordings" / "px4-1.16.1-offboard.tlog"
REFUSAL = "it <b>does not</b> follow its command"


@pytest.mark.slow
def test_the_page_shows_every_constant_and_reads_in_both_colour_schemes(
    tmp_path: Path,
) -> None:
    prior = load("flight", choices={}).vehicle
    flight = replace(read(RECORDING), name="<1>")
    found, trace = identify_flight(flight.sent, prior)
    found = replace(found, yaw=None, refusals={**found.refusals, "yaw": REFUSAL})
    file = tmp_path / "identify.html"
    file.write_text(page([flight], fits(found, trace, prior)), encoding="utf-8")
    with opening(file, width=400) as opened:
        assert opened.problems == opened.fetched == []
        assert opened.page.inner_text("h1") == "Flight <1>"
        assert opened.page.locator("#fits tr").count() == 1 + len(list(rows(found)))
        assert opened.page.inner_text("#fits").count(f"not identified: {REFUSAL}") == 3
        assert opened.page.locator("[id^=fit_].figure").count() == 2
        assert opened.width_px() == 400
        assert opened.colliding() == opened.unreadable() == []
        opened.switch("dark")
        assert opened.unreadable() == []
