"""Reports of flights: pages opened in Chromium without a network, and the values that they show."""

from __future__ import annotations

import errno
import lzma
import math
import os
import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from browser import Opened, opening
from hypothesis import given
from hypothesis import strategies as st
from pair import Pair, hover, in_phase
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from typer.testing import CliRunner

from offboard.analysis import tlog
from offboard.analysis.history import Event
from offboard.analysis.page import logarithmic
from offboard.analysis.score import Score, score
from offboard.cli.commands import app
from offboard.documents.errors import UserError
from offboard.flight.phases import Phase
from offboard.flight.record import RECORD_ID
from offboard.report import report_page
from offboard.report.figures import bands, figures, marks
from offboard.report.flight import Flight, read
from offboard.report.panels import thinned
from offboard.report.report_page import page

RECORDINGS = Path(__file__).parents[1] / "wire" / "recordings"
ARDUCOPTER = RECORDINGS / "arducopter-4.6.3-guided.tlog"
PX4 = RECORDINGS / "px4-1.16.1-offboard.tlog"
FIGURES = ["path", "timeline", "tracking", "attitude", "thrust", "decisions", "link"]
MOST_BYTES = 8_000_000
STAMP = (1_700_000_000_000_000).to_bytes(8, "big")  # time of a log entry
# [x, y] of a curve as the page draws it
CURVE = """([figure, name]) => {
  const trace = document.getElementById(figure)._fullData.find((each) => each.name === name);
  return [Array.from(trace.x), Array.from(trace.y)];
}"""


@dataclass
class Flown:
    pair: Pair
    directory: Path
    score: Score
    flight: Flight


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Flown:
    """A flight that a pilot ends in the phase HOVER."""
    pair = hover(at=[(in_phase(Phase.HOVER), Pair.pilot_takes_over)])
    pair.fly()
    directory = tmp_path_factory.mktemp("flights") / "a <b>"
    pair.log(directory)
    return Flown(pair, directory, pair.score(), read(directory))


@pytest.fixture(scope="module")
def recorded() -> Flight:
    """A log of a real PX4."""
    return read(PX4)


@pytest.fixture(scope="module")
def opened(flown: Flown) -> Iterator[Opened]:
    file = flown.directory / "report.html"
    file.write_text(page([flown.flight]), encoding="utf-8")
    with opening(file) as opened:
        yield opened


def test_report_is_readable_in_both_schemes_and_widths(opened: Opened) -> None:
    """It begins with the verdict."""
    for width, scheme in ((400, "dark"), (1280, "light")):
        opened.resize(width)
        opened.switch(scheme)
        assert opened.width_px() == width
        assert opened.unreadable() == opened.colliding() == []
    assert opened.problems == opened.fetched == []
    drawn = opened.page.evaluate("[...document.querySelectorAll('.figure')].map(f => f.id)")
    assert drawn == [*FIGURES, "identification"]
    assert len(opened.page.content().encode()) < MOST_BYTES
    shown = opened.page.inner_text("main").splitlines()
    assert shown[0] == "Flight a <b>"
    assert "✗ not completed (mode change): the vehicle left OFFBOARD for AUTO.LOITER" in shown[1:4]


def test_report_curves_agree_with_score_and_setpoints(opened: Opened, flown: Flown) -> None:
    begun = {phase: time_s for time_s, phase in flown.pair.phases}
    times, errors = map(np.array, opened.page.evaluate(CURVE, ["tracking", "estimated"]))
    tracked = (times >= begun[Phase.TRACK]) & (times <= begun[Phase.HOVER])
    largest_m = errors[tracked].astype(float).max()
    assert largest_m == pytest.approx(flown.score.max_position_m, rel=1e-4)
    _, thrust = opened.page.evaluate(CURVE, ["thrust", "commanded"])
    np.testing.assert_allclose(thrust, [m.thrust for _, _, m in flown.pair.setpoints], atol=1e-6)


def test_linked_figures_zoom_together(opened: Opened) -> None:
    ranges = "[...document.querySelectorAll('.linked')].map(f => f.layout.xaxis.range.map(Number))"
    before = opened.page.evaluate(ranges)
    assert len({tuple(each) for each in before}) == 1
    opened.page.evaluate("Plotly.relayout('attitude', {'xaxis.range': [3, 7]})")
    opened.page.wait_for_function(f"{ranges}.every(([low, high]) => low === 3 && high === 7)")


