"""Events of a flight in vehicle time: those of `offboard`, by their records in the log; modes and
texts of the vehicle."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from offboard.analysis.samples import continuous_s
from offboard.analysis.tlog import LoggedMessage
from offboard.flight.phases import PHASE_CODES
from offboard.mavlink import event_record
from offboard.mavlink.texts import TextAssembler

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


class Texts:
    """Texts of one sender, in the order of the log."""

    def __init__(self, who: str) -> None:
        self._who = who
        self._assembler = TextAssembler()
        self._texts: list[tuple[float, str]] = []

    def add(self, text: str, now_ms: float) -> None:
        """A text; `now_ms` is the stamp of the telemetry before it."""
        self._texts.append((now_ms, text))

    def add_chunk(self, entry: LoggedMessage, now_ms: float) -> None:
        """A STATUSTEXT; a text in chunks is whole with its last one."""
        whole = self._assembler.add(entry.frame.payload, entry.unix_us / 1e6)
        self._texts += [(now_ms, text.text) for text in whole]

    def events(self, anchor_ms: float) -> tuple[Event, ...]:
        """All of them; `anchor_ms` as in `continuous_s`."""
        return tuple(
            Event(float(continuous_s(now_ms, anchor_ms)), self._who, text)
            for now_ms, text in self._texts
        )


def ours(
    records: Sequence[tuple[float, bytes]], texts: Texts, anchor_ms: float
) -> tuple[Event, ...]:
    """Our events, from their records (stamp of the telemetry before it, payload). A log without
    them is an older one: its phases are in our texts, without a word for the cause."""
    if not records:
        return tuple(map(_announced, texts.events(anchor_ms)))
    return tuple(
        Event(
            float(continuous_s(records[row][0], anchor_ms)),
            "offboard",
            event.text,
            _PHASES.get(event.phase, ""),
            event.cause,
        )
        for row, event in event_record.join(payload for _, payload in records)
    )


def _announced(text: Event) -> Event:
    what = text.what.removeprefix(_TITLE)
    return text if what == text.what else replace(text, what=what, phase=what.partition(":")[0])
