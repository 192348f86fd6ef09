"""Age of telemetry, and the delay of the link.

Two measures, on the vehicle's clock:

- `LinkDelay`, by TIMESYNC: a request is stamped with the vehicle time of the newest telemetry and
  sent with a setpoint. The vehicle's reply holds this stamp and the vehicle time at which the
  request arrived. The difference is the age of the telemetry when the setpoint arrived: the delay
  of both directions together. The clock of this computer and the way of the reply do not matter.
- `VehicleClock`, by the arrival of telemetry: the vehicle time now, as far as the least delayed
  telemetry of the last seconds shows. Newest telemetry that is older has been delayed more than
  usual, by a backlog or a stop of this process. The replies to TIMESYNC bound it from above, so
  that a simulator slower than real time is not taken for a late link.

`LinkGrowth` keeps what both show the link to have added since take-off.
"""

from __future__ import annotations

import math
import statistics
from collections import deque

from offboard.identification.uncertainty import Estimate
from offboard.mavlink.events import TimesyncReply
from offboard.mavlink.outgoing import Timesync

REPLIES_MIN, REPLIES_MAX, REPLIES_NEWEST = 5, 40, 5
REPLIES_MEASURED = 20  # two seconds: a link that saturates has shown it
DELAY_MAX_S = 10.0  # a larger difference belongs to another clock
REQUESTS_MAX = 100  # of DELAY_MAX_S
NORMAL = 1.4826  # standard deviation of a normal distribution / median absolute deviation
WINDOW_S, BIN_S = 5.0, 0.1
RATE_OVER_S = 1.0  # the least stretch from which the rate of the clock is taken
REAL_TIME = 0.05  # a rate that differs from 1 by less is that of a vehicle in real time
BOUNDS_S = 1.0  # a reply to an older request bounds the vehicle time no more
LEAST_GROWTH_S, STEADY_S = 0.01, 5.0  # see `LinkGrowth`
JUMP_S = 0.5  # a stamp further ahead of the vehicle time now shows a jump of the clock


class VehicleClock:
    """Vehicle time as a function of host time.

    The rate is 1 for a real vehicle; that of a simulator in faster or slower time is measured until
    `settle`, and from then on followed only if it is not 1: a delay that grows must not look like a
    slower clock. What a reply to TIMESYNC shows does not depend on the delay: when we asked, the
    vehicle's clock was at most at the time in the reply.
    """

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """The vehicle was rebooted."""
        self._seen: deque[tuple[float, float]] = deque()  # stamp, arrival: the freshest of a bin
        self._bounds: deque[tuple[float, float]] = deque(maxlen=REPLIES_MAX)  # vehicle, host time
        self._bin_s = 0.0  # arrival of the first of the newest bin
        self._settled = False
        self._measured = False
        self._rate = 1.0
        self.jumped_s = 0.0

    def settle(self) -> None:
        """From now on the rate of a vehicle in real time is 1, and jumps of its clock count; both
        once the rate was measured."""
        self._settled = True
        self.jumped_s = 0.0

    def on_telemetry(self, stamp_s: float, arrived_s: float) -> None:
        """A message with the stamp `stamp_s` arrived at host time `arrived_s`."""
        ahead_s = stamp_s - self.now_s(arrived_s)
        seen = self._seen
        if self._measured and ahead_s > JUMP_S:
            self.jumped_s += ahead_s
            self._bounds.clear()
        if seen and arrived_s - self._bin_s < BIN_S:
            if ahead_s > 0.0:
                seen[-1] = stamp_s, arrived_s
        else:
            seen.append((stamp_s, arrived_s))
            self._bin_s = arrived_s
        while seen[0][1] < arrived_s - WINDOW_S:
            seen.popleft()
        self._measure_rate()

    def on_reply(self, vehicle_s: float, asked_s: float) -> None:
        """A request that we sent at host time `asked_s` or later arrived at vehicle time
        `vehicle_s`."""
        self._bounds.append((vehicle_s, asked_s))

    def _measure_rate(self) -> None:
        if self._settled and self._measured and self._rate == 1.0:
            return
        (first_s, began_s), (last_s, ended_s) = self._seen[0], self._seen[-1]
        if ended_s - began_s >= RATE_OVER_S:
            self._measured = True
            rate = (last_s - first_s) / (ended_s - began_s)
            self._rate = 1.0 if abs(rate - 1.0) < REAL_TIME else max(rate, 0.0)

    def now_s(self, host_s: float) -> float:
        """Vehicle time at host time `host_s`; -inf before the first telemetry."""
        rate, bounds = self._rate, self._bounds
        while bounds and host_s - bounds[0][1] > BOUNDS_S:
            bounds.popleft()
        shown_s = max([s + rate * (host_s - a) for s, a in self._seen], default=-math.inf)
        recent = [v + rate * (host_s - a) for v, a in bounds if host_s - a <= BOUNDS_S]
        return min([shown_s, *recent])

    def age_s(self, stamp_s: float, host_s: float) -> float:
        """Age at `host_s` of telemetry stamped `stamp_s`, beyond the least delay of the window."""
        return max(self.now_s(host_s) - stamp_s, 0.0)