def test_3d_path_is_drawn_east_north_up(recorded: Flight) -> None:
    """The axes of a scene are right-handed: east, north, up. A path along one axis fits, too."""
    drawing = figures([recorded])["path"].drawing
    (curve,) = drawing.data
    shares = [drawing.layout.scene.aspectratio[axis] for axis in "xyz"]
    lengths = [np.ptp(drawing.layout.scene[f"{axis}axis"].range) for axis in "xyz"]
    assert np.divide(shares, lengths) == pytest.approx(shares[0] / lengths[0])  # one scale
    assert 0.5 * max(shares) <= min(shares) <= max(shares) < 1.5
    north, east, down = recorded.history.position["position_ned_m"][[0, -1]].T
    ends = [[axis[0], axis[-1]] for axis in (curve.x, curve.y, curve.z)]
    assert np.array(ends) == pytest.approx(np.array([east, north, -down]))
    assert figures([recorded])["tracking"].caption == ""  # the recording has no reference


def test_timeline_bands_are_the_flown_phases(flown: Flown) -> None:
    phases = [band for band in bands(flown.flight) if band.row == "phase"]
    shown = [band for band in phases if band.end_s > band.begin_s or band is phases[-1]]
    begun = {phase.value: time_s for time_s, phase in flown.pair.phases}
    assert [band.label for band in shown] == list(begun)
    for band in shown:
        assert band.begin_s == pytest.approx(begun[band.label], abs=0.02)
    steps = [mark.text for mark in marks(flown.flight) if mark.row == "failsafe"]
    assert [text.partition(":")[0] for text in steps] == ["yielded"]


def of_phases(flight: Flight, *names: str) -> Flight:
    """Return the flight as if these phases had begun, each 2 s after the one before."""
    phases = tuple(
        Event(flight.begin_s + 2.0 * number, "offboard", name, name)
        for number, name in enumerate(names)
    )
    return replace(flight, history=replace(flight.history, phases=phases))


def test_pause_splits_track_band_and_hand_back_is_no_failsafe(flown: Flown) -> None:
    begun_s = flown.flight.begin_s
    phases = ("ready", "track", "pause", "track", "hover", "hand back", "yielded")
    paused = of_phases(flown.flight, *phases)
    assert paused.track_s == begun_s + 2.0
    shapes = figures([paused])["tracking"].drawing.layout.shapes
    spans = [(shape.x0, shape.x1) for shape in shapes if shape.type == "rect"]
    assert spans == [(begun_s + 2.0, begun_s + 4.0), (begun_s + 6.0, begun_s + 8.0)]
    for flight in (paused, of_phases(flown.flight, "ready", "track", "hover", "yielded")):
        assert not [mark for mark in marks(flight) if mark.row == "failsafe"]


def test_track_band_ends_where_the_supervisor_takes_over(flown: Flown) -> None:
    tracking, begun_s = of_phases(flown.flight, "ready", "track"), flown.flight.begin_s
    said = [
        Event(begun_s + 5.0 + number, "offboard", f"supervisor: {what}", cause="supervisor")
        for number, what in enumerate(("taking over", "the vehicle is disarmed"))
    ]
    history = replace(tracking.history, announcements=tuple(said))
    killed = replace(tracking, history=history, score=score(history))
    *_, track, after = (band for band in bands(killed) if band.row == "phase")
    assert (track.end_s, after.begin_s, after.end_s) == (begun_s + 5, begun_s + 5, killed.end_s)
    assert (track.label, after.label) == ("track", "supervisor")
    assert "✗</span> not completed: supervisor: taking over</p>" in page([killed])


def test_report_metrics_agree_with_the_score(flown: Flown, recorded: Flight) -> None:
    """This also holds for several flights on one page."""
    shown = {name: values[0] for name, values in report_page.rows([flown.flight]).items()}
    finite = {name: v for name, v in flown.score.metrics().items() if math.isfinite(v)}
    assert shown == {name: f"{value:.4g}" for name, value in finite.items()}
    rows = report_page.rows([flown.flight, recorded, flown.flight])
    value = f"{flown.score.rmse_position_m:.4g}"
    assert rows["rmse_position_m"] == (value, "–", value)


def of_kinds(log: Path, without: set[int]) -> bytes:
    """Return the bytes of a log without the messages with these ids."""
    return b"".join(
        entry.unix_us.to_bytes(8, "big") + bytes(entry.frame.raw)
        for entry in tlog.read(log)
        if entry.frame.message_id not in without
    )


