"""Authority: whose the vehicle is, after given reports and requests. `test_gate.py` draws more."""

from __future__ import annotations

import doctest
import math

import pytest

from offboard.flight import authority as module
from offboard.flight.authority import Authority, Standing
from offboard.mavlink.dialects.base import SetpointLoss

FREE, ASKED, OURS, HANDED, LOST = (
    Standing[name] for name in ("FREE", "ASKED", "OURS", "HANDED", "LOST")
)
ENGAGED = "POSCTL ask OFFBOARD"
HELD = f"{ENGAGED} +AUTO.LOITER AUTO.LOITER"


def told(script: str) -> Authority:
    """After these events, 0.1 s apart from 0 s on, and from 40 s of host time: `ask` asks for
    OFFBOARD, `+MODE` requests another mode; the others are reports, `MODE!` in a failsafe."""
    authority = Authority("OFFBOARD")
    for index, event in enumerate(script.split()):
        at_s, mode = 0.1 * index, event.strip("+!")
        if event == "ask":
            authority.ask()
        elif event.startswith("+"):
            authority.request(mode)
        else:
            failsafe = event.endswith("!")
            authority.on_mode(mode, at_s, arrived_s=40.0 + at_s, failsafe=failsafe)
    return authority


def test_the_example_of_the_docstring() -> None:
    assert doctest.testmod(module) == (0, 8)


@pytest.mark.parametrize(
    ("script", "standing", "commands"),
    [
        ("POSCTL OFFBOARD ALTCTL", FREE, True),  # any mode may be shown before we ask
        ("POSCTL ask", ASKED, True),
        ("POSCTL ask POSCTL", ASKED, True),
        ("OFFBOARD ask", OURS, True),  # found in the mode already
        (ENGAGED, OURS, True),
        ("POSCTL ask ALTCTL", LOST, False),
        ("POSCTL ask ALTCTL OFFBOARD", LOST, False),
        (f"{ENGAGED} POSCTL OFFBOARD", LOST, False),
        ("OFFBOARD ask UNKNOWN(0x00000000)", LOST, False),
        (f"{ENGAGED} AUTO.RTL!", LOST, False),  # a failsafe takes a vehicle that follows us
        (HELD, HANDED, True),
        (f"{HELD} +AUTO.LAND AUTO.LAND", HANDED, True),
        (f"{HELD} +AUTO.LAND AUTO.LAND AUTO.LOITER", LOST, False),  # back: a pilot's choice
        (f"{HELD} AUTO.RTL!", HANDED, False),  # a failsafe may interrupt; nothing meanwhile
        (f"{HELD} AUTO.RTL! AUTO.LOITER!", HANDED, True),
        (f"{HELD} AUTO.RTL! AUTO.LOITER! AUTO.RTL", LOST, False),
    ],
)
def test_what_reports_lead_to(script: str, standing: Standing, commands: bool) -> None:
    authority = told(script)
    assert authority.standing is standing
    assert authority.permits_setpoint(1.0) is (standing in (FREE, ASKED, OURS))
    assert authority.permits_command(1.0) is commands
    assert not authority.permits_setpoint(3.6)
    assert not authority.permits_command(3.6)


def test_a_report_permits_for_two_and_a_half_seconds() -> None:
    authority = told(ENGAGED)  # the newest at 0.2 s
    assert [authority.permits_setpoint(now_s) for now_s in (2.69, 2.71)] == [True, False]
    authority.on_mode("OFFBOARD", 9.0)  # the end of the silence: still ours
    assert authority.permits_setpoint(9.1)


@pytest.mark.parametrize(
    ("ends_s", "arrived_s", "counts"),
    [(50.0, 49.39, False), (50.0, 49.41, True), (40.79, None, True), (40.81, None, False)],
)
def test_after_a_pause_only_reports_that_have_just_arrived_count(
    ends_s: float, arrived_s: float | None, counts: bool
) -> None:
    """At most 0.6 s before its end: one that is read after it, or the newest, of 40.2 s."""
    authority = told(ENGAGED)
    authority.doubt(ends_s, 0.9)
    if arrived_s is not None:
        assert not authority.permits_setpoint(0.2)
        authority.on_mode("OFFBOARD", 0.2, arrived_s=arrived_s)
    assert authority.permits_setpoint(0.2) is counts
    assert authority.heard(0.2)
    authority.on_mode("POSCTL", 0.3, arrived_s=40.3)  # of before: still a take-over
    assert authority.standing is LOST


def test_a_failsafe_that_was_shown_within_a_pause_permits_nothing() -> None:
    """A pilot may have taken it since, in the same mode."""
    authority = told(ENGAGED)
    authority.loss = SetpointLoss(1.0, ("POSCTL",))
    authority.doubt(50.0, 1.3)
    for heartbeat, arrived_s, permitted in ((True, 49.8, False), (False, 50.3, False),
                                            (True, 50.8, True)):  # fmt: skip
        authority.on_mode(
            "POSCTL", 7.0, arrived_s=arrived_s, failsafe=True, heartbeat=heartbeat, starved=True
        )
        assert authority.standing is Standing.FAILSAFE
        assert authority.permits_command(7.0) is permitted


def test_the_first_loss_is_the_one_that_is_told() -> None:
    authority = told(f"{ENGAGED} POSCTL")
    authority.lose("the supervisor has it", 9.0)
    assert authority.lost_reason == "the vehicle left OFFBOARD for POSCTL"
    assert authority.lost_s == -math.inf  # HEARTBEAT has shown it
    assert math.isinf(told("POSCTL ask").lost_s)
