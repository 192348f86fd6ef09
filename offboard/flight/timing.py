"""Times: the vehicle's clock, the age of telemetry and the link delay; and whether this computer
keeps up with the control ticks.

The vehicle's clock is modelled as a line over host time, with an offset and a rate. It has two
bounds (README.md): telemetry arrives after the time of its stamp, and a TIMESYNC request arrives
after it was sent. The request holds the stamp of the newest telemetry and is sent with a setpoint;
the reply holds this stamp and the vehicle time at which the request arrived. Their difference is
the link delay: that of telemetry and setpoint together. It depends neither on the clock of this
computer nor on the delay of the reply.
"""

from __future__ import annotations

import math
import statistics
from collections import deque

from offboard.identification.uncertainty import Estimate
from offboard.mavlink.events import TimesyncReply
from offboard.mavlink.outgoing import Timesync

REPLIES_MIN, REPLIES_MAX, REPLIES_NEWEST = 5, 40, 5  # for `delay`: least, most; for its growth
REPLIES_MEASURED = 20  # 2 s of replies: enough to notice a link that saturates
DELAY_MAX_S = 10.0  # a larger difference is not a delay: the reply is from another clock
REQUESTS_MAX = 6100  # those of the longest `Limits.silence_s` at the shortest control period
NORMAL = 1.4826  # standard deviation of a normal distribution / median absolute deviation
WINDOW_S, BIN_S = 5.0, 0.1  # see `Edge`
RATE_OVER_S, RATE_EVERY_S = 1.0, 1.0  # the rate: least time to measure it over, and interval
REAL_TIME = 0.05  # a vehicle whose rate differs from 1 by less runs in real time
LOSS_OVER, LOSSY = 50, 0.05  # a link loses if more than this share of requests has no reply
BOUNDS_S = 1.0  # replies to older requests do not bound the vehicle time
LEAST_GROWTH_S, STEADY_S = 0.01, 5.0  # see `LinkGrowth`
JUMP_S = 0.5  # a stamp that is further ahead of the vehicle time shows a jump of the clock


