"""The phase table: complete, bounded, without cycles, every row and reason usable."""

from __future__ import annotations

from dataclasses import replace

import pytest
from pair import hover
from uneventful import UNEVENTFUL

from offboard.flight import ladder
from offboard.flight.facts import Facts
from offboard.flight.phases import ENDS, ExitCode, Limits, Phase, Rung
from offboard.flight.programme import FLY, IN_THE_AIR, Programme, asked, exits, service
from offboard.flight.requests import Request
from offboard.flight.transitions import TRANSITIONS, Row

ON_TRACK = (Phase.JOIN, Phase.TRACK, Phase.HOVER)
SERVICES = {
    then: service(then, "here", arms=True)  # type: ignore[arg-type]
    for then in ("hold", "land", "repeat")
}
PHASES = {row.source for row in TRANSITIONS}  # of `fly`
SERVED = [(then, row) for then, served in SERVICES.items() for row in served.rows]
QUIET = {  # facts of a phase while nothing happens
    Phase.HEALTH: {"engaged": False, "armed": False},
    Phase.ENGAGE: {"engaged": False, "armed": False},
    Phase.ARM: {"armed": False},
    Phase.JOIN: {"track_time_s": 0.0},
    Phase.TRACK: {"track_time_s": 4.0},
    Phase.HOVER: {"track_time_s": 20.0},
}
EVENTS: dict[str, dict[str, object]] = {  # the facts that make each guard hold
    "vehicle_found": {"found": True},
    "ready": {"ready": True},
    "refused": {"refused": True},
    "armed_by_another": {"armed": True, "limits": Limits(begin_armed=False)},
    "rebooted": {"rebooted": True},
    "rebooted_disarmed": {"rebooted": True, "armed": False, "landed": False},
    "needs_no_stream": {"lifted_by_command": True},
    "streamed": {"in_phase_s": 1.0},
    "engaged": {"engaged": True},
    "engaged_in_the_air": {"engaged": True, "armed": True, "in_the_air": True},
    "armed": {"armed": True},
    "too_late_at_start": {"late_s": 91.0},
    "lifted_off": {"lifted_off": True},
    "at_start": {"at_start": True},
    "at_start_to_excite": {"at_start": True, "excites": True},
    "identified": {"identified": True},
    "at_full_speed": {"track_time_s": 4.0},
    "track_over": {"track_time_s": 20.0},
    "at_rest": {"track_time_s": 23.5},
    "other_sender": {"other_sender": True},
    "other_vehicle": {"other_vehicle": True},
    "disarmed": {"armed": False},
    "disarmed_again": {"disarmed_again": True},
    "disarmed_for_good": {"armed": False, "in_phase_s": 1.6},
    "landed": {"armed": False},
    "disarmed_elsewhere": {"armed": False, "landed": False, "disarmed_s": 1.1},
    "lost": {"lost": True},
    "lost_armed": {"lost": True, "shown_since": True, "armed": True},
    "lost_disarmed": {"lost": True, "shown_since": True, "armed": False},
    "authority_unknown": {"authority_known": False},
    "silent": {"silence_s": 1.01},
    "silent_for_long": {"silence_s": 2.01},
    "in_own_failsafe": {"own_failsafe": True},
    "unheard_on_ground": {"authority_known": False},
    "out_of_reach": {"unreached_s": 300.1},
    "silent_on_ground": {"silence_s": 20.1},
    "blind": {"blind_s": 0.51},
    "stop_requested": {"stop_requested": True},
    "usable": {"ready": True},
    "engaged_by_pilot": {"switched": True, "in_the_air": True, "ready": True},
    "engaged_but_unfit": {
        "switched": True,
        "engaged": True,
        "armed": True,
        "in_the_air": True,
        "ready": False,
    },
    "started_in_the_air": {"request": Request.START, "in_the_air": True, "ready": True},
    "started_on_the_ground": {"request": Request.START, "armed": False, "ready": True},
    "engaged_too_soon": {"hasty": True, "in_the_air": True, "in_phase_s": 0.6},
    "abandoned": {
        "unclaimed": True,
        "left_engaged": True,
        "engaged": True,
        "armed": True,
        "in_the_air": True,
        "in_phase_s": 0.6,
    },
    "handed": {"handed": True},
    "requested_start": {"request": Request.START},
    "requested_pause": {"request": Request.PAUSE},
    "requested_continue": {"request": Request.CONTINUE},
    "requested_hand_back": {"request": Request.HAND_BACK},
    "ladder_hold": {"rung": Rung.HOLD},
    "ladder_land": {"rung": Rung.LAND},
}


def quiet(phase: Phase) -> Facts:
    """Nothing happens in `phase`, which has just begun."""
    return replace(UNEVENTFUL, **QUIET.get(phase, {}))


def event_of(row: Row) -> dict[str, object]:
    name = row.guard.__name__
    if name.startswith("longer_than_"):
        return {"in_phase_s": getattr(Limits(), name.removeprefix("longer_than_")) + 0.1}
    return EVENTS[name]


