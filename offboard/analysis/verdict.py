"""The verdict on a flight, from its log alone: whether it was completed, and what ended it.

A flight is completed if the whole reference was tracked, the vehicle did not come down to the
ground before its landing, nothing ended the flight early, the vehicle landed, and it was disarmed.
A flight that the pilot engaged in the air is also completed if the pilot took the vehicle back
while it hovered at the end of the reference.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from offboard.analysis.columns import parts
from offboard.analysis.history import Event, History
from offboard.flight.estimates import PositionJumps
from offboard.flight.ground_contact import Touchdown
from offboard.flight.phases import RESTS
from offboard.mavlink.event_record import SUPERVISOR
from offboard.mavlink.events import CRITICAL, LocalPosition

Array = NDArray[np.float64]

REFERENCE_OVER = "reference over"
NO_FLIGHT = "no flight of offboard in this log"
_ON_GROUND = 1  # MAV_LANDED_STATE
_LOWEST_M = 0.05  # least height above the takeoff point; references are at least 0.3 m above it


def landing(flown: History) -> tuple[str, float]:
    """Return what is wrong with the landing, and the downward speed at touch-down (m/s, or NaN).

    The text says why the vehicle has not landed, or that it came down to the ground between the
    climb and the landing of a flight with a takeoff. It is empty if nothing is wrong.
    """
    begun, first = begin_times(flown.phases), begin_times(flown.phases[::-1])
    takes_off_s, lands_s = (begun.get(phase, math.inf) for phase in ("takeoff", "land"))
    climbed_s = first.get("join", math.inf)
    jumps, takeoff, touchdown = PositionJumps(), None, None
    from_down_m = lowest_m = math.inf
    for position in _positions(flown):
        jumps.on_position(position)
        place, down_m = jumps.without(position.position_ned_m), position.position_ned_m[2]
        if position.time_s <= takes_off_s:
            takeoff, from_down_m = place, down_m
        elif takeoff and climbed_s <= position.time_s <= lands_s:
            # A jump of the estimate may be an error or a correction: the greater height counts
            lowest_m = min(lowest_m, max(takeoff[2] - place[2], from_down_m - down_m))
        if position.time_s <= lands_s:
            continue
        if touchdown is None:
            touchdown = Touchdown(takeoff if takes_off_s < math.inf else None)
        touchdown.on_position(position.time_s, place, position.velocity_ned_mps[2])
    if touchdown is None:
        return "not landed", math.nan
    if lowest_m < _LOWEST_M:
        return "it came down to the ground before its landing", touchdown.speed_mps
    since = flown.landed[flown.landed["time_s"] >= begun["land"]]
    on_ground = bool(len(since)) and bool(since["state"][-1] == _ON_GROUND)
    return touchdown.not_landed(on_ground=on_ground), touchdown.speed_mps


def _positions(flown: History) -> Iterator[LocalPosition]:
    """Iterate over the positions in the order of time."""
    order = np.argsort(flown.position["time_s"], kind="stable")
    for part in parts(order):
        for time_s, *_, place, velocity in flown.position[part].tolist():
            yield LocalPosition(time_s, tuple(place.tolist()), tuple(velocity.tolist()))


def begin_times(phases: tuple[Event, ...]) -> dict[str, float]:
    """Return the vehicle time at which each phase began; for a repeated phase the last time."""
    return {event.phase: event.time_s for event in phases}


def verdict_metrics(flown: History, skipped_s: float) -> dict[str, Any]:
    """Return these values of a Score. `skipped_s`: time of the reference without decisions.

    completed: 1 or 0, NaN for a log without a flight of `offboard`
    ended_by: a few words
    touchdown_mps: downward speed at touch-down, NaN if the vehicle has not come to rest
    reason: what the flight announced when it left its regular phases, else empty
    """
    names = [event.phase for event in flown.phases]
    if not flown.phases:
        return {"completed": math.nan, "ended_by": NO_FLIGHT}
    why, reason = _ended_early(flown)
    not_landed, touchdown_mps = landing(flown)
    if why == REFERENCE_OVER:
        if skipped_s > 0.0:
            why = f"{skipped_s:.1f} s of the reference were not tracked"
        elif _given_back(names):
            pass
        elif not_landed:
            why = not_landed
        elif not len(flown.heartbeat) or flown.heartbeat["armed"][-1]:
            why = "not disarmed"
    return {
        "completed": float(why == REFERENCE_OVER),
        "ended_by": why,
        "touchdown_mps": touchdown_mps,
        "reason": reason,
    }


def _ended_early(flown: History) -> tuple[str, str]:
    """Return what ended the flight early, and the sentence that announced it. Without an early end,
    return REFERENCE_OVER, or that the log lacks the end of the reference."""
    names = [event.phase for event in flown.phases]
    for event in irregular(flown.phases):
        taken = event.cause == "mode change" and _critical(flown)
        return "failsafe" if taken else event.cause or event.reason, event.reason
    took_over = [event.what for event in flown.announcements if event.cause == SUPERVISOR]
    if took_over:
        return SUPERVISOR, took_over[0]
    if names[-1] not in {"disarmed", "failed", "yielded"}:
        return f"the log ends in the phase {names[-1]}", ""
    return REFERENCE_OVER if "hover" in names else "the log lacks a part of the flight", ""


def irregular(phases: tuple[Event, ...]) -> list[Event]:
    """Return the phases with which a flight was ended early, and those that followed from it."""
    if _given_back([event.phase for event in phases]):
        return []
    early = {"hold", "land", "stand down", "failed", "yielded"}
    return [
        event
        for event in phases
        if event.phase in early and (event.phase, event.reason) != ("land", RESTS)
    ]


def _given_back(names: list[str]) -> bool:
    """Whether the pilot engaged the flight in the air and took the vehicle back, by a mode change
    or after "hand back", while it hovered at the end of the reference."""
    ends = (["hover", "yielded"], ["hover", "hand back", "yielded"])
    return "engage" not in names and any(names[-len(end) :] == end for end in ends)


def _critical(flown: History) -> bool:
    """Whether the newest HEARTBEAT shows a failsafe or an emergency. If a mode change ended the
    flight, the log goes on until the next HEARTBEAT."""
    return bool(len(flown.heartbeat)) and bool(flown.heartbeat["system_status"][-1] >= CRITICAL)
