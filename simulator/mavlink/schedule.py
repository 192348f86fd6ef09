"""What one link says by itself: the streams and their intervals, as clients ask for them.

What is due is found and written elsewhere (`simulator.mavlink.stretch`). Knows no client and no
frame.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from simulator.mavlink.telemetry import LEAST_INTERVAL_US
from simulator.mavlink.view import View

INTERVAL_MAX_US = 2.0**31 - 1  # MESSAGE_INTERVAL.interval_us is an int32


@dataclass(slots=True)
class Stream:
    """One message sent by itself: interval and next time, microseconds of vehicle time."""

    interval_us: int
    due_us: int


@dataclass(slots=True)
class Schedule:
    """`rates_hz`: what is sent without being asked. `changed`: the streams are others than they
    were, until somebody takes note."""

    view: View
    rates_hz: Mapping[str, float]
    streams: dict[str, Stream] = field(default_factory=dict)
    changed: bool = True

    def __post_init__(self) -> None:
        self.restart()

    def restart(self) -> None:
        """As after boot."""
        self.changed = True
        self.streams = {
            name: Stream(round(1e6 / rate_hz), 0) for name, rate_hz in self.rates_hz.items()
        }

    def set_interval(self, name: str, interval_us: float) -> bool:
        """0 restores the default, < 0 stops; False when the message has no settable rate."""
        if name not in self.view.builders or name in self.view.autopilot.firmware.streams.fixed:
            return False
        if interval_us == 0:
            rate_hz = self.rates_hz.get(name)
            interval_us = -1.0 if rate_hz is None else 1e6 / rate_hz
        self.changed = True
        if interval_us < 0:
            self.streams.pop(name, None)
            return True
        least_us = LEAST_INTERVAL_US.get(name, 1.0)
        interval_us = round(min(INTERVAL_MAX_US, max(least_us, interval_us)))
        # multiples of the interval, so that the mean rate is exact
        next_us = (self.view.autopilot.senses.time_us // interval_us + 1) * interval_us
        self.streams[name] = Stream(interval_us, next_us)
        return True

    def interval_us(self, name: str) -> int:
        """Interval of a message; -1 when it is not sent by itself."""
        stream = self.streams.get(name)
        return -1 if stream is None else stream.interval_us

    def set_group(self, group: int, rate_hz: float) -> None:
        """REQUEST_DATA_STREAM of a MAV_DATA_STREAM, which is not acknowledged; 0 stops it."""
        for name in self.view.autopilot.firmware.streams.groups.get(group, ()):
            self.set_interval(name, 1e6 / rate_hz if rate_hz else -1.0)
