"""The vehicle's clock: its rate, the age of telemetry, jumps, and the delay of the link."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from typing import Any

import pytest

from offboard.flight.timing import (
    DELAY_MAX_S,
    LinkGrowth,
    VehicleClock,
)
from offboard.identification.uncertainty import Estimate
from offboard.mavlink.events import TimesyncReply

EPOCH_S = 7000.0  # host time when vehicle time is 0
WAY_S = 0.05  # delay of one direction


def every(step_s: float, begin_s: float, end_s: float) -> Iterable[float]:
    return (begin_s + step_s * n for n in range(round((end_s - begin_s) / step_s)))


def same(at_s: float) -> float:
    return at_s


def way(at_s: float) -> float:
    return WAY_S


def fly(
    clock: VehicleClock,
    times_s: Iterable[float],
    *,
    stamp: Callable[[float], float] = same,
    down: Callable[[float], float] = way,
    answers: bool = False,
) -> tuple[float, tuple[float, float]]:
    """Give `clock` telemetry of these true times with the delay `down`. If the vehicle `answers`,
    a TIMESYNC request, on its way for WAY_S, and its reply, for `down`, follow every fifth message.
    Return the greatest age on arrival, in s of vehicle time, and the newest (stamp, arrival)."""
    arriving: list[Any] = []
    for number, at_s in enumerate(times_s):
        newest = stamp(at_s), EPOCH_S + at_s + down(at_s)
        arriving.append((newest[1], newest[0]))
        if answers and number % 5 == 0:
            there_s = at_s + down(at_s) + WAY_S
            arriving.append((newest[1], newest[0], "asked"))
            arriving.append((EPOCH_S + there_s + down(there_s), newest[0], stamp(there_s)))
    oldest_s = 0.0
    for arrived_s, stamp_s, *reply in sorted(arriving, key=lambda each: each[:2]):
        if reply == ["asked"]:
            clock.request(stamp_s, arrived_s)
        elif reply:
            answer(clock, stamp_s, reply[0] - stamp_s)
        else:
            clock.on_telemetry(stamp_s, arrived_s)
            oldest_s = max(oldest_s, clock.age_s(stamp_s, arrived_s))
    return oldest_s, newest


def answer(clock: VehicleClock, stamp_s: float, delay_s: float) -> bool:
    """Give `clock` the reply to a request that reached the vehicle `delay_s` after its stamp."""
    request_ns = round(stamp_s * 1e9)
    return clock.on_reply(TimesyncReply(request_ns, request_ns + round(delay_s * 1e9)))


def settled(until_s: float = 10.0, **more: Any) -> VehicleClock:
    clock = VehicleClock()
    fly(clock, every(0.02, 0.0, until_s), **more)
    clock.settle()
    return clock


@pytest.mark.parametrize("rate", [0.25, 0.9, 20.0])
@pytest.mark.parametrize(("until_s", "answers"), [(0.8, False), (10.0, True)])
def test_clock_rate_is_not_taken_for_link_delay(rate: float, until_s: float, answers: bool) -> None:
    """A simulation may be slower than real time, on a busy computer, or faster. The vehicle may
    also be engaged before the rate is measured. Before any telemetry nothing is old."""
    assert VehicleClock().now_s(EPOCH_S) == -math.inf
    assert VehicleClock().age_s(3.0, EPOCH_S) == 0.0
    link: Any = {"stamp": lambda at_s: rate * at_s, "answers": answers}
    clock = settled(until_s, **link)
    fly(clock, every(0.02, until_s, 12.0), **link)
    oldest_s, newest = fly(clock, every(0.02, 12.0, 30.0), **link)
    assert oldest_s < 0.002 * rate
    assert clock.age_s(newest[0], newest[1] + 0.2) == pytest.approx(0.2 * rate, abs=0.002 * rate)
    assert clock.now_s(EPOCH_S + 30.5) == pytest.approx(rate * (30.5 - WAY_S), abs=0.01 * rate)
    assert clock.jumped_s == 0.0


BOOTS: tuple[tuple[Callable[[float], float], float], ...] = (  # stamps, and when it is engaged
    (lambda at_s: at_s + 30.0 * (at_s > 0.5), 9.0),  # set before its rate is known
    (lambda at_s: at_s + 30.0 * (at_s > 3.0), 4.0),  # set later
    (lambda at_s: min(at_s, 1.0) + max(at_s - 3.0, 0.0), 9.0),  # stands still
    (lambda at_s: 5.0 * min(at_s, 3.0) + max(at_s - 3.0, 0.0), 9.0),  # fast
    (lambda at_s: 0.3 * at_s if at_s < 3.0 else at_s + 30.0, 3.5),  # slow, then set
)


@pytest.mark.parametrize("answers", [True, False])
def test_clock_changes_at_boot_do_not_count_in_flight(answers: bool) -> None:
    """When the flight begins, the clock has its present rate; jumps before that do not count."""
    for stamp, engaged_s in BOOTS:
        clock = settled(engaged_s, stamp=stamp, answers=answers)
        now_s = clock.now_s(EPOCH_S + engaged_s + WAY_S + 1.0)
        assert now_s == pytest.approx(stamp(engaged_s + 1.0), abs=1e-6)
        times_s = every(0.02, engaged_s, engaged_s + 10.0)
        assert fly(clock, times_s, stamp=stamp, answers=answers)[0] < 1e-6
        assert clock.jumped_s == 0.0


@pytest.mark.parametrize(("added_s", "ramp_s", "answers"), [(0.3, 0.02, True), (0.4, 4.0, False)])
def test_age_of_delayed_telemetry_is_measured(added_s: float, ramp_s: float, answers: bool) -> None:
    """The clock goes on although replies become later, too; the age is right within a tenth."""

    def down(at_s: float) -> float:
        return WAY_S + added_s * min((at_s - 12.0) / ramp_s, 1.0)

    clock = settled(12.0, answers=answers)
    oldest_s, _ = fly(clock, every(0.02, 12.0, 12.1 + ramp_s), answers=answers, down=down)
    assert oldest_s == pytest.approx(added_s, rel=0.1)


@pytest.mark.parametrize(("jump_s", "shown_s"), [(0.6, 0.6), (0.4, 0.0), (-1.0, 0.0)])
def test_forward_clock_jump_is_measured(jump_s: float, shown_s: float) -> None:
    """Replies that arrived before the jump do not count."""
    clock = VehicleClock()
    fly(clock, every(0.02, 0.0, 10.0))
    clock.request(9.94, EPOCH_S + 9.99)
    answer(clock, 9.94, 0.1)
    clock.settle()
    _, newest = fly(clock, every(0.02, 10.0, 10.2), stamp=lambda at_s: at_s + jump_s)
    assert clock.jumped_s == pytest.approx(shown_s, abs=0.021)
    if shown_s > 0.0:
        assert clock.age_s(newest[0], newest[1] + 0.2) == pytest.approx(0.2, abs=1e-6)


def test_slower_clock_is_not_taken_for_link_delay() -> None:
    """The computer's load changes in flight. What remains is the change between two replies."""

    def stamp(at_s: float) -> float:
        return min(at_s, 20.0) + 0.93 * max(at_s - 20.0, 0.0)

    clock = settled(stamp=stamp, answers=True)
    assert fly(clock, every(0.02, 10.0, 40.0), stamp=stamp, answers=True)[0] < 0.02
    assert clock.jumped_s == 0.0


