"""Recovery: what the supervisor asks of a vehicle without controller, against scripts of what the
vehicle shows. The process and its sockets are in `test_supervisor.py`."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest

from offboard.mavlink.dialects.ardupilot import ARDUPILOT
from offboard.mavlink.dialects.base import Dialect
from offboard.mavlink.dialects.px4 import PX4
from offboard.mavlink.events import (
    CommandAck,
    Event,
    Heartbeat,
    LocalPosition,
    ModeReport,
    SystemHealth,
    VehicleFound,
)
from offboard.supervisor.recovery import LONGEST_S, Recovery, Supervised

HOLD, LAND = 176, 21  # MAV_CMD_DO_SET_MODE, MAV_CMD_NAV_LAND
FIRMWARES = pytest.mark.parametrize("dialect", [PX4, ARDUPILOT], ids=["px4", "ardupilot"])
VEHICLE = VehicleFound(1, 1, "px4")
OURS = Supervised(VEHICLE, ours=True, flying=True, reported_s=math.inf)
DISARMED, TOO_LONG = "the vehicle is disarmed", f"not landed after {LONGEST_S:.0f} s"
Timed = tuple[float, Event]
ACCEPTED = (0.05, CommandAck(HOLD, "ACCEPTED"))


def asked(
    dialect: Dialect, *events: Timed, shown: str = "", known: Supervised = OURS
) -> tuple[list[tuple[float, int]], str]:
    """What is asked, and when, of a vehicle that has shown the mode `shown` 0.4 s before the
    recovery begins at 0 s, and reports these `events` at these times; and how it ended."""
    recovery, waiting = Recovery(dialect, known, 0.0, 0.0), sorted(events, key=lambda each: each[0])
    if shown:
        recovery.see(Heartbeat(shown, True, 4, 2), -0.4)
    commands: list[tuple[float, int]] = []
    now_s, end_s = 0.0, 1.0 + (waiting[-1][0] if waiting else LONGEST_S)
    while not recovery.end_reason and now_s < end_s:
        request = recovery.due(now_s)
        commands += [(now_s, request.command)] if request else []
        while waiting and waiting[0][0] <= now_s:
            at_s, event = waiting.pop(0)
            recovery.see(event, at_s)
        now_s = round(now_s + 0.02, 2)
    return commands, recovery.end_reason


def beats(mode: str, first_s: float, last_s: float, *, armed: bool = True) -> list[Timed]:
    """HEARTBEAT shows this mode once a second."""
    count = math.floor(last_s - first_s) + 1
    return [(first_s + number, Heartbeat(mode, armed, 4, 2)) for number in range(count)]


def words(commands: list[tuple[float, int]]) -> list[int]:
    return [command for _, command in commands]


@FIRMWARES
@pytest.mark.parametrize("answered_s", [0.05, 0.55], ids=["at once", "the second request"])
def test_hold_at_once_then_land_until_disarmed(dialect: Dialect, answered_s: float) -> None:
    """Also if the first acknowledgement is lost: on a real PX4 the controller had read it."""
    commands, ended = asked(
        dialect,
        (answered_s, CommandAck(HOLD, "ACCEPTED")),
        *beats(dialect.hold_mode, 0.5, 5.5),
        *beats(dialect.land_mode, 6.5, 13.5),
        *beats(dialect.land_mode, 14.5, 14.5, armed=False),
        shown=dialect.engage_mode,
    )
    assert ended == DISARMED
    assert commands[0] == (0.0, HOLD)
    assert set(words(commands[:-1])) == {HOLD}
    assert commands[-1][1] == LAND
    assert 5.0 <= commands[-1][0] <= 6.6
    assert len(commands) <= 3


@FIRMWARES
def test_only_what_is_ours_is_asked_for_more(dialect: Dialect) -> None:
    """Hold that the vehicle has not acknowledged, or that it showed before, is somebody's choice;
    one that the controller had asked for is ours."""
    holds = beats(dialect.hold_mode, 0.5, 20.5)
    commands, ended = asked(dialect, *holds, shown=dialect.engage_mode)
    assert set(words(commands)) == {HOLD}
    assert ended.startswith(f"the vehicle shows {dialect.hold_mode}, and has not acknowledged")
    for shown in (dialect.hold_mode, "ALTCTL"):
        commands, ended = asked(dialect, shown=shown)
        assert (commands, ended.startswith(f"the vehicle shows {shown}")) == ([], True)
    holding = replace(OURS, holding=True)
    lands = [*holds[:5], *beats(dialect.land_mode, 5.5, 9.5, armed=False)]
    commands, ended = asked(dialect, *lands, shown=dialect.hold_mode, known=holding)
    assert (words(commands), ended) == ([LAND], DISARMED)


@FIRMWARES
def test_a_landing_goes_on(dialect: Dialect) -> None:
    """It was interrupted for 5 s of hold, and a hold that a pilot chose was taken for an answer."""
    landing = replace(OURS, landing=True)
    down = beats(dialect.land_mode, 8.5, 8.5, armed=False)
    for mode in (dialect.land_mode, dialect.engage_mode):
        commands, ended = asked(dialect, *beats(mode, 0.5, 7.5), *down, known=landing)
        assert (set(words(commands)), ended) == ({LAND}, DISARMED)
    commands, ended = asked(dialect, *beats(dialect.hold_mode, 0.5, 9.5), known=landing)
    assert (set(words(commands)), ended[:17]) == ({LAND}, "the vehicle shows")
    assert commands[-1][0] < 0.5


@FIRMWARES
def test_a_vehicle_that_is_not_heard_or_does_not_obey(dialect: Dialect) -> None:
    """Three requests if nothing at all is heard; else one for each report, at last to land."""
    commands, ended = asked(dialect)
    assert (words(commands), ended) == ([HOLD] * 3, TOO_LONG)
    commands, ended = asked(dialect, *beats(dialect.engage_mode, 0.5, LONGEST_S + 1.0))
    assert ended == TOO_LONG
    assert {command for at_s, command in commands if at_s < 5.0} == {HOLD}
    assert {command for at_s, command in commands if at_s > 5.0} == {LAND}
    assert len(commands) <= 3 + LONGEST_S


@FIRMWARES
@pytest.mark.parametrize("pilot_s", [0.2, 3.5, 12.5])
def test_a_pilot_is_never_overridden(dialect: Dialect, pilot_s: float) -> None:
    """Nothing is asked after the first report of his mode, before, in hold and in the landing."""
    mode = {"px4": "POSCTL", "ardupilot": "LOITER"}[dialect.name]
    obeyed = [*beats(dialect.hold_mode, 0.5, 5.5), *beats(dialect.land_mode, 6.5, 13.5)]
    before = [(at_s, event) for at_s, event in obeyed if at_s < pilot_s]
    commands, ended = asked(dialect, ACCEPTED, *before, *beats(mode, pilot_s, 20.5))
    assert ended == f"the vehicle shows {mode}: its pilot or its failsafe has it"
    assert all(at_s <= pilot_s for at_s, _ in commands)


HOLDS = [(0.5 + 0.5 * n, ModeReport(PX4.hold_mode)) for n in range(22)]
IN_LANDING = [*HOLDS[:10], *((5.9 + 0.5 * n, ModeReport(PX4.land_mode)) for n in range(3))]


@pytest.mark.parametrize(
    ("commands", "reports"),
    [
        # between our request and its effect, although the vehicle has acknowledged it
        *(([HOLD], [(s, ModeReport("POSCTL")), *HOLDS]) for s in (0.01, 0.31, 3.1)),
        # hold that arrived before the request left, and was read after it
        ([HOLD], [(-0.01, ModeReport(PX4.hold_mode)), *HOLDS]),
        # hold after the landing mode
        ([HOLD, LAND], [*IN_LANDING, *((6.92 + 0.1 * n, HOLDS[0][1]) for n in range(51))]),
    ],
)
def test_a_mode_that_was_not_asked_for_is_final(commands: list[int], reports: list[Timed]) -> None:
    """Whatever is reported after it."""
    beat = [(12.1, Heartbeat(reports[-1][1].mode, True, 4, 2))]  # type: ignore[attr-defined]
    done, ended = asked(PX4, ACCEPTED, *reports, *beat, shown=PX4.engage_mode)
    assert words(done) == commands
    assert ended.startswith("the vehicle shows ")


def test_the_failsafe_for_missing_setpoints_may_act_a_little_early() -> None:
    """The newest setpoint left before the newest beat, and may have been lost."""
    loss = PX4.setpoint_loss({"COM_OF_LOSS_T": 1.0, "COM_OBL_RC_ACT": POSCTL})
    for at_s, end in ((0.6, "the vehicle shows POSCTL"), (0.8, DISARMED)):
        falls = [(at_s, Heartbeat("POSCTL", True, 5, 2)), *beats("POSCTL", 2.0, 2.0, armed=False)]
        known = replace(OURS, setpoint_loss=loss)
        _, ended = asked(PX4, *falls, shown=PX4.engage_mode, known=known)
        assert ended.startswith(end)


def test_from_hold_even_the_mode_of_that_failsafe_is_a_pilots_choice() -> None:
    """The controller has asked for hold; HEARTBEAT shows another failsafe, as an empty battery."""
    loss = PX4.setpoint_loss({"COM_OF_LOSS_T": 1.0, "COM_OBL_RC_ACT": POSCTL})
    switched = [(2.0 + n, Heartbeat("POSCTL", True, 5, 2)) for n in range(10)]
    known = replace(OURS, setpoint_loss=loss, holding=True)
    commands, ended = asked(PX4, *switched, shown=PX4.hold_mode, known=known)
    assert ended.startswith("the vehicle shows POSCTL")
    assert commands == []


def test_leaving_the_landing_mode_as_it_disarms_is_no_choice() -> None:
    left = [(7.5, ModeReport(PX4.hold_mode)), *beats(PX4.hold_mode, 12.1, 12.1, armed=False)]
    commands, ended = asked(PX4, ACCEPTED, *IN_LANDING, *left, shown=PX4.engage_mode)
    assert (words(commands), ended) == ([HOLD, LAND], DISARMED)


def test_a_refusal_is_kept_to_be_said() -> None:
    recovery = Recovery(PX4, OURS, 0.0, 0.0)
    for result, said in (("ACCEPTED", []), ("DENIED", ["the vehicle answers DENIED"])):
        recovery.see(CommandAck(HOLD, result), 0.1)
        assert recovery.news == said


# -- in the failsafe for missing setpoints ---------------------------------------------------------

POSCTL, RETURN, LANDS, LOITER = 0, 3, 4, 5  # COM_OBL_RC_ACT


def in_failsafe(fallback: int, *reports: Timed) -> tuple[list[float], str]:
    """When landing is asked for, and how it ends, of a PX4 whose failsafe acts at 0.8 s, 0.2 s late
    for our request to hold, and which reports this, too."""
    loss = PX4.setpoint_loss({"COM_OF_LOSS_T": 1.0, "COM_OBL_RC_ACT": fallback})
    known = replace(OURS, setpoint_loss=loss)
    assert known.silent_s == pytest.approx(0.6)
    (mode, *_) = loss.modes
    seconds = range(12)  # CURRENT_MODE shows it before HEARTBEAT does
    shown: list[Timed] = [(0.8 + n, ModeReport(mode)) for n in seconds]
    shown += [(0.9 + n, Heartbeat(mode, True, 5, 2)) for n in seconds]
    down = beats(mode, 12.8, 12.8, armed=False)
    commands, ended = asked(PX4, *shown, *reports, *down, shown=PX4.engage_mode, known=known)
    assert {command for _, command in commands} <= {HOLD, LAND}
    return [at_s for at_s, command in commands if command == LAND], ended


@pytest.mark.parametrize(("fallback", "sinks"), [(POSCTL, True), (POSCTL, False), (LOITER, False)])
def test_it_is_watched_and_landed_if_it_does_not_sink(fallback: int, sinks: bool) -> None:
    """The supervisor took its mode for a pilot's and gave up. POSCTL without sticks sinks."""
    falling = LocalPosition(0.0, (0.0, 0.0, -4.0), (0.0, 0.0, 0.7))
    places = [(0.9 + 0.5 * n, falling) for n in range(24)] if sinks else []
    landings_s, ended = in_failsafe(fallback, *places, (7.6, CommandAck(LAND, "ACCEPTED")))
    assert ended == DISARMED
    assert bool(landings_s) is not sinks
    assert all(at_s > 5.0 for at_s in landings_s)
    assert sinks or landings_s[0] < 7.5


def test_it_lands_by_itself_in_the_modes_that_do() -> None:
    for fallback in (RETURN, LANDS):
        assert in_failsafe(fallback) == ([], DISARMED)


def test_with_a_pilots_sticks_it_is_his() -> None:
    landings_s, ended = in_failsafe(POSCTL, (0.5, SystemHealth(True, 0.9, radio_ok=True)))
    assert (landings_s, ended) == (
        [], "the vehicle shows POSCTL: its pilot or its failsafe has it"
    )  # fmt: skip