def test_report_of_a_foreign_log_shows_what_it_contains(tmp_path: Path, recorded: Flight) -> None:
    bare = tmp_path / "bare.tlog"
    bare.write_bytes(of_kinds(PX4, {31, 32, 82, 83, 84}))  # ATTITUDE, GLOBAL_POSITION_INT
    whole, flight = recorded, read(bare)
    assert (
        "no commanded attitude: neither SET_ATTITUDE_TARGET of offboard nor ATTITUDE_TARGET"
        in flight.missing
    )
    assert any("position is that of GLOBAL_POSITION_INT" in each for each in flight.missing)
    assert math.isnan(flight.score.completed)
    climbed = [-part.history.position["position_ned_m"][:, 2] for part in (whole, flight)]
    assert [np.ptp(each) for each in climbed] == pytest.approx([5.0, 5.0], abs=1.5)
    assert np.ptp(climbed[0]) == pytest.approx(np.ptp(climbed[1]), abs=0.3)
    rolls = [part.history.attitude["quaternion"][:, 1].max() for part in (whole, flight)]
    assert rolls[0] == pytest.approx(rolls[1], abs=0.01)
    assert [m.what for m in flight.history.modes] == [m.what for m in whole.history.modes]
    assert all(math.isfinite(m.time_s) for m in flight.history.modes[1:])
    arducopter = read(ARDUCOPTER)
    assert arducopter.facts["autopilot"] == "ardupilot"
    assert "no ATTITUDE_QUATERNION: the attitude is that of ATTITUDE" in arducopter.missing
    flooded = replace(arducopter, score=replace(arducopter.score, other_datagrams=31.0))
    shown = page([flooded])
    assert "no records of offboard" in shown
    assert "31 datagrams of others" in shown


def test_global_position_does_not_replace_our_local_position(tmp_path: Path, flown: Flown) -> None:
    """Its reference has the origin of LOCAL_POSITION_NED; GLOBAL_POSITION_INT has another one."""
    bare = tmp_path / "bare.tlog"
    codec = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
    place = codec.global_position_int_encode(60_000, 470_000_000, 80_000_000, 0, 0, 0, 0, 0, 0)
    ours = of_kinds(flown.directory / "flight.tlog", {32})
    bare.write_bytes(ours + STAMP + place.pack(codec))
    history = read(bare).history
    assert len(history.reference) > 10
    assert (len(history.position), history.substitutes) == (0, ())


@pytest.mark.parametrize(
    ("origin", "moved", "north_m"),
    [(True, False, 111.195), (False, False, 0.0), (True, True, 111.195)],
)
def test_home_position_is_the_origin_only_without_global_origin(
    tmp_path: Path, origin: bool, moved: bool, north_m: float
) -> None:
    """ArduCopter's HOME_POSITION has zeros as local position wherever home is. 0.001 degrees of
    latitude are 111.195 m on a sphere of 6371 km. An origin that a ground station sets in flight is
    ignored, because the positions before it are relative to the old one."""
    codec = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
    ours = mavlink.MAVLink(None, srcSystem=1, srcComponent=191)
    home = 470_010_000, 80_000_000
    messages = [
        mavlink.MAVLink_heartbeat_message(2, 3, 0, 0, 4, 3),
        *([codec.gps_global_origin_encode(470_000_000, 80_000_000, 500_000)] if origin else []),
        codec.home_position_encode(*home, 500_000, 0.0, 0.0, 0.0, [1.0, 0.0, 0.0, 0.0], 0, 0, 0),
        codec.local_position_ned_encode(1000, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0),
        codec.sim_state_encode(1.0, *[0.0] * 14, 500.0, *[0.0] * 5, *home),
        codec.sim_state_encode(1.0, *[0.0] * 14, 500.0, *[0.0] * 5, 0, 0),  # as in MAVLink 1
    ]
    decided = ours.debug_float_array_encode(10**6, b"pso", RECORD_ID, [0.0] * 58)
    elsewhere = codec.gps_global_origin_encode(480_000_000, 80_000_000, 500_000)
    frames = [each.pack(codec) for each in messages]
    if moved:
        frames += [decided.pack(ours), elsewhere.pack(codec)]
    log = tmp_path / "x.tlog"
    log.write_bytes(b"".join(STAMP + each for each in frames))
    (row,) = read(log).history.truth
    assert row["position_ned_m"] == pytest.approx([north_m, 0.0, 0.0], abs=0.01)


OTHER = mavlink.MAVLink_heartbeat_message(2, 3, 0, 0, 4, 3).pack(mavlink.MAVLink(None, 9, 1))