# --- the delay of both directions ---


def reply(link: VehicleClock, telemetry_s: float, delay_s: float) -> TimesyncReply:
    request_ns = link.request(telemetry_s, 0.0).ts1_ns
    return TimesyncReply(request_ns, request_ns + round(delay_s * 1e9))


def test_foreign_late_and_duplicate_replies_are_ignored() -> None:
    link = VehicleClock()
    for number in range(5):
        at_s = float(number)
        own = reply(link, at_s, 0.05)
        link.on_reply(TimesyncReply(own.request_ns + 1, own.vehicle_ns))  # another sender's request
        link.on_reply(reply(link, at_s + 0.2, -0.01))  # a negative delay: of another clock
        link.on_reply(reply(link, at_s + 0.4, DELAY_MAX_S + 0.01))
        assert link.delay is None
        link.on_reply(own)
        link.on_reply(TimesyncReply(own.request_ns, own.vehicle_ns + 10**9))  # a duplicate
    assert link.delay == Estimate(pytest.approx(0.05), 0.0)


def test_all_unanswered_requests_of_60_s_are_counted() -> None:
    """The requests have the shortest period. Only 100 once counted, so that with a `silence_s` of
    10 s a lost uplink was not noticed."""
    link = VehicleClock()
    for number in range(5):
        link.on_reply(reply(link, float(number), 0.05))
    for at_s in every(0.01, 0.01, 60.005):
        link.request(10.0 + at_s, at_s)
    assert link.overdue(60.2) == 6000


