"""Delay of the link, measured with TIMESYNC on the vehicle's clock.

A request is stamped with the vehicle time of the newest telemetry and sent with a setpoint. The
vehicle's reply holds this stamp and the vehicle time at which the request arrived. The difference
is the age of the telemetry when the setpoint arrived: the delay of both directions together. The
clock of this computer and the way of the reply do not matter.
"""

from __future__ import annotations

import statistics
from collections import deque

from offboard.identification.uncertainty import Estimate
from offboard.mavlink.events import TimesyncReply
from offboard.mavlink.outgoing import Timesync

REPLIES_MIN, REPLIES_MAX = 5, 40
DELAY_MAX_S = 2.0  # a larger difference belongs to another clock
NORMAL = 1.4826  # standard deviation of a normal distribution / median absolute deviation


class LinkDelay:
    """Median and spread of the newest delays."""

    def __init__(self) -> None:
        self._requests: deque[int] = deque(maxlen=REPLIES_MAX)
        self._delays_s: deque[float] = deque(maxlen=REPLIES_MAX)

    def reset(self) -> None:
        """Forget all replies: the vehicle's clock has restarted."""
        self._requests.clear()
        self._delays_s.clear()

    def request(self, telemetry_s: float) -> Timesync:
        """The request to send with a setpoint. `telemetry_s`: stamp of the newest telemetry."""
        stamp_ns = round(telemetry_s * 1e9)
        self._requests.append(stamp_ns)
        return Timesync(0, stamp_ns)

    def on_reply(self, reply: TimesyncReply) -> None:
        """Evaluate a reply; those to requests of others are ignored."""
        if reply.request_ns not in self._requests:
            return
        self._requests.remove(reply.request_ns)  # a duplicate must not count again
        delay_s = (reply.vehicle_ns - reply.request_ns) * 1e-9
        if 0.0 <= delay_s <= DELAY_MAX_S:
            self._delays_s.append(delay_s)

    @property
    def estimate(self) -> Estimate | None:
        """Median and standard deviation (s), or None before five replies."""
        if len(self._delays_s) < REPLIES_MIN:
            return None
        median_s = statistics.median(self._delays_s)
        deviation_s = statistics.median(abs(each - median_s) for each in self._delays_s)
        return Estimate(median_s, NORMAL * deviation_s)
