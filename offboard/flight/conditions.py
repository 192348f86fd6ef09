"""What a row of the phase table is, and the conditions that several tables share."""

from __future__ import annotations

from collections.abc import Callable, Set
from dataclasses import dataclass

from offboard.flight.authority import Standing
from offboard.flight.phases import Phase
from offboard.flight.state import FlightState

OPERATOR = "{flight.stop_cause}"  # the cause of a row for `stop_requested`
REBOOTED = "the vehicle restarted"
# Relative error of hover_thrust; a smaller one does not keep a vehicle from reaching the start
WRONG_THRUST = 0.1
# A function that reads the flight and changes nothing. It returns False or an empty text while it
# does not hold, and True or a text that says why while it does
Condition = Callable[[FlightState], str | bool]


@dataclass(frozen=True, slots=True)
class Transition:
    """A row of the phase table: if `condition` holds in one of `phases`, `target` is entered.

    `exit_code` is set if this row decides the result; a later row can only make it more severe.
    `cause` is a word for what ended the flight, if the row ends it (`ended_by` of the score).
    `reason` is the sentence that says why; if it is empty, the text of the condition says it. Both
    texts may contain values of the flight in braces.
    """

    phases: Set[Phase]
    condition: Condition
    target: Phase
    exit_code: int | None = None
    cause: str = ""
    reason: str = ""

    def why(self, flight: FlightState) -> str:
        """The sentence that says why the row is taken, while its condition holds."""
        return self.reason.format(flight=flight) or str(self.condition(flight))


def wrong_thrust(flight: FlightState) -> str:
    """The end of a sentence about a climb: hover_thrust is wrong; empty if it is not."""
    shown, flown = flight.observer.hover_thrust_estimate, flight.model.hover_thrust
    if not abs(shown / flown - 1.0) > WRONG_THRUST:
        return ""
    return (
        f"; flown with hover thrust {flown:.2f}, it is about {shown:.2f}: set vehicle.hover_thrust"
    )


# ---------------------------------------------------------------------- what is heard


def silent(flight: FlightState) -> str:
    """Time since the newest position or attitude arrived, by the clock of this computer."""
    return silent_for(flight, flight.limits.silence_s)


def silent_for(flight: FlightState, limit_s: float) -> str:
    return f"no telemetry for {flight.silence_s:.1f} s" if flight.silence_s > limit_s else ""


def blind(flight: FlightState) -> str:
    """Age of the older of position and attitude, by vehicle time."""
    vehicle = flight.vehicle
    age_s, name = max(
        (vehicle.position_age_s, "LOCAL_POSITION_NED"),
        (vehicle.attitude_age_s, "ATTITUDE_QUATERNION"),
        key=lambda each: each[0],
    )
    return f"no new {name} for {age_s:.1f} s" if age_s > flight.limits.blind_s else ""


def mode_unknown(flight: FlightState) -> str:
    unheard_s = flight.authority.unheard_s(flight.now_s)
    return f"no report of the mode for {unheard_s:.1f} s" if unheard_s else ""


# ---------------------------------------------------------------------- who has the vehicle


def rebooted(flight: FlightState) -> str:
    return REBOOTED if flight.rebooted else ""


def authority_lost(flight: FlightState) -> str:
    """A pilot, a ground station or a failsafe has taken control of the vehicle."""
    return flight.authority.lost_reason


def authority_lost_armed(flight: FlightState) -> str:
    """Someone else has changed the mode, and a HEARTBEAT since then shows the vehicle armed."""
    return authority_lost(flight) if flight.shown_since_lost and flight.vehicle.armed else ""


def in_own_failsafe(flight: FlightState) -> str:
    """The vehicle received no setpoints, and the autopilot's failsafe flies it."""
    if flight.authority.standing is not Standing.FAILSAFE:
        return ""
    mode = flight.vehicle.mode
    return f"setpoints did not arrive, and the vehicle's own failsafe flies it, in {mode}"


def stop_requested(flight: FlightState) -> str:
    return flight.stop_reason


def longer_than(limit: str, says: Condition = lambda flight: True) -> Condition:
    """Make a condition that holds once the phase has lasted longer than the field `limit` of
    `Limits` and `says`, which returns the reason, holds too."""

    def too_long(flight: FlightState) -> str | bool:
        return flight.in_phase_s > getattr(flight.limits, limit) and says(flight)

    too_long.__name__ = f"longer_than_{limit}"
    return too_long
