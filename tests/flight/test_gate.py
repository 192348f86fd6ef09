"""The last check of a setpoint (`outbox.admit`) and the authority: flights of one tick, drawn by
Hypothesis.

A flight is a history of reports, requests and pauses, followed by one setpoint. The oracle states
the rules as a pattern over the reported modes, and as numbers; it calls neither module.

OFFBOARD_GATE_TICKS=100000 draws that many flights instead of the default number.
"""

from __future__ import annotations

import doctest
import math
import os
import re
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from offboard.flight import authority as module
from offboard.flight.authority import Authority, Standing
from offboard.flight.outbox import Refused, admit
from offboard.flight.record import Refusal
from offboard.mavlink.dialects.base import SetpointLoss
from offboard.model.command import Command, PositionCommand
from simulator import config

TICKS = int(os.environ.get("OFFBOARD_GATE_TICKS", "400"))
MANY = settings(
    max_examples=TICKS, derandomize=True, deadline=None, suppress_health_check=list(HealthCheck)
)
FRESH_S = 2.5  # greatest age of a report of the mode
BEFORE_PAUSE_ENDS_S = 0.6  # longest time from the arrival of a report to the end of a pause
VEHICLE = config.vehicle("px4_sih")
LEAST_MPS2, MOST_MPS2 = VEHICLE.gravity_mps2 / 3.0, VEHICLE.gravity_mps2 / VEHICLE.hover_thrust
FLOAT32_MAX = float(np.finfo(np.float32).max)

# --- histories ------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Occurrence:
    """One event of the history, `after_s` after the event before. In mode E the vehicle follows
    setpoints, in H and L it holds and lands; B and O are other modes."""

    kind: str  # report, ask, request, pause, lose
    after_s: float = 0.1
    mode: str = ""
    failsafe: bool = False
    waited_s: float = 0.0  # time from the arrival of a report to its processing


def occurrences(kinds: list[str], modes: str = "-") -> st.SearchStrategy[Occurrence]:
    after_s = st.one_of(st.sampled_from([0.0, 0.1, 0.5]), st.floats(0.0, 4.0))
    waited_s = st.sampled_from([0.0, 0.0, 0.5, 0.7, 3.0])
    drawn = st.sampled_from(kinds), after_s, st.sampled_from(modes), st.booleans(), waited_s
    return st.builds(Occurrence, *drawn)


# A regular flight; it is cut at any place, and any event is inserted at any place
FLIGHT = [
    Occurrence({"?": "ask", "+": "request"}.get(each[0], "report"), mode=each[-1])
    for each in ("B", "?", "E", "E", "+H", "H", "H", "+L", "L")
]
REPORT = occurrences(["report"], "EEEBBHLO")
INSERTED = st.one_of(
    REPORT, REPORT, occurrences(["request"], "HL"), occurrences(["ask", "pause", "pause", "lose"])
)


def flight_of(cut: int, insertions: list[tuple[int, Occurrence]]) -> list[Occurrence]:
    history = FLIGHT[:cut]
    for index, occurrence in insertions:
        history.insert(index, occurrence)
    return history


HISTORY = st.builds(
    flight_of,
    st.sampled_from([0, 1, 2, 3, 3, 4, 4, 4, 5, 6, 7, 8, 9]),
    st.lists(st.tuples(st.integers(0, 12), INSERTED), max_size=4),
)


def replayed(history: list[Occurrence], *, failsafes: bool = True) -> tuple[Authority, float]:
    """Return the authority after the history, and the time of its end."""
    authority, now_s = Authority("E"), 100.0
    for each in history:
        now_s += each.after_s
        if each.kind == "report":
            arrived_s, failsafe = now_s - each.waited_s, each.failsafe and failsafes
            authority.on_mode(each.mode, now_s, arrived_s=arrived_s, failsafe=failsafe)
        elif each.kind == "ask":
            authority.ask()
        elif each.kind == "request":
            authority.request(each.mode)
        elif each.kind == "pause":
            authority.doubt(now_s, 0.9)
        else:
            authority.lose("by a test", now_s, heartbeat=True)
    return authority, now_s


