"""Telemetry: the messages that a firmware can send, and when those of one link are due.

Knows no client and no frame; `simulator.mavlink.outbox` fills and frames the messages.
"""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass, field
from types import ModuleType
from typing import Any

from simulator.autopilot.firmware import Firmware
from simulator.mavlink import messages
from simulator.mavlink.view import View
from simulator.steps import STEP_US

Builder = Callable[[View], Sequence[Any]]

ON_POSITION_GRID = frozenset(
    {"LOCAL_POSITION_NED", "ODOMETRY", "GLOBAL_POSITION_INT", "HIL_STATE_QUATERNION"}
)
LEAST_INTERVAL_US = {"GPS_RAW_INT": 125_000.0}  # the GPS receiver has eight fixes a second
INTERVAL_MAX_US = 2.0**31 - 1  # MESSAGE_INTERVAL.interval_us is an int32


def _builders_in(module: ModuleType) -> dict[str, Builder]:
    """Return the public functions of a module, by the name of the message that each builds."""
    return {
        name.upper(): function
        for name, function in vars(module).items()
        if inspect.isfunction(function)
        and function.__module__ == module.__name__
        and not name.startswith("_")
    }


def builders(firmware: Firmware) -> dict[str, Builder]:
    """Return the builders of all messages of this firmware, by message name."""
    return {**_builders_in(messages), **_builders_in(firmware.messages)}


@dataclass(slots=True)
class Stream:
    """A message that is sent periodically; times are vehicle time since boot."""

    interval_us: int
    due_us: int
    grid_us: int  # it is sent at multiples of this only
    version: Callable[[View], Hashable] | None  # None: it does not wait for new content
    sent: Hashable  # version of the content that was sent last

    def next_after(self, now_us: int) -> None:
        """Make it due at the next multiple of the interval, so that the mean rate is exact."""
        self.due_at((now_us // self.interval_us + 1) * self.interval_us)

    def due_at(self, time_us: int) -> None:
        """Make it due at this time, or at the next multiple of `grid_us`."""
        self.due_us = -(-time_us // self.grid_us) * self.grid_us


@dataclass(slots=True)
class Schedule:
    """Streams of one link. `rates_hz` are the rates of the messages sent without a request."""

    view: View
    rates_hz: Mapping[str, float]
    streams: dict[str, Stream] = field(default_factory=dict)
    _next_us: float = 0.0  # before this time no stream is due

    def __post_init__(self) -> None:
        for name, rate_hz in self.rates_hz.items():
            self._start(name, round(1e6 / rate_hz)).due_at(STEP_US)

    def _start(self, name: str, interval_us: int) -> Stream:
        """Make a stream of message `name`, in the place of an older one in `streams`."""
        steps = self.view.autopilot.firmware.position_grid_steps
        grid_us = STEP_US * (steps if name in ON_POSITION_GRID else 1)
        version = self.view.autopilot.firmware.message_versions.get(name)
        sent = self.streams[name].sent if name in self.streams else None
        self.streams[name] = stream = Stream(interval_us, 0, grid_us, version, sent)
        self._next_us = 0.0
        return stream

    def take_due(self) -> list[str]:
        """Return the names of the messages due now, in the order of the streams, and set the time
        at which each is due next."""
        view, now_us = self.view, self.view.autopilot.state.time_us
        if now_us < self._next_us:
            return []
        due: list[str] = []
        next_us = math.inf
        for name, stream in self.streams.items():
            if now_us >= stream.due_us and (stream.version is None or self._is_new(stream)):
                stream.next_after(now_us)
                if not view.withheld(name):
                    due.append(name)
            if stream.due_us < next_us:
                next_us = stream.due_us
        self._next_us = next_us
        return due

    def _is_new(self, stream: Stream) -> bool:
        """Whether the content of the message was not sent yet; it then counts as sent."""
        assert stream.version is not None
        newest = stream.version(self.view)
        new, stream.sent = newest != stream.sent, newest
        return new

    def set_interval(self, name: str, interval_us: float) -> bool:
        """Set the interval of a message; 0 restores the default, < 0 stops it. Return False if the
        message has no settable interval."""
        if name not in self.view.builders or name in self.view.autopilot.firmware.fixed_streams:
            return False
        if interval_us == 0:
            rate_hz = self.rates_hz.get(name)
            interval_us = 1e6 / rate_hz if rate_hz else -1.0
        if interval_us < 0:
            self.streams.pop(name, None)
            return True
        least_us = LEAST_INTERVAL_US.get(name, 1.0)
        interval_us = round(min(INTERVAL_MAX_US, max(least_us, interval_us)))
        self._start(name, interval_us).next_after(self.view.autopilot.state.time_us)
        return True

    def set_group(self, group: int, rate_hz: float) -> None:
        """Apply REQUEST_DATA_STREAM to a MAV_DATA_STREAM; 0 stops its messages. It is then the
        default of their intervals."""
        names = self.view.autopilot.firmware.stream_groups.get(group, ())
        self.rates_hz = {**self.rates_hz, **dict.fromkeys(names, rate_hz)}
        for name in names:
            self.set_interval(name, 0.0)
