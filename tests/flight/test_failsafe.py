"""The failsafe: how long a condition must hold, how this time decreases, and which row counts.

Steps are 1/8 s, which add up without rounding. Row "link" asks for hold after 0.5 s, "tilt error"
for a landing after 0.5 s, "battery" after 2 s, "authority" at once.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from types import SimpleNamespace
from typing import Any

import numpy as np
from uneventful import NOW_S, hear, uneventful

from offboard.flight.failsafe import ROWS, judge
from offboard.flight.phases import Action, Limits, Phase
from offboard.flight.state import FlightState
from offboard.flight.timing import REPLIES_MIN
from offboard.mavlink.events import (
    ESTIMATE,
    EstimatorReport,
    GpsFix,
    LocalPosition,
    OtherSender,
    SystemHealth,
    ThrustReport,
    TimesyncReply,
)
from offboard.model.command import Command

STEP_S = 0.125
BY_NAME = {row.name: row for row in ROWS}


def actions(*moments: Sequence[str]) -> list[Action]:
    """Return the action at each moment. A moment is given by the names of the rows whose condition
    holds."""
    holding: set[str] = set()
    driven = [replace(row, condition=lambda _, name=row.name: name in holding) for row in ROWS]
    flight, seen = uneventful(), []
    for number, names in enumerate(moments):
        holding.clear()
        holding.update(names)
        flight.vehicle.now_s = NOW_S + STEP_S * number
        judge(flight, driven)
        seen.append(flight.failsafe.action)
    return seen


NOTHING, LINK, TILT, BATTERY = (), ("link",), ("tilt error",), ("battery",)
FLY, HOLD, LAND = Action.FLY, Action.HOLD, Action.LAND


def test_failsafe_rows_act_after_their_hold_time_and_decay_slowly() -> None:
    assert set(actions(*[NOTHING] * 100)) == {FLY}
    assert actions(*[LINK] * 6) == [FLY] * 4 + [HOLD] * 2
    assert actions(NOTHING, *[BATTERY] * 17)[-3:] == [FLY, LAND, LAND]
    assert actions(*[LINK] * 5, NOTHING)[-2:] == [HOLD, FLY]
    # the time counted decreases at a quarter of the speed: four steps with the condition, a pause,
    # and then `again` steps until the row acts
    for pause, again in ((1, 1), (4, 1), (8, 2), (16, 4), (100, 4)):
        seen = actions(NOTHING, *[LINK] * 4, *[NOTHING] * pause, *[LINK] * 8)
        assert seen[5 + pause :].index(HOLD) + 1 == again
    # a condition that holds in every other step gains 3/32 s in two steps; in every fifth, nothing
    assert actions(NOTHING, *[LINK, NOTHING] * 40).index(HOLD) == 9
    assert HOLD not in actions(NOTHING, *[LINK, *[NOTHING] * 4] * 100)


def test_worst_active_failsafe_row_decides() -> None:
    both = (*LINK, *TILT)
    assert actions(NOTHING, *[both] * 4)[-1] is LAND
    assert actions(NOTHING, *[both] * 4, *[LINK] * 2)[-1] is HOLD
    assert actions(NOTHING, *[TILT] * 2, *[LINK] * 3)[-1] is FLY


def test_missing_mode_report_is_named_first() -> None:
    """Without a report of the mode no other row has an effect."""
    flight = uneventful()
    assert flight.authority is not None
    flight.authority.report_s = -np.inf
    flight.telemetry_host_s, flight.missed_decisions = -10.0, 10
    judge(flight)
    assert (flight.failsafe.action, flight.failsafe.row) == (LAND, "authority")
    assert flight.failsafe.reason.startswith("no report of the mode")


def test_clock_steps_and_telemetry_gaps_add_no_hold_time() -> None:
    for last, action in ((50.125, HOLD), (50.0625, FLY)):
        flight = uneventful()
        for flight.vehicle.now_s in (100.0, 100.1875, 100.375, 50.0, last):
            judge(flight, [replace(BY_NAME["link"], condition=lambda _: True)])
        assert flight.failsafe.action is action
    flight = uneventful()
    for flight.vehicle.now_s, holds in ((100.0, False), (100.8, True)):
        judge(flight, [replace(BY_NAME["tilt error"], condition=lambda _, now=holds: now)])
    assert flight.failsafe.action is FLY


# --- each row at its limit ------------------------------------------------------------------------

Measure = Callable[[Any, Any], object]


def rare(flight: Any, position_hz: float) -> None:
    flight.session.telemetry.rates_hz["LOCAL_POSITION_NED"] = position_hz


def hears_another(flight: FlightState, since_s: float) -> None:
    flight.vehicle.update(OtherSender(1, 190), NOW_S - since_s)
    flight.vehicle.now_s = NOW_S


def holding(**values: Callable[[Any], Any]) -> Measure:
    """Return a function that sets attributes of the flight, each computed from the value."""

    def measure(flight: FlightState, value: Any) -> None:
        for name, make in values.items():
            setattr(flight, name, make(value))

    return measure


def clock(**shown: Callable[[Any], Any]) -> Measure:
    calm = {
        "age_s": lambda *_: 0.0, "delay_growth_s": 0.0, "jumped_s": 0.0, "delay": None,
        "unanswered_s": lambda *_: 0.0,
    }  # fmt: skip

    def measure(flight: Any, value: Any) -> None:
        now = {name: make(value) for name, make in shown.items()}
        flight.clock = SimpleNamespace(**calm | now)

    return measure


def at(flight: FlightState, north_m: float, down_m: float, down_mps: float = 0.0) -> None:
    place, velocity = (north_m, 0.0, down_m), (0.0, 0.0, down_mps)
    flight.vehicle.position = LocalPosition(NOW_S, place, velocity)


def near_reference(flight: Any, away_m: float) -> None:
    north, east, down = flight.plan.sample(NOW_S).position_ned_m.tolist()
    flight.vehicle.position = LocalPosition(NOW_S, (north + away_m, east, down), (0.0, 0.0, 0.0))


def tilt(flight: Any, angle_rad: float) -> None:
    rolled = (np.cos(angle_rad / 2), np.sin(angle_rad / 2), 0.0, 0.0)
    flight.vehicle.attitude = replace(flight.vehicle.attitude, attitude=rolled)


def tilt_from_commands(flight: FlightState, angle_rad: float) -> None:
    flight.commands.extend([Command(9.8, (0.0, 0.0, 1.0), 0.0)] * 7)
    tilt(flight, angle_rad)


def blind(flight: Any, age_s: float) -> None:
    flight.vehicle.attitude = replace(flight.vehicle.attitude, time_s=NOW_S - age_s)


def predicted(flight: Any, away_m: float) -> None:
    place = np.array([0.0, 0.0, away_m])
    flight.predictions.append(
        SimpleNamespace(time_s=NOW_S, position_ned_m=place, velocity_ned_mps=np.zeros(3))
    )


def valid(flight: FlightState, estimates: frozenset[str]) -> None:
    for each in (frozenset(ESTIMATE), estimates):
        hear(flight, EstimatorReport(each, (), 0.5))
        if not flight.positioning.report:
            flight.positioning.begin(flight.vehicle, {}, "ESTIMATOR_STATUS")


def accuracy(flight: FlightState, accuracies_m: tuple[float | None, float | None]) -> None:
    """Report two accuracies: one at the beginning of the flight, and one now. PX4 reports NaN if it
    has none; an accuracy that was never reported is not missed."""
    reported = EstimatorReport(frozenset(ESTIMATE), (), 0.5)
    hear(flight, replace(reported, accuracy_m=accuracies_m[0]))
    flight.positioning.begin(flight.vehicle, {}, "ESTIMATOR_STATUS")
    hear(flight, replace(reported, accuracy_m=accuracies_m[1]))


def repeats(flight: FlightState, for_s: float, last: Any = (("velocity", 0.5),)) -> None:
    """The innovation ratios of motion capture change, and then stay the same or, with a `last`
    report without ratios, end."""
    ratios: list[Any] = [(("velocity", each),) for each in (0.1, 0.2, 0.3, 0.4, 0.5)]
    reports = [EstimatorReport(frozenset(ESTIMATE), each) for each in (*ratios, last)]
    for number, (report, ago_s) in enumerate(
        zip(reports, (2.1, 2.0, 1.9, 1.8, for_s, 0.0), strict=True)
    ):
        flight.vehicle.update(report, NOW_S - ago_s)
        if number == 1:
            flight.positioning.begin(flight.vehicle, {}, "EKF_STATUS_REPORT")


def no_fix(flight: FlightState, for_s: float) -> None:
    hear(flight, GpsFix())
    flight.positioning.begin(flight.vehicle, {"GPS_RAW_INT": 5.0}, "")
    flight.vehicle.heard_s[GpsFix] = NOW_S - for_s


def rejected(name: str) -> Any:
    """A heading that is rejected, too, does not count."""

    def measure(flight: FlightState, ratio: float) -> None:
        hear(flight, EstimatorReport(frozenset(ESTIMATE), (("heading", 2.0), (name, ratio))))
        flight.positioning.begin(flight.vehicle, {}, "ESTIMATOR_STATUS")

    return measure


def sinks(flight: FlightState, sink_mps: float) -> None:
    at(flight, 0.0, -1.0, sink_mps)
    flight.thrusts.append(1.0)


def stands(flight: FlightState, height_m: float) -> None:
    """Let the vehicle stand at this height for 1.2 s; the reference is 3 m high."""
    for step in range(1, 13):
        reported = LocalPosition(NOW_S + 0.1 * step, (0.0, 0.0, -height_m), (0.0, 0.0, 0.0))
        flight.vehicle.position = reported
        flight.contact.on_position(reported.time_s, reported.position_ned_m, 0.0)


def follows(flight: Any, mode: str) -> None:
    hear(flight, ThrustReport(0.3))
    flight.authority.mode, flight.follows_others = mode, True


def jumps(recent_m: float, drift_m: float) -> SimpleNamespace:
    return SimpleNamespace(recent_m=lambda time_s: recent_m, drift_m=drift_m)


AGE_S = Limits().setpoint_age_s
aged = clock(age_s=lambda age_s: lambda *_: age_s)
at_start = holding(
    observer=lambda share: SimpleNamespace(hover_thrust_estimate=share),
    start_hover_thrust=lambda _: 0.4,
)
hovers = holding(observer=lambda share: SimpleNamespace(hover_thrust_estimate=share))


def unanswered(flight: FlightState, requests: int, delay_s: float = 0.01) -> None:
    """Send `requests` TIMESYNC requests, one per tick, after an answered one. The reply to the
    newest of them is overdue."""
    sent_s = flight.host_s - 2.0 * delay_s - 0.1 * requests
    for number in range(REPLIES_MIN):
        request = flight.clock.request(float(number), sent_s)
        vehicle_ns = request.ts1_ns + round(1e9 * delay_s)
        flight.clock.on_reply(TimesyncReply(request.ts1_ns, vehicle_ns))
    # further requests were sent so recently that their replies are not due yet
    for number in range(1, requests + 1 + round(20.0 * delay_s)):
        flight.clock.request(100.0 + number, sent_s + 0.1 * number - 1e-3)


# name of a row, function that sets its measured value, an allowed value, a value beyond the limit
MEASURED: list[tuple[str, Measure, Any, Any]] = [
    ("authority", lambda flight, age_s: setattr(flight.authority, "report_s", NOW_S - age_s),
     2.5, 2.6),
    ("silence", holding(telemetry_host_s=float), -1.0, -1.1),
    ("blind", blind, 0.5, 0.51),
    ("age", aged, AGE_S, 0.26),
    ("rate", rare, 3.5, 3.0),
    ("link", clock(delay_growth_s=float), 0.3, 0.31),
    ("late", aged, AGE_S, 0.26),
    ("uplink", unanswered, 10, 11),
    ("uplink", partial(unanswered, delay_s=0.6), 10, 11),
    ("decision", holding(missed_decisions=int, failure=lambda _: "it was late"), 0, 1),
    ("decisions", holding(missed_decisions=int, failure=lambda _: "late"), 2, 3),
    ("tilt", tilt, 1.29, 1.31),
    ("tilt error", tilt_from_commands, 0.49, 0.51),
    ("position error", near_reference, 4.99, 5.01),
    ("prediction", predicted, 2.0, 2.01),
    ("estimator", holding(jumps=lambda jumped_m: jumps(jumped_m, 0.0)), 2.0, 2.1),
    ("estimator", holding(jumps=lambda drift_m: jumps(0.0, drift_m)), 2.0, 2.1),
    ("accuracy", accuracy, (0.5, 3.0), (0.5, 3.1)),
    ("validity", accuracy, (None, None), (0.5, None)),
    ("validity", valid, frozenset(ESTIMATE), frozenset(ESTIMATE[:1])),
    ("positioning", no_fix, 1.0, 2.1),
    ("positioning", repeats, 1.5, 1.6),
    ("positioning", partial(repeats, last=()), 1.5, 1.6),
    ("innovations", rejected("horizontal position"), 1.0, 1.1),
    ("innovations", rejected("height"), 1.0, 1.1),
    ("volume", lambda flight, height_m: at(flight, 0.0, -height_m), 120.0, 120.1),
    ("volume", lambda flight, away_m: at(flight, away_m, -1.0), 1000.0, 1000.1),
    ("battery", lambda flight, left: hear(flight, SystemHealth(True, left)), 0.1, 0.09),
    ("thrust reserve", hovers, 0.9, 0.91),
    ("full thrust", sinks, 0.3, 0.31),
    ("ground", stands, 0.31, 0.29),
    ("low thrust", at_start, 0.21, 0.19),
    ("second sender", hears_another, 5.0, 4.9),
    ("other setpoints", follows, "POSCTL", "OFFBOARD"),
    ("clock", clock(jumped_s=float), 0.0, 0.6),
    ("contradiction", holding(identification=lambda why: SimpleNamespace(contradiction=why)),
     "", "out of bounds"),
]  # fmt: skip


def test_every_failsafe_row_acts_beyond_its_limit() -> None:
    assert {each[0] for each in MEASURED} == set(BY_NAME)
    for name, measure, *values in MEASURED:
        for value, exceeds in zip(values, (False, True), strict=True):
            flight = uneventful()
            measure(flight, value)
            assert bool(BY_NAME[name].condition(flight)) is exceeds, name
            judge(flight, [replace(BY_NAME[name], held_s=0.0)])
            assert "{" not in flight.failsafe.reason + flight.failsafe.cause
            assert name != "decision" or flight.failsafe.reason == exceeds * "it was late"


def test_a_gps_fix_that_the_estimator_does_not_use_may_be_lost() -> None:
    """A vehicle that flies by external vision, near a window."""
    for by_gps in (True, False):
        flight = uneventful()
        hear(flight, EstimatorReport(frozenset(ESTIMATE), (), 0.5, by_gps=by_gps))
        no_fix(flight, 2.1)
        assert bool(BY_NAME["positioning"].condition(flight)) is by_gps


def test_rejected_measurements_count_only_if_repeated_and_without_gps() -> None:
    """Reports at 1 Hz for 3 s; autopilots fly through a glitch of GPS."""
    report = EstimatorReport(frozenset(ESTIMATE), (("velocity", 1.2),))
    for reports, fix, action in ((1, False, Action.FLY), (3, False, Action.LAND),
                                 (3, True, Action.FLY)):  # fmt: skip
        flight, worst = uneventful(), Action.FLY
        if fix:
            hear(flight, GpsFix())
        for step in range(60):
            flight.vehicle.now_s = NOW_S + 0.05 * step
            if step % 20 == 0 and step < 20 * reports:
                flight.vehicle.update(report, flight.vehicle.now_s)
            if step == 0:
                flight.positioning.begin(flight.vehicle, {}, "ESTIMATOR_STATUS")
            judge(flight, [BY_NAME["innovations"]])
            worst = max(worst, flight.failsafe.action)
        assert worst is action


def test_begin_with_other_sender_allows_another_program() -> None:
    for name in ("second sender", "other setpoints"):
        flight = uneventful()
        hear(flight, OtherSender(1, 190))
        follows(flight, "OFFBOARD")
        assert BY_NAME[name].condition(flight)
        flight.limits = Limits(begin_with_other_sender=True)
        assert not BY_NAME[name].condition(flight)


def test_setpoint_based_rows_are_inactive_in_hold() -> None:
    for name in ("thrust reserve", "full thrust", "other setpoints"):
        flight = uneventful(Phase.HOLD)
        sinks(flight, 5.0)
        follows(flight, "OFFBOARD")
        hovers(flight, 1.0)
        assert not BY_NAME[name].condition(flight)
        flight.phase = Phase.TRACK
        assert BY_NAME[name].condition(flight)
