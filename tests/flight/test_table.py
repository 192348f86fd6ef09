"""The phase table: complete, bounded, acyclic, every row reachable, every reason sayable."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
from pair import hover

from offboard.flight.assessment import Progress
from offboard.flight.guards import Facts
from offboard.flight.phases import ENDS, ExitCode, Limits, Phase
from offboard.flight.table import TABLE, Row, next_row

ON_TRACK = (Phase.JOIN, Phase.TRACK, Phase.HOVER)
UNEVENTFUL = Facts(
    limits=Limits(),
    in_phase_s=0.0,
    silence_s=0.0,
    blind_s=0.0,
    found=False,
    ready=False,
    misconfigured=False,
    rebooted=False,
    engaged=True,
    landing=False,
    failsafe=False,
    armed=True,
    in_the_air=False,
    lifted_off=False,
    at_start=False,
    late_s=math.nan,
    track_time_s=math.nan,
    track_start_s=4.0,
    track_end_s=20.0,
    rest_time_s=23.5,
    position_error_m=0.0,
    tilt_rad=0.0,
    stop_requested=False,
    missed_decisions=0,
    contradicted=False,
)
QUIET = {  # what else a phase shows while it waits
    Phase.HEALTH: {"engaged": False, "armed": False},
    Phase.ENGAGE: {"engaged": False, "armed": False},
    Phase.ARM: {"armed": False},
    Phase.JOIN: {"track_time_s": 0.0},
    Phase.TRACK: {"track_time_s": 4.0},
    Phase.HOVER: {"track_time_s": 20.0},
}
EVENTS: dict[str, dict[str, object]] = {  # the least that makes each guard hold
    "vehicle_found": {"found": True},
    "ready": {"ready": True},
    "misconfigured": {"misconfigured": True},
    "armed_by_another": {"armed": True, "limits": Limits(begin_armed=False)},
    "flown_by_another": {"engaged": True, "armed": True},
    "rebooted": {"rebooted": True},
    "needs_no_stream": {"lifted_by_command": True},
    "streamed": {"in_phase_s": 1.0},
    "engaged": {"engaged": True},
    "engaged_in_the_air": {"engaged": True, "armed": True, "in_the_air": True},
    "armed": {"armed": True},
    "too_late_at_start": {"late_s": 91.0},
    "lifted_off": {"lifted_off": True},
    "at_start": {"at_start": True},
    "at_start_to_excite": {"at_start": True, "excites": True},
    "learnt": {"learnt": True},
    "at_full_speed": {"track_time_s": 4.0},
    "track_over": {"track_time_s": 20.0},
    "at_rest": {"track_time_s": 23.5},
    "disarmed": {"armed": False},
    "disarmed_for_good": {"armed": False, "in_phase_s": 1.6},
    "mode_taken": {"engaged": False},
    "taken_armed": {"engaged": False, "armed": True},
    "landing_taken": {"engaged": False},
    "silent": {"silence_s": 1.01},
    "lost": {"silence_s": 2.01},
    "silent_on_ground": {"silence_s": 20.1},
    "blind": {"blind_s": 0.51},
    "stop_requested": {"stop_requested": True},
    "diverged": {"position_error_m": 5.1},
    "toppled": {"tilt_rad": 1.31},
    "controller_failed": {"missed_decisions": 3},
    "contradicted": {"contradicted": True},
}


def quiet(phase: Phase) -> Facts:
    """Nothing happens in `phase`, which has just begun."""
    return replace(UNEVENTFUL, **QUIET.get(phase, {}))


def event_of(row: Row) -> dict[str, object]:
    name = row.guard.__name__
    if name.startswith("longer_than_"):
        return {"in_phase_s": getattr(Limits(), name.removeprefix("longer_than_")) + 0.1}
    return EVENTS[name]


@pytest.mark.parametrize("phase", [phase for phase in Phase if phase not in ENDS])
def test_nothing_happens_by_itself_but_time_ends_every_wait(phase: Phase) -> None:
    assert next_row(phase, quiet(phase)) is None
    later = {"track_time_s": 1e4} if phase in ON_TRACK else {"in_phase_s": 1e4}
    if phase is Phase.CLIMB:
        later = {"late_s": 1e4}  # after the way that was planned
    if phase is Phase.CONNECT:
        later = {"silence_s": 1e4}  # only the wall clock runs before there is telemetry
    assert next_row(phase, replace(quiet(phase), **later)) is not None


@pytest.mark.parametrize("row", TABLE, ids=lambda r: f"{r.source.value}: {r.guard.__name__}")
def test_every_row_is_reachable(row: Row) -> None:
    assert next_row(row.source, replace(quiet(row.source), **event_of(row))) is row


def test_ends_have_no_rows_and_every_other_phase_has() -> None:
    assert {row.source for row in TABLE} == {phase for phase in Phase if phase not in ENDS}


def test_no_way_back() -> None:
    order = {phase: index for index, phase in enumerate(Phase)}
    assert all(order[row.target] > order[row.source] for row in TABLE)


def test_every_abnormal_end_has_an_exit_code() -> None:
    """Its own, or that of each way into its phase."""
    for row in TABLE:
        if row.target in (Phase.FAILED, Phase.YIELDED) and row.exit_code is None:
            ways_in = [way.exit_code for way in TABLE if way.target is row.source]
            assert ways_in
            assert None not in ways_in
    assert {row.exit_code for row in TABLE} == {None, ExitCode.REFUSED, ExitCode.ABORTED}


def test_in_the_air_nothing_is_called_refused() -> None:
    for row in TABLE:
        if row.exit_code == ExitCode.REFUSED:
            assert row.source not in (Phase.TAKEOFF, Phase.CLIMB, *ON_TRACK, Phase.LAND)


def test_every_reason_has_its_words() -> None:
    assessment = hover().companion._machine._assessment
    course = Progress(Phase.CONNECT, 0.0, 0.0, False, "", 0, "")
    words = assessment.words(assessment.facts(course), course)
    for row in TABLE:
        assert "{" not in row.reason.format(**words)