class VehicleClock:
    """The vehicle's clock and the link delay; see the module. Stamps are vehicle time, and
    `host_s` and `arrived_s` are host time.

    `jumped_s` is by how much the clock has jumped forward since `settle`; `growth` is the growth of
    the link delay since then. `answered_s` is the host time at which the newest request that has
    a reply was sent.
    """

    def __init__(self) -> None:
        self.growth = LinkGrowth()
        self._requests: deque[tuple[int, float]] = deque(maxlen=REQUESTS_MAX)  # ts1, host time
        self._reset_line()
        self.measure_delay_again()

    def _reset_line(self) -> None:
        self._telemetry, self._replies = Edge(1.0), Edge(-1.0)
        self._least_s = math.inf  # least delay of both directions together
        self._settled = False
        self._measured_s = -math.inf  # host time of the newest measurement of the rate
        self._rate = 1.0
        self.jumped_s = 0.0

    def measure_delay_again(self) -> None:
        """Forget the measured delay, because the load on the link changes now."""
        self._requests.clear()
        self._asked_s: deque[float] = deque(maxlen=LOSS_OVER + 1)  # host times of the newest ones
        self._delays_s: deque[float] = deque(maxlen=REPLIES_MAX)
        self.began_s = math.inf  # host time of the first request
        self.answered_s = -math.inf
        self._settled_delay_s = math.nan

    def settle(self) -> None:
        """Begin the flight. The control law takes the present delay into account, so its growth
        counts from now on. Jumps of the clock count from now on too, once the rate was measured. A
        rate of 1 now stays 1 as long as there are no replies."""
        delay = self.delay
        self._settled_delay_s = delay.value if delay else math.nan
        self._settled = True
        self.jumped_s = 0.0

    # --- what arrives ---

    def on_telemetry(self, stamp_s: float, arrived_s: float) -> None:
        """Take the stamp `stamp_s` of a message that arrived at host time `arrived_s`."""
        ahead_s = stamp_s - self.now_s(arrived_s)
        if math.isfinite(self._measured_s) and ahead_s > JUMP_S:
            if not self._settled:
                self._reset_line()  # before the flight the rate is measured anew
            self.jumped_s += ahead_s
            self._telemetry.clear()
            self._replies.clear()
        self._telemetry.add(arrived_s, stamp_s, self._rate)
        if arrived_s - self._measured_s >= RATE_EVERY_S:
            self._measure_rate(arrived_s)

    def request(self, stamp_s: float, host_s: float) -> Timesync:
        """Return the request to send with a setpoint at host time `host_s`. `stamp_s` is the stamp
        of the newest telemetry."""
        stamp_ns = round(stamp_s * 1e9)
        self._requests.append((stamp_ns, host_s))
        self._asked_s.append(host_s)
        self.began_s = min(self.began_s, host_s)
        return Timesync(0, stamp_ns)

    def on_reply(self, reply: TimesyncReply) -> bool:
        """Evaluate a reply; returns whether its request was ours."""
        asked = next((each for each in self._requests if each[0] == reply.request_ns), None)
        if asked is None:
            return False
        self._requests.remove(asked)  # a duplicate must not count again
        self.answered_s = max(self.answered_s, asked[1])
        while self._requests and self._requests[0][1] < self.answered_s - DELAY_MAX_S:
            self._requests.popleft()  # this request or its reply was lost
        delay_s = (reply.vehicle_ns - reply.request_ns) * 1e-9
        if 0.0 <= delay_s <= DELAY_MAX_S:
            self._delays_s.append(delay_s)
            self._least_s = min(self._least_s, delay_s)
            self._replies.add(asked[1], reply.vehicle_ns * 1e-9, self._rate)
        return True

    def _measure_rate(self, host_s: float) -> None:
        down, up = self.telemetry_rate, self._replies.rate
        if down is None:
            return
        first, self._measured_s = math.isinf(self._measured_s), host_s
        if up is not None:
            self._rate = max(min(max(self._rate, min(down, up)), max(down, up)), 0.0)
        elif first or not self._settled or self._rate != 1.0:
            self._rate = 1.0 if abs(down - 1.0) < REAL_TIME else max(down, 0.0)

    # --- time and age ---

    def now_s(self, host_s: float) -> float:
        """Stamp of telemetry that would arrive at host time `host_s` with the least delay; -inf
        before the first telemetry."""
        shown_s = self._telemetry.at(host_s, self._rate)
        bound_s = self._replies.at(host_s, self._rate, BOUNDS_S)
        if shown_s is None:
            return -math.inf
        return shown_s if bound_s is None else min(shown_s, bound_s - self._least_s)

    def age_s(self, stamp_s: float, host_s: float) -> float:
        """Age at `host_s` of telemetry with this stamp, beyond the least delay of the last 5 s."""
        return max(self.now_s(host_s) - stamp_s, 0.0)

    @property
    def telemetry_rate(self) -> float | None:
        """Vehicle time per host time over the last WINDOW_S of stamps; None before RATE_OVER_S."""
        return self._telemetry.rate

    # --- delay of both directions ---

    @property
    def delay(self) -> Estimate | None:
        """Delay of telemetry and setpoint together: median and standard deviation (s) of the newest
        replies. None before five replies."""
        if len(self._delays_s) < REPLIES_MIN:
            return None
        median_s = statistics.median(self._delays_s)
        deviation_s = statistics.median(abs(each - median_s) for each in self._delays_s)
        return Estimate(median_s, NORMAL * deviation_s)

    def delay_is_measured(self, host_s: float) -> bool:
        """Whether `delay` is reliable at host time `host_s`, or the vehicle answers no request."""
        unanswered = not self._delays_s and host_s - self.began_s > DELAY_MAX_S
        return len(self._delays_s) >= REPLIES_MEASURED or unanswered

    def unanswered_s(self, host_s: float) -> float:
        """Time since the newest answered request, or the first one, was sent; 0 before that."""
        return max(host_s - max(self.began_s, self.answered_s), 0.0)

    def overdue(self, host_s: float) -> int:
        """Number of requests sent after the newest answered one whose reply is overdue at host time
        `host_s`. A reply is overdue after twice `delay`. 0 while no delay is known."""
        return self._unanswered(self.answered_s, host_s)

    def loses(self, host_s: float) -> bool:
        """Whether more than the share LOSSY of the newest LOSS_OVER requests are lost at host time
        `host_s`. A request is lost if its reply is overdue and a later request was answered: on a
        link that only became slower, replies arrive in order."""
        if len(self._asked_s) <= LOSS_OVER:
            return False
        lost = self._unanswered(self._asked_s[0], host_s) - self.overdue(host_s)
        return lost > LOSSY * LOSS_OVER

    def _unanswered(self, since_s: float, host_s: float) -> int:
        """Number of requests sent after `since_s` whose reply is overdue at `host_s`."""
        delay = self.delay
        if delay is None:
            return 0
        due_s = host_s - 2.0 * delay.value
        return sum(since_s < sent_s <= due_s for _, sent_s in self._requests)

    @property
    def delay_growth_s(self) -> float:
        """Median delay of the newest replies minus the delay at `settle`; 0 while either is not
        known."""
        newest = list(self._delays_s)[-REPLIES_NEWEST:]
        if math.isnan(self._settled_delay_s) or len(newest) < REPLIES_NEWEST:
            return 0.0
        return statistics.median(newest) - self._settled_delay_s


