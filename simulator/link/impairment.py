"""Link faults: delay, loss, duplication, reordering, corruption and limited rate of datagrams.

They act on bytes, outside the MAVLink server. Time (in microseconds) and the random generator are
arguments, so that the same seed gives the same faults.
"""

from __future__ import annotations

import heapq
from collections.abc import Sequence
from random import Random

from pydantic import Field

from offboard.documents.parameters import Parameters
from simulator.link.framing import frames

# Answers and events, which `message_rate_hz` does not drop: PARAM_VALUE, MISSION_*,
# COMMAND_ACK, FILE_TRANSFER_PROTOCOL, TIMESYNC, AUTOPILOT_VERSION, MESSAGE_INTERVAL, STATUSTEXT
_NOT_STREAMED = frozenset((22, *range(37, 48), 51, 73, 77, 110, 111, 148, 244, 253))


class Impairment(Parameters):
    """Faults of one direction of a link; probabilities are per datagram."""

    latency_s: float = Field(default=0.0, ge=0, le=10)
    ramp_s: float = Field(default=0.0, ge=0, le=1e5)  # the latency increases from 0 in this time
    jitter_s: float = Field(default=0.0, ge=0, le=5)  # added delay, uniform; the order is kept
    loss: float = Field(default=0.0, ge=0, le=1)
    duplication: float = Field(default=0.0, ge=0, le=1)
    reorder: float = Field(default=0.0, ge=0, le=1)  # probability of a delay by `reorder_s`
    reorder_s: float = Field(default=0.02, ge=0, le=5)
    corruption: float = Field(default=0.0, ge=0, le=1)  # probability of one flipped bit
    rate_bytes_ps: float | None = Field(default=None, ge=100, le=1e9)
    stalled: bool = False  # datagrams wait until the fault ends and then arrive at once, in order
    # queue for the limited rate, or until a stall ends; datagrams that do not fit are lost
    queue_bytes: int = Field(default=4096, ge=280, le=10_000_000)
    message_rate_hz: float | None = Field(default=None, ge=0.1, le=1000)  # limit per message id


class Channel:
    """One direction of a link: `put` sends a datagram, `take` returns those that have arrived."""

    def __init__(self, settings: Impairment, random: Random) -> None:
        self._settings = settings
        self._random = random
        self.on = True  # False: no more faults; datagrams under way still arrive
        self._under_way: list[tuple[int, int, bytes]] = []
        self._held: list[bytes] = []  # while stalled
        self._begun_us: int | None = None
        self._count = 0
        self._newest_us = self._idle_us = 0
        self._slots: dict[int, int] = {}

    def put(self, datagram: bytes, now_us: int) -> None:
        """Send one datagram at `now_us`."""
        if not self.on:
            self._release(now_us)
            self._deliver(max(now_us, self._newest_us), datagram)
            return
        settings, chance = self._settings, self._random.random
        if settings.message_rate_hz is not None:
            datagram = self._thinned(datagram, now_us, settings.message_rate_hz)
        if not datagram or (settings.loss and chance() < settings.loss):
            return
        if settings.stalled:
            self._hold(datagram)
            return
        sent_us = self._transmitted(len(datagram), now_us)
        if sent_us is None:
            return
        if settings.corruption and chance() < settings.corruption:
            datagram = self._damaged(datagram)
        twice = bool(settings.duplication) and chance() < settings.duplication
        delay_s = self._latency_s(now_us)
        delay_s += settings.jitter_s * chance() if settings.jitter_s else 0.0
        due_us = max(sent_us + round(delay_s * 1e6), self._newest_us)
        if settings.reorder and chance() < settings.reorder:
            due_us += round(settings.reorder_s * 1e6)
        else:
            self._newest_us = due_us
        for _ in range(1 + twice):
            self._deliver(due_us, datagram)

    def take(self, now_us: int) -> list[bytes]:
        """Return the datagrams that have arrived by `now_us`, in the order of arrival."""
        if not self.on:
            self._release(now_us)
        arrived: list[bytes] = []
        while self._under_way and self._under_way[0][0] <= now_us:
            arrived.append(heapq.heappop(self._under_way)[2])
        return arrived

    def _latency_s(self, now_us: int) -> float:
        """Latency at this time; with `ramp_s` it increases from the first datagram on."""
        settings = self._settings
        if not settings.ramp_s:
            return settings.latency_s
        if self._begun_us is None:
            self._begun_us = now_us
        return settings.latency_s * min(1.0, (now_us - self._begun_us) * 1e-6 / settings.ramp_s)

    def _hold(self, datagram: bytes) -> None:
        if sum(map(len, self._held)) + len(datagram) <= self._settings.queue_bytes:
            self._held.append(datagram)

    def _release(self, now_us: int) -> None:
        for datagram in self._held:
            self._deliver(now_us, datagram)
        self._held.clear()

    def _deliver(self, due_us: int, datagram: bytes) -> None:
        heapq.heappush(self._under_way, (due_us, self._count, datagram))
        self._count += 1

    def _transmitted(self, size: int, now_us: int) -> int | None:
        """Time at which the last byte is sent at the limited rate; None if the queue is full."""
        rate = self._settings.rate_bytes_ps
        if rate is None:
            return now_us
        waiting = max(0, self._idle_us - now_us) * 1e-6 * rate
        if waiting + size > self._settings.queue_bytes:
            return None
        self._idle_us = max(self._idle_us, now_us) + round(1e6 * size / rate)
        return self._idle_us

    def _damaged(self, datagram: bytes) -> bytes:
        bit = self._random.randrange(8 * len(datagram))
        damaged = bytearray(datagram)
        damaged[bit >> 3] ^= 1 << (bit & 7)
        return bytes(damaged)

    def _thinned(self, datagram: bytes, now_us: int, rate_hz: float) -> bytes:
        """The datagram without messages whose id was already sent in this period of 1 / rate."""
        slot = int(now_us * 1e-6 * rate_hz + 1e-9)
        kept: list[bytes] = []
        for message_id, frame in frames(datagram):
            if message_id not in _NOT_STREAMED:
                if self._slots.get(message_id) == slot:
                    continue
                self._slots[message_id] = slot
            kept.append(frame)
        return b"".join(kept)


def carry(channels: Sequence[Channel], datagrams: list[bytes], now_us: int) -> list[bytes]:
    """Send these datagrams through the channels in series; return those that arrive by now."""
    for channel in channels:
        for datagram in datagrams:
            channel.put(datagram, now_us)
        datagrams = channel.take(now_us)
    return datagrams
