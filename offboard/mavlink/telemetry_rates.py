"""Which telemetry is wanted, how fast it really comes, and when to ask for it (again).

Rates are per second of vehicle time, so that they mean the same in real time, faster and in
lockstep; where the vehicle's time does not flow, ours takes its place. Knows message ids and
times, no bytes. A ground station may reset what we asked for: hence measure, and ask again.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass, field

from offboard.mavlink.dialects.base import WantedMessage

_WINDOW_S = 2.0
_ENOUGH = 0.7  # of the rate wanted; a window holds few samples of a slow message
_FIRST_WAIT_S, _LONGEST_WAIT_S = 3.0, 30.0
_OPTIONAL_TRIES = 2
_SILENCE_S = 1.0
_REBOOT_S = 2.0
_MOST_ARRIVALS = 4096  # a flood must not fill the memory


class LinkTime:
    """Monotonic seconds that follow the vehicle's time while it flows, else ours."""

    def __init__(self) -> None:
        self.seconds = 0.0
        self._vehicle_s: float | None = None
        self._heard_s: float | None = None
        self._host_s: float | None = None

    def vehicle(self, time_s: float, now_s: float) -> None:
        """A stamp of the vehicle; streams overtake each other, so an older one changes nothing."""
        self._heard_s = now_s
        step_s = 0.0 if self._vehicle_s is None else time_s - self._vehicle_s
        if self._vehicle_s is None or step_s > 0.0 or step_s < -_REBOOT_S:
            self.seconds += min(max(step_s, 0.0), _SILENCE_S)
            self._vehicle_s = time_s

    def host(self, now_s: float) -> None:
        """Our time goes on; it counts once the vehicle has been silent for a second."""
        flowing = self._heard_s is not None and now_s - self._heard_s <= _SILENCE_S
        if not flowing and self._host_s is not None:
            self.seconds += max(now_s - self._host_s, 0.0)
        self._host_s = now_s


@dataclass(slots=True)
class _Stream:
    wanted: WantedMessage
    began_s: float
    arrivals_s: deque[float] = field(default_factory=lambda: deque(maxlen=_MOST_ARRIVALS))
    asked_s: float | None = None
    asked: int = 0
    wait_s: float = _FIRST_WAIT_S

    def rate_hz(self, now_s: float) -> float:
        while self.arrivals_s and self.arrivals_s[0] <= now_s - _WINDOW_S:
            self.arrivals_s.popleft()
        watched_s = min(_WINDOW_S, now_s - self.began_s)
        return len(self.arrivals_s) / watched_s if watched_s > 0.0 else 0.0

    def enough(self, now_s: float) -> bool:
        return self.rate_hz(now_s) >= _ENOUGH * self.wanted.rate_hz

    def due(self, now_s: float) -> bool:
        if self.asked_s is None:
            return True
        if now_s - self.asked_s < self.wait_s:
            return False
        if self.enough(now_s):
            self.wait_s, self.asked = _FIRST_WAIT_S, 0
            return False
        return not (self.wanted.optional and self.asked >= _OPTIONAL_TRIES)

    def note_asked(self, now_s: float) -> None:
        if self.asked:
            self.wait_s = min(2.0 * self.wait_s, _LONGEST_WAIT_S)
        self.asked_s = now_s
        self.asked += 1


@dataclass(frozen=True, slots=True)
class Shortfall:
    """A message that comes slower than it must."""

    name: str
    wanted_hz: float
    measured_hz: float


class TelemetryRates:
    """All times are `LinkTime.seconds`."""

    def __init__(self, wanted: Iterable[WantedMessage], began_s: float) -> None:
        self._streams = {w.message_id: _Stream(w, began_s) for w in wanted}

    def count(self, message_id: int, now_s: float) -> None:
        stream = self._streams.get(message_id)
        if stream is not None:
            arrivals = stream.arrivals_s
            arrivals.append(now_s)
            while arrivals[0] <= now_s - _WINDOW_S:
                arrivals.popleft()

    def due(self, now_s: float) -> list[WantedMessage]:
        """Messages to ask for now; they count as asked for."""
        due = [stream for stream in self._streams.values() if stream.due(now_s)]
        for stream in due:
            stream.note_asked(now_s)
        return [stream.wanted for stream in due]

    def measured_hz(self, now_s: float) -> dict[str, float]:
        return {s.wanted.name: s.rate_hz(now_s) for s in self._streams.values()}

    def shortfalls(self, now_s: float) -> list[Shortfall]:
        """Messages, not optional, below what is enough."""
        return [
            Shortfall(s.wanted.name, s.wanted.rate_hz, s.rate_hz(now_s))
            for s in self._streams.values()
            if not s.wanted.optional and not s.enough(now_s)
        ]
