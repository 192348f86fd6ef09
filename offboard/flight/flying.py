"""The phase table in the air: from lift-off to the disarmed vehicle."""

from __future__ import annotations

import numpy as np

from offboard.control.base import Adaptive
from offboard.flight.authority import Standing
from offboard.flight.conditions import (
    OPERATOR,
    REBOOTED,
    Condition,
    Transition,
    authority_lost,
    authority_lost_armed,
    in_own_failsafe,
    longer_than,
    mode_unknown,
    rebooted,
    stop_requested,
    wrong_thrust,
)
from offboard.flight.ground_contact import STILL_ARMED
from offboard.flight.phases import (
    FLYING,
    MOVING,
    OUTAGE_MAX_S,
    RESTS,
    SERVICE_ONLY,
    TRACKING,
    Action,
    ExitCode,
    Phase,
    Request,
)
from offboard.flight.state import FlightState
from offboard.flight.vehicle_state import ARMED_KNOWN_S, DISARMED_S
from offboard.mavlink.events import GOOD_RESULTS, Heartbeat

TAKE_OVER_HEIGHT_M = 1.0  # height at which setpoints replace the autopilot's own takeoff
DETECTOR_S = 1.0  # time for the land detector to report: EXTENDED_SYS_STATE is requested at 5 Hz
# Time after the planned end of the climb, when the vehicle is identified though it is not at rest
RESTLESS_S = 5.0
SETTLED_DISTANCE_M, SETTLED_SPEED_MPS = 0.3, 0.3  # below both, it hovers at the start
NEAR_M = 0.6  # below this distance, it is near the start
REST_S = 0.5  # after the end of the reference
RUN_UP_S = 60.0  # until a helicopter's rotor is up to speed (ArduCopter: H_RSC_RUNUP_TIME, 0 .. 60)


def lifted_off(flight: FlightState) -> bool:
    if flight.takes_off_by_command:
        return flight.contact.height_m > TAKE_OVER_HEIGHT_M
    return flight.contact.lifted_off


def at_start(flight: FlightState) -> bool:
    """Whether the planned climb is over and the vehicle hovers at its end."""
    near = flight.position_error_m < SETTLED_DISTANCE_M
    if not (near and flight.plan.overdue_s(flight.time_s) >= 0.0):
        return False
    speed_mps = np.linalg.norm(flight.observer.predict(flight.time_s).velocity_ned_mps)
    return bool(speed_mps < SETTLED_SPEED_MPS)


def at_start_to_excite(flight: FlightState) -> bool:
    identification = flight.identification
    wanted = identification is not None and identification.wants_excitation
    return wanted and at_start(flight)


def restless(flight: FlightState) -> str:
    """The vehicle did not come to rest at the start in time. It is identified all the same, because
    its oscillation shows the response, too."""
    identification, overdue_s = flight.identification, flight.plan.overdue_s(flight.time_s)
    wanted = identification is not None and identification.wants_excitation
    if not (wanted and overdue_s > RESTLESS_S):
        return ""
    return f"not at rest at the start in {overdue_s:.0f} s: the vehicle is identified in motion"


def too_late_at_start(flight: FlightState) -> str:
    if not flight.plan.overdue_s(flight.time_s) > flight.limits.overdue_s:
        return ""
    sentence = (
        f"not at rest at the start of the reference: {flight.position_error_m:.1f} m away, "
        f"{flight.plan.overdue_s(flight.time_s):.0f} s late"
    )
    if wrong := wrong_thrust(flight):
        return sentence + wrong
    if isinstance(flight.controller, Adaptive):
        return f"{sentence}; is the vehicle fast enough for controller.bandwidth_radps?"
    return sentence


def no_lift_off(flight: FlightState) -> str:
    after = f"no lift-off in {flight.in_phase_s:.0f} s"
    if flight.model.airframe == "helicopter":
        up = flight.in_phase_s <= RUN_UP_S
        return "" if up else f"{after}; is its rotor up to speed (motor interlock)?"
    if flight.dialect is None or not flight.takes_off_by_command:
        return f"{after}; is hover_thrust in the vehicle file right?"
    return (
        f"{after} by the autopilot's own takeoff; does full thrust carry the vehicle, and is "
        f"{flight.dialect.hover_parameter} right?"
    )


def identified(flight: FlightState) -> bool:
    """Whether the identification has finished and the vehicle is near the start; if its delay is
    still not known, it must hover there."""
    identification = flight.identification
    if identification is None or not identification.finished(flight.time_s):
        return False
    near = flight.position_error_m < NEAR_M
    return (near and identification.delay.known) or at_start(flight)


def not_identified(flight: FlightState) -> str:
    identification, in_phase_s = flight.identification, flight.in_phase_s
    finished = identification is not None and identification.finished(flight.time_s)
    if finished or in_phase_s <= flight.limits.excite_s:
        return ""
    return f"identification did not converge in {in_phase_s:.0f} s"