class LinkGrowth:
    """Growth of the link delay since takeoff, for the prediction and the bandwidth.

    `added_s` is the growth; it follows changes of more than LEAST_GROWTH_S. `changed_s` is the
    range of `added_s` in the last STEADY_S: a delay that changes is not known better than that.
    """

    def __init__(self) -> None:
        self.added_s = self.changed_s = 0.0
        self._history: deque[tuple[float, float]] = deque(((-math.inf, 0.0),))  # time, added_s

    def step(self, time_s: float, growth_s: float) -> bool:
        """Take the growth measured at vehicle time `time_s`. Returns whether anything changed."""
        before = self.added_s, self.changed_s
        if abs(growth_s - self.added_s) > LEAST_GROWTH_S:
            self.added_s = growth_s
            self._history.append((time_s, growth_s))
        while len(self._history) > 1 and self._history[1][0] <= time_s - STEADY_S:
            self._history.popleft()
        values_s = [added_s for _, added_s in self._history]
        self.changed_s = max(values_s) - min(values_s)
        return before != (self.added_s, self.changed_s)


class Edge:
    """Points (host time, vehicle time) of the last WINDOW_S of host time: of each BIN_S the point
    at which vehicle time is most ahead of host time, or with `sign` -1 most behind."""

    def __init__(self, sign: float) -> None:
        self._sign = sign
        self._points: deque[tuple[float, float]] = deque()
        self._bin_s = 0.0  # host time of the first point of the newest bin

    def add(self, host_s: float, vehicle_s: float, rate: float) -> None:
        points = self._points
        if points and host_s - self._bin_s < BIN_S:
            ahead_s = vehicle_s - points[-1][1] - rate * (host_s - points[-1][0])
            if self._sign * ahead_s > 0.0:
                points[-1] = host_s, vehicle_s
        else:
            points.append((host_s, vehicle_s))
            self._bin_s = host_s
        while points[0][0] < host_s - WINDOW_S:
            points.popleft()

    def clear(self) -> None:
        self._points.clear()

    def at(self, host_s: float, rate: float, over_s: float = math.inf) -> float | None:
        """Vehicle time at `host_s`, extrapolated at `rate` from the point of the last `over_s` that
        is most ahead, or most behind; None without points."""
        since_s, sign = host_s - over_s, self._sign
        ahead_s = [sign * (v - rate * h) for h, v in self._points if h >= since_s]
        return rate * host_s + sign * max(ahead_s) if ahead_s else None

    @property
    def rate(self) -> float | None:
        """Slope of the least-squares line; None if the points cover less than RATE_OVER_S."""
        points = self._points
        if not points or points[-1][0] - points[0][0] < RATE_OVER_S:
            return None
        return statistics.linear_regression(*zip(*points, strict=True)).slope


# ---------------------------------------------------------------------- this computer

SHARE = 0.05  # a computer is too busy if it skips more than this share of the ticks
PAUSE_S = 0.3  # or pauses for longer once; after that, earlier reports of the mode are doubted


def too_busy(skipped: float, ticks: float, pause_s: float) -> str:
    """Return a sentence if this computer was too busy to fly; else an empty text.

    `skipped` of `ticks` control ticks fell into pauses of this process; `pause_s` is the longest.
    """
    if not (pause_s > PAUSE_S or skipped > SHARE * ticks):
        return ""
    return (
        f"this computer was too busy: {skipped:.0f} of {ticks:.0f} ticks were skipped, pauses up "
        f"to {pause_s:.2f} s"
    )


class Busyness:
    """Counts skipped ticks and pauses of this process in flight. `period_s` is the control period;
    a shorter gap between two turns skips no tick.

    `newly_skipped` is the number of ticks skipped just before the newest one, and `paused_s` the
    length of the pause before it, 0 without a pause."""

    def __init__(self, period_s: float) -> None:
        self._period_s = period_s
        self._gap_s = 0.0  # longest between two turns, since the previous tick
        self.skipped = self.ticks = self.newly_skipped = 0
        self.pause_s = self.paused_s = 0.0

    def on_turn(self, gap_s: float) -> None:
        """Note that a turn begins `gap_s` of host time after the one before it."""
        self._gap_s = max(self._gap_s, gap_s)

    def on_tick(self, skipped: int, *, flying: bool) -> None:
        """Count a tick, before which `skipped` ticks were skipped."""
        self.newly_skipped = skipped
        self.paused_s, self._gap_s = self._gap_s if self._gap_s > self._period_s else 0.0, 0.0
        if flying:
            self.ticks += 1 + skipped
            self.skipped += skipped if self.paused_s else 0
            self.pause_s = max(self.pause_s, self.paused_s)

    @property
    def sentence(self) -> str:
        return too_busy(self.skipped, self.ticks, self.pause_s)
