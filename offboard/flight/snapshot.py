"""Snapshot: what a person or a monitor wants to see of a flight at one moment."""

from __future__ import annotations

import math

from offboard.flight.phases import TRACKING
from offboard.flight.state import FlightState

NAN = float("nan")
TEXTS_KEPT = 8


class Snapshot:
    """For displays outside the loop (terminal, live page, metrics): values only, safe to pass to
    another thread. SI, NED, vehicle time; NaN or None for what is not known yet. The attributes are
    the fields of the JSON objects.

    `other_datagrams`: of other senders, since the start. `flights`: that the service has begun.
    """

    def __init__(self, state: FlightState, other_datagrams: int, flights: int = 0) -> None:
        vehicle, command, link = state.vehicle, state.command, state.clock.delay
        position, attitude = vehicle.position, vehicle.attitude
        sample = (
            state.plan.sample(position.time_s) if position and state.phase in TRACKING else None
        )
        charge = vehicle.health.battery_remaining if vehicle.health else None
        age_s = state.telemetry_age_s(state.host_s) if vehicle.has_state else NAN
        self.time_s = state.time_s  # of the newest telemetry
        self.phase = state.phase.value
        self.in_phase_s = state.in_phase_s
        self.track_time_s = state.track_time_s  # since the start of the track
        self.mode = vehicle.mode  # that the vehicle shows
        self.armed = vehicle.armed
        # a name of `authority.Standing` in lower case; "unknown" before the first mode
        self.authority = state.authority.standing.name.lower() if state.authority else "unknown"
        self.failsafe = state.failsafe.action.name.lower()
        self.failsafe_row = state.failsafe.row  # that the action follows from
        self.position_ned_m = position.position_ned_m if position else None
        self.velocity_ned_mps = position.velocity_ned_mps if position else None
        self.attitude = attitude.attitude if attitude else None  # (w, x, y, z), NED to FRD
        # from the climb to the landing, as is the error
        self.reference_ned_m = sample.position_ned_m.tolist() if sample else None
        self.position_error_m = state.position_error_m if sample else NAN
        self.thrust_mps2 = command.thrust_mps2  # of the command in force, as are the next two
        self.thrust_direction_ned = command.thrust_direction_ned
        self.heading_rad = command.heading_rad
        self.hover_thrust = state.model.hover_thrust  # of the vehicle model in use, 0 to 1
        # beyond the least delay of the link
        self.telemetry_age_s = age_s if math.isfinite(age_s) else NAN
        self.link_delay_s = link.value if link else NAN  # telemetry and setpoint together
        self.link_delay_sd_s = link.sd if link else NAN
        self.link_growth_s = state.clock.growth.added_s  # since take-off
        self.missed_decisions = state.missed  # in a row
        self.skipped_ticks = state.busyness.skipped  # in pauses of this process, since take-off
        self.computer = state.busyness.sentence  # that it is too busy; empty if it keeps up
        self.battery = NAN if charge is None else charge  # remaining, of 1
        self.other_datagrams = other_datagrams
        self.forged = state.session.counters.forged  # frames that signing refused since the start
        self.texts = tuple(state.announced[-TEXTS_KEPT:])  # the newest announcements, oldest first
        self.flights = flights