def since_asked(history: list[Occurrence]) -> str | None:
    """Return the modes reported since our first request, after the mode in which it was made; None
    without a request."""
    shown, asked, letters = "?", False, ""
    for each in history:
        if each.kind == "report":
            shown = each.mode
            letters += each.mode if asked else ""
        elif each.kind == "ask" and not asked:
            asked, letters = True, shown
    return letters if asked else None


def may_set(history: list[Occurrence]) -> bool:
    """Whether only the mode in which we asked, and after it only ours was reported."""
    letters = since_asked(history)
    if any(each.kind == "lose" for each in history):
        return False
    return letters is None or re.fullmatch(rf"{re.escape(letters[0])}*E*", letters) is not None


def may_command(history: list[Occurrence]) -> bool:
    """Whether a setpoint is allowed, or each later mode was requested after the one before it."""
    if may_set(history):
        return True
    letters = since_asked(history)
    if any(each.kind == "lose" for each in history) or letters is None:
        return False
    began = re.match(rf"{re.escape(letters[0])}*E+", letters) or re.match(r"E+", letters)
    if began is None:
        return False
    first = next(i for i, each in enumerate(history) if each.kind == "ask")
    reports = [i for i in range(first, len(history)) if history[i].kind == "report"]
    current, reason = "E", -1
    for i in reports[began.end() - 1 :]:
        mode = history[i].mode
        if mode == current:
            continue
        requests = (j for j in range(reason + 1, i) if history[j].kind == "request")
        reason = next((j for j in requests if history[j].mode == mode), -1)
        if reason < 0:
            return False
        current = mode
    return True


def is_fresh(history: list[Occurrence], late_s: float) -> bool:
    """Whether, `late_s` after the end, the newest report that counts is at most 2.5 s old."""
    now_s, newest_s, arrived_s, counts_from_s = 100.0, -math.inf, -math.inf, -math.inf
    for each in history:
        now_s += each.after_s
        if each.kind == "pause":
            counts_from_s = now_s - BEFORE_PAUSE_ENDS_S
            newest_s = -math.inf if arrived_s < counts_from_s else newest_s
        elif each.kind == "report":
            arrived_s = now_s - each.waited_s
            newest_s = now_s if arrived_s >= counts_from_s else newest_s
    return now_s + late_s - newest_s <= FRESH_S


# --- setpoints ------------------------------------------------------------------------------------

SPECIAL = [math.nan, math.inf, -math.inf, 0.0, -0.0, 5e-324, -5e-324, 1e38, 1e39, 1e308]
ANY = st.one_of(st.floats(), st.sampled_from(SPECIAL))
ANGLE = st.floats(-math.pi, math.pi)


def leaning(tilt_rad: float, heading_rad: float, length: float) -> tuple[float, float, float]:
    lateral = length * math.sin(tilt_rad)
    down = length * math.cos(tilt_rad)
    return lateral * math.cos(heading_rad), lateral * math.sin(heading_rad), down


LENGTH = st.sampled_from([1.0, 1.0, 1.0, 1.0, 0.9905, 1.0095, 0.9895, 1.0105, 0.0, 1e200])
VERTICAL = st.tuples(st.sampled_from(SPECIAL[3:7]), st.sampled_from(SPECIAL[3:7]), st.just(-1.0))
LEANING = st.builds(leaning, ANGLE, ANGLE, LENGTH)
POSITION = st.lists(st.one_of(*[st.just(1.0)] * 20, ANY), min_size=11, max_size=11)
SETPOINT = st.one_of(
    st.builds(Command, st.floats(-5.0, 50.0), st.one_of(LEANING, VERTICAL), ANGLE),
    st.builds(Command, ANY, st.one_of(LEANING, st.tuples(ANY, ANY, ANY)), ANY),
    st.builds(lambda v: PositionCommand(tuple(v[:3]), tuple(v[3:6]), tuple(v[6:9]), *v[9:]),
              POSITION),
)  # fmt: skip