class LinkDelay:
    """Median and spread of the newest delays, and what has been added since `settle`."""

    def __init__(self) -> None:
        self._requests: deque[tuple[int, float]] = deque(maxlen=REQUESTS_MAX)  # ts1, host time
        self._delays_s: deque[float] = deque(maxlen=REPLIES_MAX)
        self._began_s = math.inf  # host time of the first request
        self._settled_s = math.nan

    def reset(self) -> None:
        """Forget all replies: the vehicle's clock has restarted."""
        self._requests.clear()
        self._delays_s.clear()
        self._began_s = math.inf
        self._settled_s = math.nan

    def request(self, telemetry_s: float, host_s: float) -> Timesync:
        """The request to send with a setpoint at host time `host_s`. `telemetry_s`: stamp of the
        newest telemetry."""
        stamp_ns = round(telemetry_s * 1e9)
        self._requests.append((stamp_ns, host_s))
        self._began_s = min(self._began_s, host_s)
        return Timesync(0, stamp_ns)

    def on_reply(self, reply: TimesyncReply) -> float | None:
        """Evaluate a reply; returns the host time of its request. None for replies to requests of
        others, and of another clock."""
        asked = next((each for each in self._requests if each[0] == reply.request_ns), None)
        if asked is None:
            return None
        self._requests.remove(asked)  # a duplicate must not count again
        delay_s = (reply.vehicle_ns - reply.request_ns) * 1e-9
        if not 0.0 <= delay_s <= DELAY_MAX_S:
            return None
        self._delays_s.append(delay_s)
        return asked[1]

    @property
    def estimate(self) -> Estimate | None:
        """Median and standard deviation (s), or None before five replies."""
        if len(self._delays_s) < REPLIES_MIN:
            return None
        median_s = statistics.median(self._delays_s)
        deviation_s = statistics.median(abs(each - median_s) for each in self._delays_s)
        return Estimate(median_s, NORMAL * deviation_s)

    def is_measured(self, host_s: float) -> bool:
        """Whether the estimate can be relied on at host time `host_s`, or the vehicle answers
        nothing."""
        unanswered = not self._delays_s and host_s - self._began_s > DELAY_MAX_S
        return len(self._delays_s) >= REPLIES_MEASURED or unanswered

    def settle(self) -> None:
        """The present delay is what the control law takes into account."""
        estimate = self.estimate
        self._settled_s = estimate.value if estimate else math.nan

    @property
    def growth_s(self) -> float:
        """Median of the newest replies less the delay at `settle`; 0 while either is unknown."""
        newest = list(self._delays_s)[-REPLIES_NEWEST:]
        if math.isnan(self._settled_s) or len(newest) < REPLIES_NEWEST:
            return 0.0
        return statistics.median(newest) - self._settled_s


class LinkGrowth:
    """What the link has added to its delay since take-off, for prediction and bandwidth.

    `added_s` follows changes of more than LEAST_GROWTH_S. `changed_s` is by how much it changed
    within the last STEADY_S: a delay that changes is not known better than that.
    """

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Nothing was added."""
        self.added_s = self.changed_s = 0.0
        self._history: deque[tuple[float, float]] = deque(((-math.inf, 0.0),))  # from when, added_s

    def step(self, time_s: float, growth_s: float) -> bool:
        """Take the growth at vehicle time `time_s`; returns whether anything changed."""
        before = self.added_s, self.changed_s
        if abs(growth_s - self.added_s) > LEAST_GROWTH_S:
            self.added_s = growth_s
            self._history.append((time_s, growth_s))
        while len(self._history) > 1 and self._history[1][0] <= time_s - STEADY_S:
            self._history.popleft()
        values_s = [added_s for _, added_s in self._history]
        self.changed_s = max(values_s) - min(values_s)
        return before != (self.added_s, self.changed_s)
