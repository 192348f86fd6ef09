"""The phase table in the air: from lift-off to the disarmed vehicle."""

from __future__ import annotations

import numpy as np

from offboard.flight.authority import Standing
from offboard.flight.ground_contact import STILL_ARMED
from offboard.flight.phases import OUTAGE_MAX_S, TRACKING, Action, ExitCode, Phase, Request
from offboard.flight.rows import (
    REBOOTED,
    Condition,
    Transition,
    in_own_failsafe,
    longer_than,
    lost,
    lost_armed,
    mode_unknown,
    rebooted,
    stands,
    stop_requested,
)
from offboard.flight.state import FlightState

TAKE_OVER_HEIGHT_M = 1.0  # where setpoints replace the autopilot's own take-off
DISARMED_S = 1.5  # longer than a period of HEARTBEAT
DETECTOR_S = 1.0  # EXTENDED_SYS_STATE is requested at 5 Hz
REST_S = 0.5  # after the end of the reference


def lifted_off(flight: FlightState) -> bool:
    if flight.takes_off_by_command:
        return flight.contact.height_m > TAKE_OVER_HEIGHT_M
    return flight.contact.lifted_off


def at_start(flight: FlightState) -> bool:
    """The vehicle hovers at the start of the reference."""
    position, time_s = flight.vehicle.position, flight.time_s
    if position is None or not flight.plan.late_s(time_s) >= 0.0:
        return False
    velocity_ned_mps = flight.observer.predict(time_s).velocity_ned_mps
    return flight.plan.at_start(time_s, np.array(position.position_ned_m), velocity_ned_mps)


def at_start_to_excite(flight: FlightState) -> bool:
    identification = flight.identification
    wanted = identification is not None and identification.wants_excitation
    return wanted and at_start(flight)


def too_late_at_start(flight: FlightState) -> str:
    if not flight.plan.late_s(flight.time_s) > flight.limits.late_s:
        return ""
    return (
        f"the start of the reference was not reached: {flight.position_error_m:.1f} m away, "
        f"{flight.plan.late_s(flight.time_s):.0f} s late; is hover_thrust in the vehicle file "
        "right, and is the vehicle fast enough for controller.bandwidth_radps?"
    )


def identified(flight: FlightState) -> bool:
    return flight.identification is not None and flight.identification.finished(flight.time_s)


def at_full_speed(flight: FlightState) -> bool:
    return flight.track_time_s >= flight.plan.track.track_start_s


def track_over(flight: FlightState) -> bool:
    return flight.track_time_s >= flight.plan.track.track_end_s


def at_rest(flight: FlightState) -> bool:
    return flight.track_time_s >= flight.plan.track.duration_s + REST_S


def rebooted_in_flight(flight: FlightState) -> str:
    return f"{REBOOTED} {_when(flight)}" if rebooted(flight) else ""


def disarmed(flight: FlightState) -> str:
    """One HEARTBEAT may be wrong: the land detector shows it too, or a second HEARTBEAT."""
    flies = flight.contact.detects_flight or flight.phase is Phase.TAKEOFF
    if flight.vehicle.armed or (flies and flight.vehicle.disarmed_s < DISARMED_S):
        return ""
    return f"the vehicle disarmed {_when(flight)}"


def _when(flight: FlightState) -> str:
    return "before lift-off" if flight.phase is Phase.TAKEOFF else "in flight"


def handed(flight: FlightState) -> str:
    """It shows a mode that we asked for at the end."""
    return f"the vehicle shows {flight.vehicle.mode}" if stands(flight, Standing.HANDED) else ""


def failsafe_land(flight: FlightState) -> bool:
    return flight.failsafe.action is Action.LAND


def failsafe_hold(flight: FlightState) -> bool:
    return flight.failsafe.action is Action.HOLD


def landed(flight: FlightState) -> bool:
    return not flight.vehicle.armed and not flight.not_landed()


