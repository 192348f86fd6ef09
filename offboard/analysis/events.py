"""Events of a flight in vehicle time: phases of `offboard`, modes and texts of the vehicle."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from offboard.analysis.sender import Stream
from offboard.mavlink.decode import decode_text_chunk
from offboard.mavlink.dialects.base import Dialect
from offboard.mavlink.texts import TextAssembler

Array = NDArray[np.float64]
Clock = Callable[[Array], Array]  # stamps in ms to vehicle time in s
_Text = tuple[int, float, str]  # place in the log, stamp of the telemetry before it in ms, text

OUR_PREFIX = "offboard: "  # of the texts that announce a phase


@dataclass(frozen=True, slots=True)
class Event:
    """A phase, a mode or a text: vehicle time (NaN before telemetry), sender, and what."""

    time_s: float
    who: str
    what: str

    @property
    def phase(self) -> str:
        """The phase that it announces."""
        return self.what.partition(":")[0]


def phases(texts: Stream, clock: Clock) -> tuple[Event, ...]:
    """The phases that our STATUSTEXT announce: name, colon, reason."""
    announced = (
        (place, now_ms, text.removeprefix(OUR_PREFIX))
        for place, now_ms, text in _texts(texts)
        if text.startswith(OUR_PREFIX)
    )
    return _events(clock, "offboard", announced)


def announcements(texts: Stream, clock: Clock) -> tuple[Event, ...]:
    """Our other texts: what was identified or limited, and decisions that were missed."""
    others = (
        (place, now_ms, text)
        for place, now_ms, text in _texts(texts)
        if not text.startswith(OUR_PREFIX)
    )
    return _events(clock, "offboard", others)


def modes(heartbeats: Stream, dialect: Dialect | None, clock: Clock) -> tuple[Event, ...]:
    """The mode of the first HEARTBEAT, and every change; none for an unknown autopilot."""
    numbers = heartbeats.columns("custom_mode")[:, 0]
    changed = np.flatnonzero(np.diff(numbers, prepend=-1.0)) if dialect else ()
    names = (
        (heartbeats.places[row], heartbeats.now_ms[row], dialect.mode_name(int(numbers[row])))
        for row in changed
        if dialect
    )
    return _events(clock, "vehicle", names)


def vehicle_messages(texts: Stream, acks: Stream, clock: Clock) -> tuple[Event, ...]:
    """Texts of the vehicle, and the commands that it refused."""
    refused = [
        (place, now_ms, f"command {command:.0f} refused, result {result:.0f}")
        for place, now_ms, (command, result) in zip(
            acks.places, acks.now_ms, acks.columns("command result"), strict=True
        )
        if result not in (0, 5)  # MAV_RESULT_ACCEPTED, MAV_RESULT_IN_PROGRESS
    ]
    return _events(clock, "vehicle", _texts(texts) + refused)


def _events(clock: Clock, who: str, texts: Iterable[_Text]) -> tuple[Event, ...]:
    return tuple(
        Event(float(clock(np.array(now_ms))), who, what) for _, now_ms, what in sorted(texts)
    )


def _texts(stream: Stream) -> list[_Text]:
    """All STATUSTEXT, joined from their chunks, each at the place of its last one."""
    assembler, texts = TextAssembler(), []
    rows = zip(stream.places, stream.unix_us, stream.now_ms, stream.payloads(), strict=True)
    for place, unix_us, now_ms, payload in rows:
        whole = assembler.add(decode_text_chunk(payload), unix_us / 1e6)
        texts += [(place, now_ms, text.text) for text in whole]
    return texts