def at_full_speed(flight: FlightState) -> bool:
    return flight.track_time_s >= flight.plan.track.track_start_s


def track_over(flight: FlightState) -> bool:
    return flight.track_time_s >= flight.plan.track.track_end_s


def at_rest(flight: FlightState) -> bool:
    return flight.track_time_s >= flight.plan.track.duration_s + REST_S


def rebooted_in_flight(flight: FlightState) -> str:
    return f"{REBOOTED} {_when(flight)}" if rebooted(flight) else ""


def disarmed(flight: FlightState) -> str:
    """HEARTBEAT shows the vehicle disarmed. A single HEARTBEAT may be wrong: in TAKEOFF, and while
    the land detector reports flight, a second one must confirm it."""
    flies = flight.contact.detects_flight or flight.phase is Phase.TAKEOFF
    if flight.vehicle.armed or (flies and flight.vehicle.disarmed_s < DISARMED_S):
        return ""
    return f"the vehicle disarmed {_when(flight)}"


def _when(flight: FlightState) -> str:
    return "before lift-off" if flight.phase is Phase.TAKEOFF else "in flight"


def in_requested_mode(flight: FlightState) -> str:
    """The vehicle shows the mode that we requested as the end of the flight."""
    shown = flight.authority.standing is Standing.HANDED
    return f"the vehicle shows {flight.vehicle.mode}" if shown else ""


def failsafe_land(flight: FlightState) -> bool:
    return flight.failsafe.action is Action.LAND


def failsafe_hold(flight: FlightState) -> bool:
    return flight.failsafe.action is Action.HOLD


def hold_refused(flight: FlightState) -> str:
    """The autopilot cannot hold: PX4 without a global position, as by motion capture, does not."""
    hold = flight.known_dialect.set_mode(flight.holds_in)
    result = flight.vehicle.results.get(hold.command, "ACCEPTED")
    if hold not in flight.requested_s or result in GOOD_RESULTS:
        return ""
    return f"the vehicle refuses {flight.holds_in} ({result})"


def refused_to_pilot(flight: FlightState) -> str:
    """The autopilot cannot hold a vehicle that was not flown: its pilot flies on by sticks, in the
    mode in which he did."""
    refused, before = hold_refused(flight), flight.authority.engaged_from
    flown = flight.outcome is None or flight.outcome.exit_code != REFUSED
    assisted = flight.known_dialect.assisted_modes
    if not refused or flown or before not in assisted or flight.returns_to:
        return ""
    return f"{refused}: back to {before}"


def landed(flight: FlightState) -> bool:
    return not flight.vehicle.armed and not flight.not_landed()


def rebooted_disarmed(flight: FlightState) -> bool:
    return flight.rebooted and not flight.vehicle.armed and bool(flight.not_landed())


def disarmed_not_landed(flight: FlightState) -> str:
    """The vehicle is disarmed but has not landed. The wait leaves time for the land detector to
    report and, in case HEARTBEAT is wrong, for a request to land."""
    known = flight.vehicle.disarmed_s > DISARMED_S + DETECTOR_S
    missing = flight.not_landed() if known else ""
    return f"disarmed, landing not confirmed: {missing}" if missing else ""


def unheard_on_ground(flight: FlightState) -> bool:
    """Whether the vehicle has landed, and no HEARTBEAT shows whether it is armed."""
    return bool(mode_unknown(flight)) and not flight.not_landed()


def out_of_reach(flight: FlightState) -> str:
    if flight.unreached_s <= OUTAGE_MAX_S:
        return ""
    vehicle, height_m = flight.vehicle, flight.from_takeoff_m[2]
    return (
        f"not heard for {flight.unreached_s:.0f} s while landing; last known: "
        f"{'armed' if vehicle.armed else 'disarmed'} in {vehicle.mode}, "
        f"{height_m:.1f} m above the takeoff point"
    )


def not_disarmed(flight: FlightState) -> str:
    contact = flight.contact
    if flight.vehicle.age_s(Heartbeat) > ARMED_KNOWN_S and not flight.not_landed():
        return UNHEARD
    shows = contact.stands and contact.detects_flight and flight.vehicle.armed
    return f"not landed and disarmed after {flight.in_phase_s:.0f} s" + (
        f"; {STILL_ARMED}" if shows else ""
    )


def requested(request: Request) -> Condition:
    """Make the condition that the ground station has sent this request."""

    def wanted(flight: FlightState) -> bool:
        return flight.request is request

    wanted.__name__ = f"requested_{request.name.lower()}"
    return wanted


# ---------------------------------------------------------------------- rows

(CONNECT, HEALTH, STANDBY, STREAM, ENGAGE, ARM, TAKEOFF, CLIMB, EXCITE, JOIN, TRACK, PAUSE, HOVER,
 HAND_BACK, HOLD, STAND_DOWN, LAND, DISARMED, YIELDED, FAILED) = Phase  # fmt: skip