def rebooted_disarmed(flight: FlightState) -> bool:
    return flight.rebooted and not flight.vehicle.armed and bool(flight.not_landed())


def disarmed_elsewhere(flight: FlightState) -> str:
    """Disarmed, but not landed; the land detector has had time to report, and the vehicle was asked
    to land, as HEARTBEAT may be wrong."""
    known = flight.vehicle.disarmed_s > DISARMED_S + DETECTOR_S
    missing = flight.not_landed() if known else ""
    return f"disarmed, landing not confirmed: {missing}" if missing else ""


def unheard_on_ground(flight: FlightState) -> bool:
    """It has landed, and no HEARTBEAT shows whether it is armed."""
    return bool(mode_unknown(flight)) and not flight.not_landed()


def out_of_reach(flight: FlightState) -> str:
    if flight.unreached_s <= OUTAGE_MAX_S:
        return ""
    vehicle, height_m = flight.vehicle, flight.from_takeoff_m[2]
    return (
        f"not heard for {flight.unreached_s:.0f} s while landing; last known: "
        f"{'armed' if vehicle.armed else 'disarmed'} in {vehicle.mode}, "
        f"{height_m:.1f} m above the take-off point"
    )


def not_disarmed(flight: FlightState) -> str:
    if flight.in_phase_s <= flight.limits.land_s:
        return ""
    contact = flight.contact
    shows = contact.stands and contact.detects_flight and flight.vehicle.armed
    return f"not landed and disarmed after {flight.in_phase_s:.0f} s" + (
        f"; {STILL_ARMED}" if shows else ""
    )


def requested(request: Request) -> Condition:
    """Holds when the ground station has asked for this."""

    def wanted(flight: FlightState) -> bool:
        return flight.request is request

    wanted.__name__ = f"requested_{request.name.lower()}"
    return wanted


# ---------------------------------------------------------------------- rows

REFUSED, ABORTED, FLOWN = ExitCode.REFUSED, ExitCode.ABORTED, ExitCode.FLOWN
OPERATOR = "{flight.stop_cause}"
FAILSAFE = ("{flight.failsafe.cause}", "{flight.failsafe.reason}")
ON_REFERENCE = tuple(phase for phase in Phase if phase in TRACKING)
CLIMB, EXCITE, LAND = (Phase.CLIMB,), (Phase.EXCITE,), (Phase.LAND,)
AT_START = "hovers at the start of the reference"


def ends_early(phases: tuple[Phase, ...], serves: bool) -> tuple[Transition, ...]:
    """What ends `phases` in the air early. In the service a stop hands back where `fly` lands, and
    a pilot who takes the vehicle is the usual end."""
    followed = ON_REFERENCE if serves else ()
    others = tuple(phase for phase in phases if phase not in followed)
    stopped = tuple(phase for phase in others if phase is not Phase.HAND_BACK)
    held = tuple(phase for phase in phases if phase not in (Phase.HAND_BACK, Phase.HOLD))
    rows = (
        Transition(phases, rebooted_in_flight, Phase.LAND, ABORTED, "restart"),
        # HEARTBEAT may be wrong: what still flies is to land
        Transition(phases, disarmed, Phase.LAND, ABORTED, "disarmed in flight"),
        Transition(followed, lost, Phase.YIELDED, FLOWN, "pilot"),
        Transition(others, lost, Phase.YIELDED, ABORTED, "pilot"),
        Transition(phases, in_own_failsafe, Phase.LAND, ABORTED, "link"),
        Transition(phases, failsafe_land, Phase.LAND, ABORTED, *FAILSAFE),
        Transition(followed, stop_requested, Phase.HAND_BACK, FLOWN, OPERATOR),
        Transition(stopped, stop_requested, Phase.LAND, ABORTED, OPERATOR),
        Transition(held, failsafe_hold, Phase.HOLD, ABORTED, *FAILSAFE),
    )
    return tuple(row for row in rows if row.phases)


