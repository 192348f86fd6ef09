"""Telemetry: converts frames of the vehicle to events, in order, and requests the needed rates.

Messages that are late, repeated or implausible are dropped. A ground station may change the rates
that we requested: therefore rates are measured, and requested again. Rates are per second of link
time (`Session.link_time_s`), so that they mean the same in real time, at higher speed and in
lockstep.
"""

from __future__ import annotations

import math
import re
from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass, field, replace

from offboard.mavlink.decode import DECODERS
from offboard.mavlink.dialects.base import Dialect, WantedMessage
from offboard.mavlink.events import (
    Attitude,
    Event,
    Heartbeat,
    LocalPosition,
    ModeReport,
    Rebooted,
)
from offboard.mavlink.framing import STATUSTEXT, Frame
from offboard.mavlink.texts import TextAssembler
from offboard.mavlink.vehicle_time import Age, VehicleTime

# A report of the mode is dropped if it was sent before one that arrived less than this time ago
_REORDERED_S = 1.3
_HALF_TURN = 128  # a sequence number that is this far ahead or more is taken as behind
_GAP_S = 0.25  # after this time without any frame, half a turn may have been lost
SLOW_HZ = 20.0  # lowest rate to which a message is thinned on a slow link
SHARE = 0.68  # of a link's capacity for requested messages; the rest is for all others
_WINDOW_S = 2.0  # over which rates are measured
ENOUGH = 0.7  # of the wanted rate: the window has few samples of a slow message
_FIRST_WAIT_S, _LONGEST_WAIT_S = 3.0, 30.0  # between two requests for a message
_OPTIONAL_TRIES = 2
_STOPPED_S = 0.2  # a fast message that is missing for this time was stopped, or all are lost
_STOPPED_WAIT_S = 1.0  # between two requests for it: a ground station may stop it every few seconds
_UNHEARD = 0.1  # of the wanted rate: a message that arrives more rarely has its default rate
# ArduCopter denies rates above 0.8 SCHED_LOOP_RATE. Its COMMAND_ACK does not name the message, and
# is the same for unknown messages; this STATUSTEXT names the message
TOO_FAST = re.compile(r"message ID (\d{1,8}) too fast")
_ARRIVALS_MAX = 4096  # limits the memory used when a link is flooded


class Telemetry:
    """Telemetry of one vehicle. `capacity_bytes_ps` of the link limits the requested rates; None:
    unknown. `time.seconds` is `Session.link_time_s`. `dialect` is None before `begin`."""

    def __init__(self, capacity_bytes_ps: float | None) -> None:
        self.time = VehicleTime()
        self.texts = TextAssembler()
        self.dialect: Dialect | None = None
        self._streams: dict[int, _Stream] = {}  # wanted messages, by message id
        self._capacity_bytes_ps = capacity_bytes_ps
        # number of the newest frame; modulo 256 it is the sequence number
        self._frames = 0
        self._heard_s = -math.inf  # when the newest frame arrived
        self._mode_report = (0, -math.inf)  # frame number of the newest report, and its arrival

    def interpret(self, frame: Frame, now_s: float, events: list[Event]) -> None:
        """Add to `events` the events of a frame of the vehicle that arrived at `now_s`."""
        number = self._number(frame, now_s)
        if frame.message_id == STATUSTEXT:
            texts = self.texts.add(frame.payload, now_s)
            for each in texts:
                self._on_text(each.text)
            events += texts
            return
        decoder = DECODERS.get(frame.message_id)
        if decoder is None:  # only its rate is measured
            self._count(frame.message_id)
            return
        assert self.dialect is not None
        event = decoder(frame.message, self.dialect)
        if isinstance(event, (LocalPosition, Attitude)):
            self._on_stamped(event, frame.message_id, now_s, events)
        elif isinstance(event, (Heartbeat, ModeReport)) and self._overtaken(number, now_s):
            return
        elif event is not None:
            self._count(frame.message_id)
            events.append(event)

    def _on_stamped(
        self, event: LocalPosition | Attitude, message_id: int, now_s: float, events: list[Event]
    ) -> None:
        wrapped_s = self.time.wrapped_s(event.time_s)
        if wrapped_s:
            event = replace(event, time_s=event.time_s + wrapped_s)
        age = self.time.check(message_id, event.time_s)
        if age is Age.STALE:
            return
        # after the check of the stamp: duplicates must not raise the measured rate
        self._count(message_id)
        if age is Age.REBOOTED:
            self._mode_report = (0, -math.inf)  # sequence numbers start again
            self._request()  # a rebooted vehicle has its default rates
            events.append(Rebooted())
        self.time.on_telemetry(event.time_s, now_s)
        events.append(event)

    def _number(self, frame: Frame, now_s: float) -> int:
        """The number of the frame in the order of sending, from its 8-bit sequence number."""
        ahead = (frame.sequence - self._frames) % 256
        if ahead >= _HALF_TURN and now_s - self._heard_s < _GAP_S:
            return self._frames + ahead - 256
        self._frames, self._heard_s = self._frames + ahead, now_s
        return self._frames

    def _overtaken(self, number: int, now_s: float) -> bool:
        """Whether this report of the mode was sent before the newest one."""
        newest, arrived_s = self._mode_report
        if number < newest and now_s - arrived_s < _REORDERED_S:
            return True
        self._mode_report = number, now_s
        return False

    # --- rates ---

    def begin(self, dialect: Dialect) -> None:
        """Request all messages that are wanted from an autopilot with this dialect."""
        self.dialect = dialect
        self._request()

    def _request(self) -> None:
        wanted = self._fitted(self._capacity_bytes_ps)
        self._streams = {each.message_id: _Stream(each, self.time.seconds) for each in wanted}

    def _fitted(self, bytes_ps: float | None) -> tuple[WantedMessage, ...]:
        wanted = self.dialect.wanted if self.dialect else ()
        return wanted if bytes_ps is None else fitted(wanted, bytes_ps)

    def thin(self) -> bool:
        """Request half of the bytes per second, because the link is saturated. Returns False, and
        changes nothing, if the rates are the lowest already."""
        half_bytes_ps = 0.5 * self.bytes_ps / SHARE
        if sum(each.bytes_ps for each in self._fitted(half_bytes_ps)) >= 0.99 * self.bytes_ps:
            return False
        self._capacity_bytes_ps = half_bytes_ps
        self._request()
        return True

    def due(self) -> list[WantedMessage]:
        """Messages to request now. The caller must request them: they count as requested."""
        now_s = self.time.seconds
        return [each.wanted for each in self._streams.values() if each.request(now_s)]

    def _on_text(self, text: str) -> None:
        named = TOO_FAST.search(text)
        stream = self._streams.get(int(named[1])) if named else None
        if stream:
            stream.too_fast = True

    @property
    def rates_hz(self) -> dict[str, float]:
        """Measured rate in Hz of each wanted message over the last two seconds, by name."""
        now_s = self.time.seconds
        return {each.wanted.name: each.rate_hz(now_s) for each in self._streams.values()}

    @property
    def bytes_ps(self) -> float:
        """Bytes per second of all wanted messages at the rates requested."""
        return sum(each.wanted.bytes_ps for each in self._streams.values())

    def _count(self, message_id: int) -> None:
        """Count a message that has arrived, for its rate."""
        stream = self._streams.get(message_id)
        if stream:
            stream.arrivals_s.append(self.time.seconds)


