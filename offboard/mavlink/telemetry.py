"""Telemetry: frames of the vehicle become events, in the order and at the rates that are needed.

What is late, repeated or implausible is refused. Rates and time are counted by what is accepted.
"""

from __future__ import annotations

import math
from dataclasses import replace

from offboard.mavlink.counters import DropReason
from offboard.mavlink.decode import decode
from offboard.mavlink.dialects.base import Dialect
from offboard.mavlink.events import (
    Attitude,
    Event,
    Heartbeat,
    LocalPosition,
    ModeReport,
    Rebooted,
    TimesyncReply,
)
from offboard.mavlink.framing import STATUSTEXT, Frame
from offboard.mavlink.telemetry_rates import SHARE, TelemetryRates, fitted
from offboard.mavlink.texts import TextAssembler
from offboard.mavlink.vehicle_time import Age, VehicleTime

# A link may delay single frames: a report of the mode that was sent before one which arrived less
# than this ago says nothing new. HEARTBEAT comes at 1 Hz.
_REORDERED_S = 1.3
_HALF_TURN = 128  # of the sequence number; further ahead is behind
_GAP_S = 0.25  # without any frame, half a turn may have been lost


class Telemetry:
    """Telemetry of one vehicle. `capacity_bytes_ps` of the link limits the rates that are
    requested; None: unknown. `time.seconds` are the session's."""

    def __init__(self, capacity_bytes_ps: float | None, *, lockstep: bool) -> None:
        self.time = VehicleTime(lockstep)
        self.texts = TextAssembler()
        self.rates = TelemetryRates((), 0.0)
        self._capacity_bytes_ps = capacity_bytes_ps
        self._frames = 0  # sent by the vehicle, as the sequence numbers show; modulo 256 the newest
        self._heard_s = -math.inf  # when the newest frame arrived
        self._mode_report = (0, -math.inf)  # number of the newest, and when it arrived

    def interpret(
        self, frame: Frame, dialect: Dialect, now_s: float
    ) -> tuple[Event, ...] | DropReason | None:
        """The events of a verified frame of the vehicle, None for a message without decoder; or why
        it is dropped. `now_s`: its arrival."""
        number = self._number(frame, now_s)
        if frame.message_id == STATUSTEXT:
            return tuple(self.texts.add(frame.payload, now_s))
        event = decode(frame, dialect)
        if isinstance(event, DropReason):
            return event
        if isinstance(event, (LocalPosition, Attitude)):
            return self._stamped(event, frame.message_id, dialect, now_s)
        if isinstance(event, (Heartbeat, ModeReport)) and self._overtaken(number, now_s):
            return DropReason.STALE
        self.rates.count(frame.message_id, self.time.seconds)
        return None if event is None else (event,)

    def _stamped(
        self, event: LocalPosition | Attitude, message_id: int, dialect: Dialect, now_s: float
    ) -> tuple[Event, ...] | DropReason:
        wrapped_s = self.time.wrapped_s(event.time_s)
        if wrapped_s:
            event = replace(event, time_s=event.time_s + wrapped_s)
        age = self.time.check(message_id, event.time_s)
        if age is Age.STALE:
            return DropReason.STALE
        # after the check of the stamp: duplicates must not raise the measured rate
        self.rates.count(message_id, self.time.seconds)
        if age is Age.REBOOTED:
            self._mode_report = (0, -math.inf)  # it counts anew
            self.request_from(dialect)  # a rebooted vehicle has its default rates
        self.time.on_telemetry(event.time_s, now_s)
        return (Rebooted(event.time_s), event) if age is Age.REBOOTED else (event,)

    def _number(self, frame: Frame, now_s: float) -> int:
        """The number of the frame in the order of sending, by its 8-bit sequence number."""
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

    def timesync_reply(self, tc1_ns: int, ts1_ns: int) -> TimesyncReply:
        """A reply of the vehicle, whose clock is put on that of the stamps."""
        wrapped_ns = round(self.time.wrapped_s(tc1_ns / 1e9) * 1e9)
        return TimesyncReply(ts1_ns, tc1_ns + wrapped_ns)

    # --- rates ---

    def request_from(self, dialect: Dialect) -> None:
        """Request all messages that are wanted of this autopilot."""
        wanted = dialect.wanted
        if self._capacity_bytes_ps is not None:
            wanted = fitted(wanted, self._capacity_bytes_ps)
        self.rates = TelemetryRates(wanted, self.time.seconds)

    def thin(self, dialect: Dialect) -> bool:
        """Request half of it from now on. False if the rates are the lowest already."""
        before = self.rates.bytes_ps
        self._capacity_bytes_ps = 0.5 * before / SHARE
        self.request_from(dialect)
        return self.rates.bytes_ps < 0.99 * before