def test_second_vehicle_in_a_foreign_log_is_named(tmp_path: Path, recorded: Flight) -> None:
    log = tmp_path / "two.tlog"
    log.write_bytes(PX4.read_bytes() + STAMP + OTHER)
    said = f"{log}: of several vehicles the first is used, not system 9"
    assert set(read(log).missing) == {*recorded.missing, said}


def test_report_names_the_place_of_log_damage(tmp_path: Path, recorded: Flight) -> None:
    data = bytearray(PX4.read_bytes() + STAMP + OTHER + STAMP + OTHER)
    at = len(data) // 2
    data[at : at + 500] = bytes(500)
    damaged = tmp_path / "damaged.tlog"
    damaged.write_bytes(data[:-5])
    flight = read(damaged)
    (said,) = (each for each in flight.missing if "damaged entry" in each)
    found = re.search(r"the first at byte (\d+), at ([0-9.]+) s", said)
    assert found
    assert at - 300 < int(found[1]) <= at
    before = tmp_path / "before.tlog"
    before.write_bytes(data[: int(found[1])])
    expected_s = next(
        entry.message.time_boot_ms / 1e3
        for entry in reversed(list(tlog.read(before)))
        if entry.name in ("ATTITUDE_QUATERNION", "LOCAL_POSITION_NED")
    )
    assert float(found[2]) == pytest.approx(expected_s, abs=0.01)
    last_s, whole_s = (each.history.position["time_s"][-1] for each in (flight, recorded))
    assert last_s == pytest.approx(whole_s, abs=0.1)
    assert any(each.startswith("the log ends within an entry, at byte") for each in flight.missing)


@given(
    st.lists(st.floats(-1e6, 1e6) | st.just(math.nan), min_size=1, max_size=300), st.integers(1, 40)
)
def test_thinning_keeps_peaks_and_gaps(values: list[float], bins: int) -> None:
    array = np.array(values)
    kept = thinned(array, bins)
    assert (np.diff(kept) > 0).all()
    assert len(kept) <= max(3 * bins + 2, len(values) * (len(values) <= 2 * bins))
    known = array[np.isfinite(array)]
    if len(known):
        assert np.nanmax(array[kept]) == known.max()
        assert np.nanmin(array[kept]) == known.min()
    assert np.isnan(array[kept]).any() == (len(known) < len(array))


@given(st.lists(st.floats(1e-16, 1e6) | st.just(math.nan) | st.just(0.0), max_size=20))
def test_a_logarithmic_axis_holds_all_values_and_has_few_ticks(values: list[float]) -> None:
    axis = logarithmic(values)
    low, high = axis["range"]
    assert all(low < math.log10(value) < high for value in values if value > 0.0)
    assert 1 <= sum(low < math.log10(at) < high for at in axis["tickvals"]) <= 9
    assert len(axis["tickvals"]) <= (9 if high - low < 2.2 else 5)


def invoke(*arguments: object) -> tuple[int, str]:
    answer = CliRunner().invoke(app, ["report", *map(str, arguments)])
    said = answer.exception if isinstance(answer.exception, UserError) else answer.output
    return answer.exit_code, str(said)


def test_report_command_overwrites_nothing_and_refuses_non_logs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    log = tmp_path / "x.tlog"
    with lzma.open(RECORDINGS / "px4-1.16.1-ground.tlog.xz") as recording:
        log.write_bytes(recording.read())
    (tmp_path / "report.html").write_text("precious")
    code, said = invoke(log)
    assert (code, "report-2.html" in said) == (0, True), said
    assert (tmp_path / "report.html").read_text() == "precious"
    assert "<html" in (tmp_path / "report-2.html").read_text(encoding="utf-8")
    assert "exists already; choose another file" in invoke(log, "-o", log)[1]

    def no_links(*_: object) -> None:  # as on exFAT with macOS
        raise OSError(errno.ENOTSUP, os.strerror(errno.ENOTSUP))

    monkeypatch.setattr(os, "link", no_links)
    (tmp_path / "report-2.html").unlink()
    assert invoke(log)[0] == 0
    for content in (b"", b"no log" * 100):
        (tmp_path / "y.tlog").write_bytes(content)
        assert "is empty or not a .tlog" in invoke(tmp_path / "y.tlog")[1]
    assert "does not exist" in invoke(tmp_path / "nothing")[1]
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        "report-2.html", "report.html", "x.tlog", "y.tlog",
    ]  # fmt: skip
