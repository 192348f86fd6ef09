"""Snapshot: what a person or a monitor wants to see of a flight at one moment.

For displays outside the loop (terminal, live page, metrics): values only, safe to pass to another
thread. `Flight.snapshot` makes one.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from offboard.flight.phases import TRACKING
from offboard.flight.state import FlightState, Triple

NAN = float("nan")
TEXTS_KEPT = 8


@dataclass(frozen=True, slots=True)
class Snapshot:
    """SI, NED, vehicle time; NaN or None for what is not known yet."""

    time_s: float  # of the newest telemetry
    phase: str
    in_phase_s: float
    track_time_s: float  # since the start of the track
    mode: str  # that the vehicle shows
    armed: bool
    authority: str  # a name of `authority.Standing` in lower case; "unknown" before the first mode
    rung: str  # action of the failsafe, in lower case
    rung_reason: str  # the row that it follows from
    position_ned_m: Triple | None
    velocity_ned_mps: Triple | None
    attitude: tuple[float, float, float, float] | None  # quaternion (w, x, y, z), NED to FRD
    reference_ned_m: Triple | None  # from the climb to the landing, as is the error
    position_error_m: float
    thrust_mps2: float  # of the command in force, as are direction and course
    thrust_direction_ned: Triple
    course_rad: float
    hover_thrust: float  # of the vehicle model in use, 0 to 1
    telemetry_age_s: float  # beyond the least delay of the link
    link_delay_s: float  # telemetry and setpoint together
    link_delay_sd_s: float
    link_growth_s: float  # since take-off
    missed_decisions: int  # in a row
    skipped_ticks: int  # in pauses of this process, since take-off
    computer: str  # that it is too busy; empty if it keeps up
    battery: float  # remaining, of 1
    strangers: int  # datagrams of other senders since the start
    forged: int  # frames that signing refused since the start
    texts: tuple[str, ...]  # the newest announcements, oldest first
    flights: int = 0  # that the service has begun


def snapshot_of(state: FlightState, strangers: int) -> Snapshot:
    """The snapshot of this moment. Changes nothing."""
    command = state.command
    vehicle = state.vehicle
    position, attitude = vehicle.position, vehicle.attitude
    sample = state.plan.sample(position.time_s) if position and state.phase in TRACKING else None
    link = state.clock.delay
    charge = vehicle.health.battery_remaining if vehicle.health else None
    return Snapshot(
        time_s=state.time_s,
        phase=state.phase.value,
        in_phase_s=state.in_phase_s,
        track_time_s=state.track_time_s,
        mode=vehicle.mode,
        armed=vehicle.armed,
        authority=state.authority.standing.name.lower() if state.authority else "unknown",
        rung=state.failsafe.action.name.lower(),
        rung_reason=state.failsafe.row,
        position_ned_m=position.position_ned_m if position else None,
        velocity_ned_mps=position.velocity_ned_mps if position else None,
        attitude=attitude.attitude if attitude else None,
        reference_ned_m=_triple(sample.position_ned_m) if sample else None,
        position_error_m=state.position_error_m if sample else NAN,
        thrust_mps2=command.thrust_mps2,
        thrust_direction_ned=command.thrust_direction_ned,
        course_rad=command.course_rad,
        hover_thrust=state.model.hover_thrust,
        telemetry_age_s=_finite(state.telemetry_age_s(state.host_s)) if vehicle.has_state else NAN,
        link_delay_s=link.value if link else NAN,
        link_delay_sd_s=link.sd if link else NAN,
        link_growth_s=state.clock.growth.added_s,
        missed_decisions=state.missed,
        skipped_ticks=state.busyness.skipped,
        computer=state.busyness.sentence,
        battery=NAN if charge is None else charge,
        strangers=strangers,
        forged=state.session.counters.forged,
        texts=tuple(state.announced[-TEXTS_KEPT:]),
    )


def _triple(values: NDArray[np.float64]) -> Triple:
    north, east, down = values.tolist()
    return north, east, down


def _finite(value: float) -> float:
    return value if math.isfinite(value) else NAN