def fitted(wanted: Iterable[WantedMessage], bytes_ps: float) -> tuple[WantedMessage, ...]:
    """`wanted` with rates that a link with a capacity of `bytes_ps` carries.

    The rates of messages above SLOW_HZ are reduced by one common factor, but not below SLOW_HZ. If
    the link is too slow even for that, the flight is refused later because of the measured rates.
    """
    slow = [each for each in wanted if each.arrives_hz <= SLOW_HZ]
    fast = [each for each in wanted if each.arrives_hz > SLOW_HZ]
    left = SHARE * bytes_ps - sum(each.bytes_ps for each in slow)
    factor = min(max(left / sum(each.bytes_ps for each in fast), 0.0), 1.0) if fast else 1.0
    return (
        *(replace(each, rate_hz=max(factor * each.rate_hz, SLOW_HZ)) for each in fast),
        *slow,
    )


@dataclass(slots=True)
class _Stream:
    wanted: WantedMessage
    began_s: float
    arrivals_s: deque[float] = field(default_factory=lambda: deque(maxlen=_ARRIVALS_MAX))
    requested_s: float | None = None
    requests: int = 0
    wait_s: float = _FIRST_WAIT_S
    too_fast: bool = False  # whether the vehicle has denied the requested rate

    def rate_hz(self, now_s: float) -> float:
        while self.arrivals_s and self.arrivals_s[0] <= now_s - _WINDOW_S:
            self.arrivals_s.popleft()
        measured_s = min(_WINDOW_S, now_s - self.began_s)
        return len(self.arrivals_s) / measured_s if measured_s > 0.0 else 0.0

    def request(self, now_s: float) -> bool:
        """Whether to request the message now; if so, it counts as requested."""
        if self.requested_s is not None and not self._again(now_s - self.requested_s, now_s):
            return False
        if self.requests:
            self.wait_s = min(2.0 * self.wait_s, _LONGEST_WAIT_S)
        if self.too_fast:
            slower_hz = min(self.wanted.rate_hz, max(0.5 * self.wanted.rate_hz, SLOW_HZ))
            self.wanted, self.too_fast = replace(self.wanted, rate_hz=slower_hz), False
        self.requested_s = now_s
        self.requests += 1
        return True

    def _again(self, waited_s: float, now_s: float) -> bool:
        if waited_s < _STOPPED_WAIT_S:
            return False
        rate_hz, enough_hz = self.rate_hz(now_s), ENOUGH * self.wanted.arrives_hz
        fast = rate_hz > 0.0 and self.wanted.arrives_hz > SLOW_HZ
        if fast and now_s - self.arrivals_s[-1] > _STOPPED_S:
            return True  # without waiting longer, so that the flight does not end because of it
        if waited_s < _FIRST_WAIT_S:
            return False
        if 0.0 < rate_hz < min(_UNHEARD * self.wanted.rate_hz, enough_hz):
            return True  # it still has its default rate: the link has lost the requests
        if waited_s < self.wait_s:
            return False
        if rate_hz >= enough_hz:
            self.wait_s, self.requests = _FIRST_WAIT_S, 0
            return False
        return not (self.wanted.optional and self.requests >= _OPTIONAL_TRIES)