@pytest.mark.parametrize("phase", [phase for phase in Phase if phase in PHASES])
def test_no_event_no_transition_and_every_wait_is_limited(phase: Phase) -> None:
    assert FLY.next_row(phase, quiet(phase)) is None
    later = {"track_time_s": 1e4} if phase in ON_TRACK else {"in_phase_s": 1e4}
    if phase is Phase.CLIMB:
        later = {"late_s": 1e4}  # after the way that was planned
    if phase is Phase.CONNECT:
        later = {"silence_s": 1e4}  # only the wall clock runs before there is telemetry
    assert FLY.next_row(phase, replace(quiet(phase), **later)) is not None


@pytest.mark.parametrize("row", TRANSITIONS, ids=lambda r: f"{r.source.value}: {r.guard.__name__}")
def test_every_row_is_reachable(row: Row) -> None:
    assert FLY.next_row(row.source, replace(quiet(row.source), **event_of(row))) is row


def test_every_phase_but_the_ends_has_rows() -> None:
    unended = {phase for phase in Phase if phase not in ENDS}
    assert unended - PHASES == {Phase.STANDBY, Phase.PAUSE, Phase.HAND_BACK}
    for served in SERVICES.values():
        assert {row.source for row in served.rows} == unended


def named(value: str | Row) -> str:
    return value if isinstance(value, str) else f"{value.source.value}: {value.guard.__name__}"


@pytest.mark.parametrize(("then", "row"), SERVED, ids=named)
def test_every_row_of_the_service_is_reachable(then: str, row: Row) -> None:
    now = replace(quiet(row.source), **event_of(row))
    assert SERVICES[then].next_row(row.source, now) is row


def test_the_service_waits_for_ever() -> None:
    for served in SERVICES.values():
        for phase in (Phase.CONNECT, Phase.HEALTH, Phase.STANDBY, Phase.PAUSE):
            later = {"in_phase_s": 1e6, "silence_s": 0.0 if phase is Phase.PAUSE else 1e6}
            assert served.next_row(phase, replace(quiet(phase), **later)) is None
    hover = replace(quiet(Phase.HOVER), track_time_s=1e6)
    ends = {then: served.next_row(Phase.HOVER, hover) for then, served in SERVICES.items()}
    assert ends["hold"] is None
    assert ends["land"] is not None
    assert ends["land"].target is Phase.LAND
    assert ends["repeat"] is not None
    assert ends["repeat"].target is Phase.CLIMB


def test_the_service_arms_nothing_by_itself() -> None:
    """The only way to the phases that arm is a request on the ground."""
    for served in SERVICES.values():
        ways = [row for row in served.rows if row.target is Phase.STREAM]
        assert [row.guard.__name__ for row in ways] == ["started_on_the_ground"]


def test_every_row_leads_to_a_later_phase() -> None:
    order = {phase: index for index, phase in enumerate(Phase)}
    assert all(order[row.target] > order[row.source] for row in TRANSITIONS)


def test_every_abnormal_end_has_an_exit_code() -> None:
    """Its own, or that of each way into its phase."""
    for row in TRANSITIONS:
        if row.target in (Phase.FAILED, Phase.YIELDED) and row.exit_code is None:
            ways_in = [way.exit_code for way in TRANSITIONS if way.target is row.source]
            assert ways_in
            assert None not in ways_in
    assert {row.exit_code for row in TRANSITIONS} == {None, ExitCode.REFUSED, ExitCode.ABORTED}


@pytest.mark.parametrize("programme", [FLY, *SERVICES.values()], ids=["fly", *SERVICES])
def test_no_way_out_of_the_air_leaves_the_vehicle_unasked(programme: Programme) -> None:
    """Each row that ends a flight in the air is in a phase that asks for hold or land, or leads to
    one; or the vehicle is disarmed, or not ours any more. From the moment when it is ours, it is
    in such a phase."""
    rows = exits(programme)
    assert {row.source for row in rows} == IN_THE_AIR & {row.source for row in programme.rows}
    assert [(row.source, row.guard) for row in rows if not asked(row)] == []
    ours = replace(UNEVENTFUL, engaged=True, armed=True, in_the_air=True)
    for row in programme.rows:
        if row.source in (Phase.STREAM, Phase.ENGAGE) and row.target in ENDS:
            now = replace(ours, **event_of(row) | {"engaged": True, "armed": True})
            taken = programme.next_row(Phase.ENGAGE, now)
            assert taken is not None
            assert taken.target in IN_THE_AIR


def test_no_flight_in_the_air_ends_as_refused() -> None:
    for row in TRANSITIONS:
        if row.exit_code == ExitCode.REFUSED:
            assert row.source not in (Phase.TAKEOFF, Phase.CLIMB, *ON_TRACK, Phase.LAND)


def test_every_reason_has_its_figures() -> None:
    machine = hover().companion._machine
    figures = machine._figures(machine.facts())
    for row in (*TRANSITIONS, *ladder.ROWS):
        assert "{" not in row.reason.format(**figures)
