"""Authority: whose the vehicle is, after given reports and requests."""

from __future__ import annotations

import doctest
import math

import pytest

from offboard.flight import authority as module
from offboard.flight.authority import Authority, Standing
from offboard.mavlink.dialects.base import SetpointLoss


def shown(*modes: str, asked_after: int = 1) -> Authority:
    """Reports 0.1 s apart from 0 s on, and from 40 s of host time; we ask after the first
    `asked_after` of them."""
    authority = Authority("OFFBOARD")
    for index, mode in enumerate(modes):
        if index == asked_after:
            authority.ask()
        authority.on_mode(mode, 0.1 * index, arrived_s=40.0 + 0.1 * index)
    if asked_after >= len(modes):
        authority.ask()
    return authority


def test_the_example_of_the_docstring() -> None:
    failed, tried = doctest.testmod(module)
    assert (failed, tried) == (0, 8)


@pytest.mark.parametrize(
    ("modes", "standing"),
    [
        (["POSCTL"], Standing.ASKED),
        (["OFFBOARD"], Standing.OURS),  # found in the mode already
        (["POSCTL", "POSCTL"], Standing.ASKED),
        (["POSCTL", "OFFBOARD"], Standing.OURS),
        (["POSCTL", "ALTCTL"], Standing.LOST),
        (["POSCTL", "ALTCTL", "OFFBOARD"], Standing.LOST),
        (["POSCTL", "OFFBOARD", "POSCTL", "OFFBOARD"], Standing.LOST),
        (["OFFBOARD", "UNKNOWN(0x00000000)"], Standing.LOST),
    ],
)
def test_what_reports_lead_to(modes: list[str], standing: Standing) -> None:
    authority = shown(*modes)
    assert authority.standing is standing
    now_s = 0.1 * len(modes)
    assert authority.permits_setpoint(now_s) is (standing is not Standing.LOST)
    assert authority.permits_command(now_s) is (standing is not Standing.LOST)


def test_before_it_was_asked_for_any_mode_may_be_shown() -> None:
    authority = shown("POSCTL", "OFFBOARD", "ALTCTL", asked_after=9)
    assert authority.standing is Standing.ASKED
    authority.on_mode("OFFBOARD", 1.0)
    assert authority.standing is Standing.OURS


def test_a_report_permits_for_two_and_a_half_seconds() -> None:
    authority = shown("POSCTL", "OFFBOARD")  # the newest at 0.1 s
    assert authority.permits_setpoint(2.59)
    assert not authority.permits_setpoint(2.61)
    authority.on_mode("OFFBOARD", 9.0)  # the end of the silence: still ours
    assert authority.permits_setpoint(9.1)


def test_the_end_that_we_asked_for_permits_commands_and_no_setpoint() -> None:
    authority = shown("POSCTL", "OFFBOARD")
    authority.request("AUTO.LAND")
    authority.on_mode("AUTO.LAND", 1.0)
    assert authority.standing is Standing.HANDED
    assert not authority.permits_setpoint(1.0)
    assert authority.permits_command(1.0)
    assert not authority.permits_command(3.6)


def test_from_landing_back_to_the_hold_that_we_asked_for_before_is_the_pilots_choice() -> None:
    authority = shown("POSCTL", "OFFBOARD")
    for at_s, mode in ((1.0, "AUTO.LOITER"), (3.0, "AUTO.LAND")):
        authority.request(mode)
        authority.on_mode(mode, at_s)
        assert authority.standing is Standing.HANDED
    authority.on_mode("AUTO.LOITER", 4.0)
    assert authority.standing is Standing.LOST
    assert authority.lost_reason == "the vehicle left AUTO.LAND for AUTO.LOITER"
    assert authority.lost_s == -math.inf  # HEARTBEAT has shown it


def test_a_failsafe_may_interrupt_the_landing_and_nothing_is_sent_meanwhile() -> None:
    authority = shown("POSCTL", "OFFBOARD")
    authority.request("AUTO.LAND")
    authority.on_mode("AUTO.LAND", 1.0)
    authority.on_mode("AUTO.RTL", 2.0, failsafe=True)
    assert authority.standing is Standing.HANDED
    assert not authority.permits_command(2.0)
    authority.on_mode("AUTO.LAND", 3.0, failsafe=True)
    assert authority.permits_command(3.0)
    authority.on_mode("AUTO.RTL", 4.0)
    assert authority.standing is Standing.LOST


def test_a_failsafe_takes_a_vehicle_that_follows_us() -> None:
    authority = shown("POSCTL", "OFFBOARD")
    authority.on_mode("AUTO.RTL", 1.0, failsafe=True)
    assert authority.standing is Standing.LOST


@pytest.mark.parametrize(
    ("arrived_s", "counts"), [(49.3, False), (49.39, False), (49.41, True), (50.0, True)]
)
def test_after_a_pause_a_report_that_arrived_long_before_its_end_proves_nothing(
    arrived_s: float, counts: bool
) -> None:
    """The pause ended at 50.0 s of host time; the report was read after it, at 7.0 s."""
    authority = shown("POSCTL", "OFFBOARD")
    authority.doubt(50.0, 0.9)
    assert not authority.permits_setpoint(0.1)
    authority.on_mode("OFFBOARD", 7.0, arrived_s=arrived_s)
    assert authority.permits_setpoint(7.0) is counts


@pytest.mark.parametrize(("ended_s", "counts"), [(40.69, True), (40.71, False)])
def test_a_report_that_was_read_just_before_a_pause_counts(ended_s: float, counts: bool) -> None:
    """Before a short pause: the newest report arrived at 40.1 s."""
    authority = shown("POSCTL", "OFFBOARD")
    authority.doubt(ended_s, 0.9)
    assert authority.permits_setpoint(0.1) is counts
    assert authority.heard(0.1)


def test_a_report_from_before_the_pause_still_shows_a_take_over() -> None:
    authority = shown("POSCTL", "OFFBOARD")
    authority.doubt(50.0, 0.9)
    authority.on_mode("POSCTL", 7.0, arrived_s=47.0)
    assert authority.standing is Standing.LOST


def test_a_failsafe_that_was_shown_within_a_pause_permits_nothing() -> None:
    """A pilot may have taken it since, in the same mode."""
    authority = shown("POSCTL", "OFFBOARD")
    authority.loss = SetpointLoss(1.0, ("POSCTL",))
    authority.doubt(50.0, 1.3)
    for heartbeat, arrived_s in ((True, 49.8), (False, 50.3)):
        authority.on_mode(
            "POSCTL", 7.0, arrived_s=arrived_s, failsafe=True, heartbeat=heartbeat, starved=True
        )
    assert authority.standing is Standing.FAILSAFE
    assert not authority.permits_command(7.0)
    authority.on_mode("POSCTL", 7.5, arrived_s=50.8, failsafe=True, starved=True)
    assert authority.permits_command(7.5)


def test_the_first_loss_is_the_one_that_is_told() -> None:
    authority = shown("POSCTL", "OFFBOARD", "POSCTL")
    authority.lose("the supervisor has it", 9.0)
    assert authority.lost_reason == "the vehicle left OFFBOARD for POSCTL"
    assert authority.lost_s == -math.inf
    assert math.isinf(shown("POSCTL").lost_s)
