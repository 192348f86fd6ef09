"""Bands and marks of a flight: phases, modes, steps of the failsafe, texts."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

from offboard.analysis.history import Event
from offboard.analysis.page import BLUE_BAND, GREY_BAND, ORANGE_BAND
from offboard.analysis.verdict import irregular
from offboard.flight.outbox import Refusal
from offboard.flight.phases import Phase
from offboard.mavlink.event_record import SUPERVISOR
from offboard.report.flight import Flight

_ENDED_EARLY = {"hold", "stand down", "yielded", "failed", SUPERVISOR}


@dataclass(frozen=True, slots=True)
class Entry:
    """A band from `begin_s` to `end_s` with a label, or a mark at `begin_s`; `text` in full."""

    row: str
    begin_s: float
    text: str
    end_s: float = math.nan
    label: str = ""
    colour: str = ""


def bands(flight: Flight) -> list[Entry]:
    """Phases of offboard, and modes of the vehicle; the mode of its setpoints is blue."""
    found = [
        Entry("phase", begin_s, event.what, end_s, event.phase, _colour(event.phase))
        for event, begin_s, end_s in phases(flight)
    ]
    dialect = flight.history.dialect
    for event, begin_s, end_s in spans(flight.history.modes, flight):
        colour = BLUE_BAND if dialect and event.what == dialect.engage_mode else GREY_BAND
        text = f"mode {event.what}"
        found.append(Entry("mode", begin_s, text, end_s, event.what, colour))
    return found


def marks(flight: Flight) -> list[Entry]:
    """Steps of the failsafe, and texts of both sides."""
    flown = flight.history
    found = [Entry("failsafe", event.time_s, event.what) for event in irregular(flown.phases)]
    refused = flown.records["refused"].astype(int)
    for row in refused.nonzero()[0].tolist():
        why = ", ".join(
            flag.name.lower().replace("_", " ") for flag in Refusal(int(refused[row])) if flag.name
        )
        found.append(
            Entry("failsafe", float(flown.records["time_s"][row]), f"setpoint not sent: {why}")
        )
    texts = (*flown.announcements, *flown.vehicle_messages)
    found += [Entry("texts", event.time_s, f"{event.who}: {event.what}") for event in texts]
    return [mark for mark in found if math.isfinite(mark.begin_s)]


def phases(flight: Flight) -> list[tuple[Event, float, float]]:
    """The spans of the phases of offboard; the last one ends where the supervisor takes over."""
    said = [event for event in flight.history.announcements if event.cause == SUPERVISOR]
    took_over = [replace(event, phase=SUPERVISOR) for event in said[:1]]
    return spans([*flight.history.phases, *took_over], flight)


def spans(events: Sequence[Event], flight: Flight) -> list[tuple[Event, float, float]]:
    """Each event until the next one; the first may be older than telemetry."""
    begins = [flight.begin_s if math.isnan(e.time_s) else e.time_s for e in events]
    ends = [*begins[1:], flight.end_s]
    rows = zip(events, begins, ends, strict=False)  # without events there is an end too many
    return [(event, begin_s, max(end_s, begin_s)) for event, begin_s, end_s in rows]


def _colour(phase: str) -> str:
    if phase == Phase.TRACK.value:
        return BLUE_BAND
    return ORANGE_BAND if phase in _ENDED_EARLY else GREY_BAND
