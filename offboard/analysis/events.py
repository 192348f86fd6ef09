"""Events of a flight in vehicle time: those of `offboard`, by their records in the log; modes and
texts of the vehicle."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from offboard.analysis.sender import Stream
from offboard.flight.phases import PHASE_CODES
from offboard.mavlink import event_record
from offboard.mavlink.decode import decode_text_chunk
from offboard.mavlink.dialects.base import Dialect
from offboard.mavlink.texts import TextAssembler

Array = NDArray[np.float64]
Clock = Callable[[Array], Array]  # stamps in ms to vehicle time in s
_Text = tuple[int, float, str]  # place in the log, stamp of the telemetry before it in ms, text

_PHASES: dict[int | None, str] = {code: phase.value for phase, code in PHASE_CODES.items()}
_TITLE = "offboard: "  # of the texts that announce a phase


@dataclass(frozen=True, slots=True)
class Event:
    """A phase, a mode or a text: vehicle time (NaN before telemetry), sender, and what. `phase`:
    the one that begins, empty for another event; `cause`: a word for what caused it, or empty."""

    time_s: float
    who: str
    what: str
    phase: str = ""
    cause: str = ""

    @property
    def reason(self) -> str:
        """Why its phase begins."""
        return self.what.removeprefix(f"{self.phase}: ")


def ours(records: Stream, texts: Stream, clock: Clock) -> tuple[Event, ...]:
    """Our events, from their records. A log without them is an older one: its phases are in our
    texts, without a word for the cause."""
    if not len(records):
        return tuple(map(_announced, _events(clock, "offboard", _texts(texts))))
    payloads = (bytes(payload[5 : 5 + payload[4]]) for payload in records.payloads())
    return tuple(
        Event(
            _time_s(clock, records.now_ms[row]),
            "offboard",
            event.text,
            _PHASES.get(event.phase, ""),
            event.cause,
        )
        for row, event in event_record.join(payloads)
    )


def _announced(text: Event) -> Event:
    what = text.what.removeprefix(_TITLE)
    return text if what == text.what else replace(text, what=what, phase=what.partition(":")[0])


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
    return tuple(Event(_time_s(clock, now_ms), who, what) for _, now_ms, what in sorted(texts))


def _time_s(clock: Clock, now_ms: float) -> float:
    return float(clock(np.array(now_ms)))


def _texts(stream: Stream) -> list[_Text]:
    """All STATUSTEXT, joined from their chunks, each at the place of its last one."""
    assembler, texts = TextAssembler(), []
    rows = zip(stream.places, stream.unix_us, stream.now_ms, stream.payloads(), strict=True)
    for place, unix_us, now_ms, payload in rows:
        whole = assembler.add(decode_text_chunk(payload), unix_us / 1e6)
        texts += [(place, now_ms, text.text) for text in whole]
    return texts