def is_usable(command: Command | PositionCommand) -> bool:
    """Whether every number fits into float32, as in messages, and a direction has the length 1."""
    numbers = np.hstack([getattr(command, name) for name in vars(type(command))["__match_args__"]])
    if not (np.abs(numbers.astype(float)) <= FLOAT32_MAX).all():
        return False
    if isinstance(command, PositionCommand):
        return True
    length = np.linalg.norm(np.array(command.thrust_direction_ned, dtype=np.longdouble))
    return bool(0.99 <= length <= 1.01)


def tilt_of(command: Command) -> float:
    north, east, down = (np.longdouble(each) for each in command.thrust_direction_ned)
    return float(np.arctan2(np.sqrt(north**2 + east**2), down))


# --- the properties -------------------------------------------------------------------------------

OURS, LEVEL = [Occurrence("report", mode="E")], (0.0, 0.0, 1.0)
HOVER = Command(9.8, LEVEL, 0.0)


def judge(
    history: list[Occurrence],
    command: Command | PositionCommand,
    later_s: float = 0.0,
    on_ground: bool = False,
    age_s: float = 0.0,
    age_limit_s: float = 0.25,
    late_s: float = 0.0,
) -> Command | PositionCommand | None:
    """Run one tick. Return the setpoint that is sent, within the limits; None if it is refused, for
    a reason that the oracle expects."""
    authority, end_s = replayed(history)
    reasons = {
        Refusal.NOT_OURS: not (may_set(history) and is_fresh(history, later_s)),
        Refusal.STALE: not age_s <= age_limit_s,
        Refusal.LATE: not late_s <= 0.0,
        Refusal.UNUSABLE: not is_usable(command),
    }
    ours = authority.permits_setpoint(end_s + later_s)
    try:
        sent = admit(
            command, VEHICLE, ours=ours, on_ground=on_ground, age_s=age_s,
            age_limit_s=age_limit_s, late_s=late_s,
        )  # fmt: skip
    except Refused as refused:
        why = refused.why
    else:
        why = None
    assert reasons[why] if why else not any(reasons.values())
    if why:
        return None
    if isinstance(command, PositionCommand):
        assert sent == command
        return sent
    assert isinstance(sent, Command)
    least_mps2 = 0.0 if on_ground else LEAST_MPS2
    clipped_mps2 = float(np.clip(command.thrust_mps2, least_mps2, MOST_MPS2))
    assert sent.thrust_mps2 == pytest.approx(clipped_mps2, abs=1e-12)
    assert is_usable(sent)
    assert sent.heading_rad == command.heading_rad
    assert tilt_of(sent) <= VEHICLE.tilt_max_rad + 1e-9
    if tilt_of(command) <= VEHICLE.tilt_max_rad - 1e-9:
        assert sent.thrust_direction_ned == command.thrust_direction_ned
    else:  # the tilt is reduced within the vertical plane of the direction
        (north, east, _), (n, e, _) = command.thrust_direction_ned, sent.thrust_direction_ned
        assert north * e == pytest.approx(east * n, abs=1e-9)
        assert north * n + east * e >= 0.0
    return sent


LATER = st.one_of(st.sampled_from([0.0, 0.1]), st.floats(0.0, 4.0))
TIME = st.one_of(st.floats(-0.1, 0.1), st.just(0.0), st.floats(-0.1, 3.0), ANY)
LATE = st.one_of(st.just(0.0), TIME)


PAUSED = [*FLIGHT[:4], Occurrence("pause", after_s=0.7)]
WAITED = [*PAUSED, Occurrence("report", mode="E", waited_s=0.8)]


@MANY
@example((WAITED, HOVER, 0.0, False, 0.0, 1.0, 0.0))  # the report arrived before the pause ended
@given(st.tuples(HISTORY, SETPOINT, LATER, st.booleans(), TIME, st.floats(0.1, 2.0), LATE))
def test_admitted_setpoints_agree_with_the_oracle(tick: Any) -> None:
    judge(*tick)


@MANY
@example([*FLIGHT, Occurrence("report", mode="H")], 0.0)  # back from landing: a pilot's choice
@given(HISTORY, LATER)
def test_commands_need_authority(history: list[Occurrence], later_s: float) -> None:
    authority, end_s = replayed(history, failsafes=False)
    expected = may_command(history) and is_fresh(history, later_s)
    assert authority.permits_command(end_s + later_s) is expected