FLOWN, REFUSED, ABORTED = ExitCode.FLOWN, ExitCode.REFUSED, ExitCode.ABORTED
FAILSAFE = "{flight.failsafe.cause}", "{flight.failsafe.reason}"
AT_START = "hovers at the start of the reference"
HELD = "hold was requested {flight.in_phase_s:.0f} s ago"
DID_NOT_HOLD = "the vehicle did not hold in {flight.in_phase_s:.0f} s"
UNHEARD = "it stands on the ground, and no HEARTBEAT shows whether it is disarmed"
RESTARTED = f"{REBOOTED} and is disarmed"


def ends_early(*, serves: bool) -> tuple[Transition, ...]:
    """Return the rows that end a flight in the air early. On a request to stop, `fly` lands and the
    service holds. The usual end of a flight of the service is that the pilot changes the mode."""
    flown = FLYING if serves else FLYING - SERVICE_ONLY
    followed = TRACKING if serves else frozenset[Phase]()
    handed = flown & {HAND_BACK}
    taken = followed | handed
    return (
        Transition(handed, in_requested_mode, YIELDED),
        Transition(flown, rebooted_in_flight, LAND, ABORTED, "restart"),
        # to LAND, because HEARTBEAT may be wrong and the vehicle still fly
        Transition(flown, disarmed, LAND, ABORTED, "disarmed in flight"),
        Transition(taken, authority_lost, YIELDED, FLOWN, "mode change"),
        Transition(flown - taken, authority_lost, YIELDED, ABORTED, "mode change"),
        Transition(flown, in_own_failsafe, LAND, ABORTED, "link"),
        Transition(flown, failsafe_land, LAND, ABORTED, *FAILSAFE),
        Transition(followed, stop_requested, HAND_BACK, FLOWN, OPERATOR),
        Transition(flown - taken, stop_requested, LAND, ABORTED, OPERATOR),
        Transition(flown - {HAND_BACK, HOLD}, failsafe_hold, HOLD, ABORTED, *FAILSAFE),
    )


TO_THE_END = (
    Transition({TAKEOFF}, lifted_off, CLIMB, reason="lifted off"),
    Transition({TAKEOFF}, longer_than("lift_off_s", no_lift_off), LAND, ABORTED),
    Transition({CLIMB}, at_start_to_excite, EXCITE, reason="identification steps"),
    Transition({CLIMB}, at_start, JOIN, reason=AT_START),
    Transition({CLIMB}, restless, EXCITE),
    Transition({CLIMB, EXCITE}, too_late_at_start, LAND, ABORTED),
    Transition({EXCITE}, identified, JOIN, reason="identified, at the start of the reference"),
    Transition({EXCITE}, not_identified, LAND, ABORTED),
    Transition({JOIN}, at_full_speed, TRACK, reason="on the reference at full speed"),
    Transition({TRACK}, track_over, HOVER, reason="the reference was flown"),
    Transition({HOLD}, hold_refused, LAND, ABORTED),
    Transition({HOLD}, longer_than("hold_s"), LAND, ABORTED, reason=HELD),
    Transition({LAND}, landed, DISARMED, reason="disarmed on the ground"),
    Transition({LAND}, rebooted_disarmed, FAILED, ABORTED, "restart", RESTARTED),
    Transition({LAND}, disarmed_not_landed, FAILED, ABORTED),
    Transition({LAND}, authority_lost_armed, YIELDED, ABORTED, "mode change"),
    Transition({LAND}, unheard_on_ground, FAILED, ABORTED, reason=UNHEARD),
    Transition({LAND}, out_of_reach, FAILED, ABORTED),
    Transition({LAND}, longer_than("land_s", not_disarmed), FAILED, ABORTED),
)
HANDED_BACK, NOT_BEGUN = "handed back on request", "stopped on request"
hand_back, start = requested(Request.HAND_BACK), requested(Request.START)
SERVICE_ENDS = (
    Transition({HAND_BACK}, refused_to_pilot, HAND_BACK),
    Transition({HAND_BACK}, hold_refused, LAND, ABORTED),
    Transition({HAND_BACK}, longer_than("hand_back_s"), LAND, ABORTED, reason=DID_NOT_HOLD),
    Transition({TAKEOFF} | TRACKING, hand_back, HAND_BACK, FLOWN, reason=HANDED_BACK),
    Transition({STREAM, ENGAGE}, hand_back, FAILED, FLOWN, reason=NOT_BEGUN),
    Transition({ARM}, hand_back, STAND_DOWN, FLOWN, reason=NOT_BEGUN),
    Transition(TRACKING - {CLIMB}, start, CLIMB, reason="start requested"),
    Transition(MOVING, requested(Request.PAUSE), PAUSE, reason="pause requested"),
    Transition({PAUSE}, requested(Request.CONTINUE), TRACK, reason="continue requested"),
)
AT_REST = {
    "hold": (),
    "land": (Transition({HOVER}, at_rest, LAND, reason=RESTS),),
    "repeat": (Transition({HOVER}, at_rest, CLIMB, reason="once more"),),
}
