"""What a row of the phase table and of the failsafe is made of, and the conditions of both.

Conditions and reasons are functions of the flight. They change nothing.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

from offboard.flight.authority import Standing
from offboard.flight.phases import Phase
from offboard.flight.state import FlightState
from offboard.mavlink.events import OtherSender

Condition = Callable[[FlightState], bool]
Reason = str | Callable[[FlightState], str]

REBOOTED = "the vehicle restarted"
STOP = "{flight.stop_reason}"
SHOWS = "the vehicle shows {flight.vehicle.mode}"
OTHER_SENDER_S = 5.0  # a second sender is there for so long after its newest frame


@dataclass(frozen=True, slots=True)
class Transition:
    """A row of the phase table: from each of `phases`, when `condition` holds, to `target`.

    `exit_code` is set if this row decides the result; a later row can only make it more severe.
    """

    phases: tuple[Phase, ...]
    condition: Condition
    target: Phase
    reason: Reason
    exit_code: int | None = None


def why(reason: Reason, flight: FlightState) -> str:
    """The reason as a sentence: a function of the flight, or a text with its values in braces."""
    return reason.format(flight=flight) if isinstance(reason, str) else reason(flight)


# ---------------------------------------------------------------------- what is heard


def silent(flight: FlightState) -> bool:
    return flight.silence_s > flight.limits.silence_s


def no_telemetry(flight: FlightState) -> str:
    return f"no telemetry for {flight.silence_s:.1f} s"


def blind(flight: FlightState) -> bool:
    return _blind_s(flight) > flight.limits.blind_s


def no_position_or_attitude(flight: FlightState) -> str:
    vehicle = flight.vehicle
    older = vehicle.position_age_s >= vehicle.attitude_age_s
    name = "LOCAL_POSITION_NED" if older else "ATTITUDE_QUATERNION"
    return f"no {name} for {_blind_s(flight):.1f} s"


def _blind_s(flight: FlightState) -> float:
    """Age of the older of position and attitude, vehicle time."""
    return max(flight.vehicle.position_age_s, flight.vehicle.attitude_age_s)


def mode_unknown(flight: FlightState) -> bool:
    return flight.authority is None or not flight.authority.heard(flight.now_s)


def no_mode_report(flight: FlightState) -> str:
    heard_s = flight.authority.heard_s if flight.authority else -math.inf
    return f"no report of the mode for {flight.now_s - heard_s:.1f} s"


def other_sender(flight: FlightState) -> bool:
    """Another program controls the vehicle on this link, and that counts: it sends setpoints or
    mode commands, or says so."""
    heard = flight.vehicle.age_s(OtherSender) < OTHER_SENDER_S
    return heard and not flight.limits.begin_with_other_sender


def other_sender_name(flight: FlightState) -> str:
    other = flight.vehicle.other_sender
    return f"system {other.system_id} component {other.component_id}" if other else ""


# ---------------------------------------------------------------------- who has the vehicle


def rebooted(flight: FlightState) -> bool:
    return flight.rebooted


def engaged_in_the_air(flight: FlightState) -> bool:
    return flight.engaged and flight.contact.in_the_air


def lost(flight: FlightState) -> bool:
    """The vehicle is not ours any more."""
    return stands(flight, Standing.LOST)


def why_lost(flight: FlightState) -> str:
    return flight.authority.lost_reason if flight.authority else ""


def lost_armed(flight: FlightState) -> bool:
    """A pilot has changed the mode of a vehicle that stays armed."""
    return lost(flight) and flight.shown_since_lost and flight.vehicle.armed


def lost_disarmed(flight: FlightState) -> bool:
    return lost(flight) and flight.shown_since_lost and not flight.vehicle.armed


def stands(flight: FlightState, standing: Standing) -> bool:
    return flight.authority is not None and flight.authority.standing is standing


def stop_requested(flight: FlightState) -> bool:
    return bool(flight.stop_reason)


def longer_than(limit: str) -> Condition:
    """Holds once the phase has lasted longer than the limit of this name."""

    def too_long(flight: FlightState) -> bool:
        return flight.in_phase_s > float(getattr(flight.limits, limit))

    too_long.__name__ = f"longer_than_{limit}"
    return too_long