@pytest.mark.parametrize(("lost", "late", "loses"), [(2, 0, False), (3, 0, True), (2, 5, False)])
def test_link_is_lossy_above_5_percent_missing_replies(lost: int, late: int, loses: bool) -> None:
    """Without replies to the newest requests the link may have become later: that is no loss."""
    link = VehicleClock()
    for number in range(5):
        link.on_reply(reply(link, float(number), 0.05))
    for number in range(51):
        at_s = 10.0 + 0.1 * number
        request_ns = link.request(at_s, at_s).ts1_ns
        if number <= 50 - late and (number % 10 or not 0 < number <= 10 * lost):
            link.on_reply(TimesyncReply(request_ns, request_ns + 50_000_000))
    assert link.loses(15.2) is loses


@pytest.mark.parametrize(("delay_s", "measured_s"), [(0.05, 2.0), (4.4, 6.3), (math.inf, 10.1)])
def test_link_delay_is_measured_by_twenty_replies(delay_s: float, measured_s: float) -> None:
    """Behind a full buffer of 50 kB, at 11.5 kB/s, the first reply takes 4.4 s. After 10 s without
    any, the vehicle is taken not to answer."""
    link = VehicleClock()
    waiting: list[tuple[float, TimesyncReply]] = []
    for tick in range(120):
        now_s = 0.1 * tick
        for each in [each for each in waiting if each[0] <= now_s]:
            waiting.remove(each)
            link.on_reply(each[1])
        if link.delay_is_measured(now_s):
            break
        waiting.append((now_s + delay_s, reply(link, now_s, min(delay_s, DELAY_MAX_S))))
    assert now_s == pytest.approx(measured_s, abs=0.15)


def test_delay_growth_is_the_median_of_five_replies() -> None:
    link, times_s = VehicleClock(), iter(0.1 * n for n in range(1, 1000))

    def replies(delay_s: float, count: int) -> None:
        for _ in range(count):
            link.on_reply(reply(link, next(times_s), delay_s))

    replies(0.05, 4)
    link.settle()
    replies(0.95, 40)
    assert link.delay_growth_s == 0.0  # nothing to compare with
    link.settle()
    replies(1.25, 2)
    assert link.delay_growth_s == pytest.approx(0.0)  # two late ones may be chance
    replies(1.25, 1)
    assert link.delay_growth_s == pytest.approx(0.30)
    replies(0.91, 5)
    assert link.delay_growth_s == pytest.approx(-0.04)


def test_alternating_delay_counts_as_unsteady() -> None:
    growth = LinkGrowth()
    for tick in range(200):
        growth.step(0.1 * tick, 0.15 if tick // 10 % 2 else 0.05)
        assert tick < 10 or growth.changed_s >= 0.0999
