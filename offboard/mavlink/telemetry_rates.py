"""Telemetry rates: which messages are needed, how fast they arrive, when to request them again.

Rates are per second of `Session.link_time_s`, so that they mean the same in real time, at higher
speed and in lockstep. A ground station may change the rates that we requested: therefore they are
measured, and requested again. Knows message ids, sizes and times, no bytes.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass, field, replace

from pymavlink.dialects.v20.all import mavlink_map

from offboard.mavlink.dialects.base import WantedMessage

SLOW_HZ = 20.0
SHARE = 0.68  # of a link's capacity; the rest is for what is not requested
FRAME_BYTES = 12  # of a MAVLink 2 frame besides its payload
_WINDOW_S = 2.0
_ENOUGH = 0.7  # of the rate wanted; a window holds few samples of a slow message
_FIRST_WAIT_S, _LONGEST_WAIT_S = 3.0, 30.0
_OPTIONAL_TRIES = 2
_UNHEARD = 0.1  # of the rate wanted: what arrives more rarely has its default rate
_ARRIVALS_MAX = 4096  # limits the memory used when a link is flooded


def fitted(wanted: Iterable[WantedMessage], bytes_ps: float) -> tuple[WantedMessage, ...]:
    """`wanted` at rates that a link with a capacity of `bytes_ps` carries.

    Messages at more than SLOW_HZ are thinned, all by the same factor, but not below SLOW_HZ: what
    needs more than that is refused later, by the rates that arrive.
    """
    slow = [each for each in wanted if each.arrives_hz <= SLOW_HZ]
    fast = [each for each in wanted if each.arrives_hz > SLOW_HZ]
    left = SHARE * bytes_ps - _bytes_ps(slow)
    factor = min(max(left / _bytes_ps(fast), 0.0), 1.0) if fast else 1.0
    return (
        *(replace(each, rate_hz=max(factor * each.rate_hz, SLOW_HZ)) for each in fast),
        *slow,
    )


def _bytes_ps(wanted: Iterable[WantedMessage]) -> float:
    return sum(each.arrives_hz * (FRAME_BYTES + _payload_bytes(each.message_id)) for each in wanted)


def _payload_bytes(message_id: int) -> int:
    size: int = mavlink_map[message_id].unpacker.size
    return size


@dataclass(slots=True)
class _Stream:
    wanted: WantedMessage
    began_s: float
    arrivals_s: deque[float] = field(default_factory=lambda: deque(maxlen=_ARRIVALS_MAX))
    requested_s: float | None = None
    requests: int = 0
    wait_s: float = _FIRST_WAIT_S

    def rate_hz(self, now_s: float) -> float:
        while self.arrivals_s and self.arrivals_s[0] <= now_s - _WINDOW_S:
            self.arrivals_s.popleft()
        measured_s = min(_WINDOW_S, now_s - self.began_s)
        return len(self.arrivals_s) / measured_s if measured_s > 0.0 else 0.0

    def request(self, now_s: float) -> bool:
        """Whether to request it now; then it counts as requested."""
        if self.requested_s is not None and not self._again(now_s - self.requested_s, now_s):
            return False
        if self.requests:
            self.wait_s = min(2.0 * self.wait_s, _LONGEST_WAIT_S)
        self.requested_s = now_s
        self.requests += 1
        return True

    def _again(self, waited_s: float, now_s: float) -> bool:
        rate_hz, enough_hz = self.rate_hz(now_s), _ENOUGH * self.wanted.arrives_hz
        lost_hz = min(_UNHEARD * self.wanted.rate_hz, enough_hz)
        if waited_s >= _FIRST_WAIT_S and 0.0 < rate_hz < lost_hz:
            return True  # the link has lost the requests
        if waited_s < self.wait_s:
            return False
        if rate_hz >= enough_hz:
            self.wait_s, self.requests = _FIRST_WAIT_S, 0
            return False
        return not (self.wanted.optional and self.requests >= _OPTIONAL_TRIES)


class TelemetryRates:
    """Measured rates of the wanted messages. All times are `Session.link_time_s`."""

    def __init__(self, wanted: Iterable[WantedMessage], began_s: float) -> None:
        self._streams = {w.message_id: _Stream(w, began_s) for w in wanted}

    @property
    def bytes_ps(self) -> float:
        """Bytes per second of all wanted messages at the rates requested."""
        return _bytes_ps(stream.wanted for stream in self._streams.values())

    def count(self, message_id: int, now_s: float) -> None:
        """A message has arrived."""
        stream = self._streams.get(message_id)
        if stream is not None:
            stream.arrivals_s.append(now_s)

    def due(self, now_s: float) -> list[WantedMessage]:
        """Messages to request now; they count as requested."""
        return [each.wanted for each in self._streams.values() if each.request(now_s)]

    def measured_hz(self, now_s: float) -> dict[str, float]:
        """Rate of each wanted message over the last two seconds, by name."""
        return {s.wanted.name: s.rate_hz(now_s) for s in self._streams.values()}