@pytest.mark.parametrize(
    ("command", "named", "sent"),
    [
        (HOVER, {"age_s": 0.25}, True),
        (HOVER, {"age_s": 0.2501}, False),
        (HOVER, {"age_s": math.nan}, False),
        (HOVER, {"late_s": math.nan}, False),
        (HOVER, {"later_s": 2.51}, False),
        (Command(math.nan, LEVEL, 0.0), {}, False),
        (Command(9.8, (0.0, 0.0, 0.0), 0.0), {}, False),
        (Command(9.8, LEVEL, 1e39), {}, False),  # encoding it would raise after the check
        (PositionCommand((0.0, 1e39, 0.0), (0.0,) * 3, (0.0,) * 3, 0.0, 0.0), {}, False),
        # the length of (5e-324, 5e-324) is rounded to 5e-324, so that both components become 1
        (Command(9.8, (5e-324, 5e-324, -1.0), 0.0), {}, True),
    ],
)
def test_boundary_setpoints_are_admitted_or_refused(
    command: Command | PositionCommand, named: dict[str, float], sent: bool
) -> None:
    assert (judge(OURS, command, **named) is not None) is sent  # type: ignore[arg-type]
    assert judge([], command, **named) is None  # type: ignore[arg-type]


# --- a failsafe that interrupts -------------------------------------------------------------------


def test_authority_docstring_example_passes() -> None:
    assert doctest.testmod(module) == (0, 8)


HELD = [Occurrence("report", mode="E"), Occurrence("ask"), *FLIGHT[4:6]]


@pytest.mark.parametrize(
    ("shown", "standing", "commands"),
    [
        ("O!", Standing.HANDED, False),  # a failsafe may interrupt; no command meanwhile
        ("O! H!", Standing.HANDED, True),
        ("O! H! O", Standing.LOST, False),
        ("E", Standing.LOST, False),
    ],
)
def test_failsafe_may_interrupt_a_requested_mode(
    shown: str, standing: Standing, commands: bool
) -> None:
    reports = [
        Occurrence("report", mode=each[0], failsafe=each.endswith("!")) for each in shown.split()
    ]
    authority, now_s = replayed([*HELD, *reports])
    assert authority.standing is standing
    assert authority.permits_command(now_s) is commands
    assert replayed([*HELD[:2], *reports])[0].standing is (
        Standing.OURS if shown == "E" else Standing.LOST  # in mode E any failsafe takes the vehicle
    )


def test_failsafe_shown_during_a_pause_permits_no_command() -> None:
    """A pilot may have taken the vehicle since, in the same mode."""
    authority, _ = replayed(HELD[:2])
    authority.setpoint_loss = SetpointLoss(1.0, ("POSCTL",))

    def permits(heartbeat: bool, arrived_s: float) -> bool:
        authority.on_mode(
            "POSCTL",
            207.0,
            arrived_s=arrived_s,
            failsafe=True,
            heartbeat=heartbeat,
            setpoints_missing=True,
        )
        assert authority.standing is Standing.FAILSAFE
        return authority.permits_command(207.0)

    assert permits(True, 248.0)
    authority.doubt(250.0, 1.3)
    reports = ((True, 249.8), (False, 250.3), (True, 250.8), (False, 251.3))
    assert [permits(*report) for report in reports] == [False, False, True, True]
    authority.forget(207.5)  # after a restart the same mode is not the failsafe of our flight
    authority.on_mode("POSCTL", 208.0, failsafe=True, heartbeat=False)
    assert authority.standing is Standing.LOST


def test_first_loss_of_authority_is_reported() -> None:
    authority, _ = replayed([*HELD[:2], Occurrence("report", mode="B")])
    authority.lose("the supervisor has it", 109.0, heartbeat=True)
    assert authority.lost_reason == "the vehicle left E for B"
    assert authority.lost_s == -math.inf  # reported by a HEARTBEAT
    assert math.isinf(Authority("E").lost_s)