TO_THE_END = (
    Transition((Phase.TAKEOFF,), lifted_off, Phase.CLIMB, reason="lifted off"),
    Transition(
        (Phase.TAKEOFF,),
        longer_than("lift_off_s"),
        Phase.LAND,
        ABORTED,
        reason="no lift-off in {flight.in_phase_s:.0f} s; "
        "is hover_thrust in the vehicle file right?",
    ),
    Transition(CLIMB, at_start_to_excite, Phase.EXCITE, reason="identification steps"),
    Transition(CLIMB, at_start, Phase.JOIN, reason=AT_START),
    Transition(CLIMB, too_late_at_start, Phase.LAND, ABORTED),
    Transition(EXCITE, identified, Phase.JOIN, reason=AT_START),
    Transition(
        EXCITE,
        longer_than("excite_s"),
        Phase.LAND,
        ABORTED,
        reason="identification did not converge in {flight.in_phase_s:.0f} s",
    ),
    Transition((Phase.JOIN,), at_full_speed, Phase.TRACK, reason="on the reference at full speed"),
    Transition((Phase.TRACK,), track_over, Phase.HOVER, reason="the reference was flown"),
    Transition(
        (Phase.HOLD,),
        longer_than("hold_s"),
        Phase.LAND,
        ABORTED,
        reason="the autopilot held for {flight.in_phase_s:.0f} s",
    ),
    Transition(LAND, landed, Phase.DISARMED, reason="disarmed on the ground"),
    Transition(
        LAND, rebooted_disarmed, Phase.FAILED, ABORTED, "restart", f"{REBOOTED} and is disarmed"
    ),
    Transition(LAND, disarmed_elsewhere, Phase.FAILED, ABORTED),
    Transition(LAND, lost_armed, Phase.YIELDED, ABORTED, "pilot"),
    Transition(
        LAND,
        unheard_on_ground,
        Phase.FAILED,
        ABORTED,
        reason="it stands on the ground, and no HEARTBEAT shows whether it is disarmed",
    ),
    Transition(LAND, out_of_reach, Phase.FAILED, ABORTED),
    Transition(LAND, not_disarmed, Phase.FAILED, ABORTED),
)
SERVICE_ENDS = (
    Transition(
        (Phase.HAND_BACK,),
        longer_than("hand_back_s"),
        Phase.LAND,
        ABORTED,
        reason="the vehicle did not hold in {flight.in_phase_s:.0f} s",
    ),
    Transition(
        (Phase.TAKEOFF, *ON_REFERENCE),
        requested(Request.HAND_BACK),
        Phase.HAND_BACK,
        FLOWN,
        reason="handed back on request",
    ),
    Transition(
        (Phase.STREAM, Phase.ENGAGE),
        requested(Request.HAND_BACK),
        Phase.FAILED,
        FLOWN,
        reason="stopped on request",
    ),
    Transition(
        (Phase.ARM,),
        requested(Request.HAND_BACK),
        Phase.STAND_DOWN,
        FLOWN,
        reason="stopped on request",
    ),
    Transition(
        (Phase.EXCITE, Phase.JOIN, Phase.TRACK, Phase.PAUSE, Phase.HOVER),
        requested(Request.START),
        Phase.CLIMB,
        reason="start requested",
    ),
    Transition(
        (Phase.JOIN, Phase.TRACK),
        requested(Request.PAUSE),
        Phase.PAUSE,
        reason="pause requested",
    ),
    Transition(
        (Phase.PAUSE,), requested(Request.CONTINUE), Phase.TRACK, reason="continue requested"
    ),
)
AT_REST = {
    "hold": (),
    "land": (Transition((Phase.HOVER,), at_rest, Phase.LAND, reason="at rest"),),
    "repeat": (Transition((Phase.HOVER,), at_rest, Phase.CLIMB, reason="once more"),),
}
