"""Assessment: the facts of one moment, and the figures that explain a transition.

Functions of the flight state; they change nothing and decide nothing.
"""

from __future__ import annotations

import math
from dataclasses import fields

import numpy as np

from offboard.estimation.observer import Observer
from offboard.flight import preflight
from offboard.flight.authority import Standing
from offboard.flight.facts import Facts
from offboard.flight.ground_contact import STANDING_S
from offboard.flight.online_identification import OnlineIdentification
from offboard.flight.phases import TRACKING, Phase
from offboard.flight.preflight import Ground
from offboard.flight.state import FlightState
from offboard.mavlink.events import Heartbeat, OtherCompanion, OtherSender, ThrustReport
from offboard.mavlink.session import Session
from offboard.model.frames import thrust_direction_from_quaternion

TAKE_OVER_HEIGHT_M = 1.0  # where setpoints replace the autopilot's own take-off
OTHER_SENDER_S = 5.0  # a second sender is there for so long after its newest frame
FULL_THRUST = 0.99
THRUST_REPORT_S = 1.0  # age of a ThrustReport that counts
ARMING_SHOWN_S = 2.5  # HEARTBEAT, at 1 Hz, shows an accepted arming within this time
READIED = (Phase.HEALTH, Phase.STANDBY)  # phases in which readiness is judged
ARM = 400  # MAV_CMD_COMPONENT_ARM_DISARM
STILL_ARMED = (
    f"it has stood still for {STANDING_S:.0f} s and is armed: its land detector reports that it "
    "flies; disarm it with the transmitter or a ground station"
)


def facts(
    state: FlightState,
    session: Session,
    observer: Observer,
    identification: OnlineIdentification | None,
) -> Facts:
    """The facts of this moment."""
    vehicle, plan, authority = state.vehicle, state.plan, state.authority
    track, time_s = plan.track, state.time_s
    charge = vehicle.health.battery_remaining if vehicle.health else None
    age_s = state.telemetry_age_s(state.host_s) if vehicle.has_state else 0.0
    north_m, east_m, height_m = _from_take_off(state)
    judged = ground(state, session)
    return Facts(
        limits=state.limits,
        in_phase_s=state.in_phase_s,
        silence_s=state.silence_s,
        blind_s=max(vehicle.position_age_s, vehicle.attitude_age_s),
        found=vehicle.found is not None,
        ready=state.phase in READIED and not preflight.not_ready(judged),
        refused=state.phase in READIED and bool(preflight.refusals(judged)),
        unfit_type=state.phase in READIED and bool(preflight.unfit_type(judged)),
        rebooted=state.rebooted,
        engaged=authority is not None and authority.mode == authority.engage_mode,
        lost=authority is not None and authority.standing is Standing.LOST,
        shown_since=_shown_since_lost(state),
        authority_known=authority is not None and authority.heard(state.now_s),
        own_failsafe=authority is not None and authority.standing is Standing.FAILSAFE,
        unreached_s=state.unreached_s,
        failsafe=vehicle.in_failsafe,
        armed=vehicle.armed,
        in_the_air=state.contact.in_the_air,
        landed=state.phase is Phase.LAND and not state.not_landed(),
        disarmed_s=vehicle.disarmed_s,
        lifted_off=state.phase is Phase.TAKEOFF and _lifted_off(state),
        at_start=state.phase is Phase.CLIMB and _at_start(state, observer),
        late_s=plan.late_s(time_s),
        track_time_s=plan.track_time_s(time_s),
        track_start_s=track.track_start_s,
        track_end_s=track.track_end_s,
        rest_time_s=track.duration_s + 0.5,
        position_error_m=position_error_m(state),
        prediction_error_m=_prediction_error_m(state),
        tilt_rad=_tilt_rad(state),
        tilt_error_rad=_tilt_error_rad(state),
        height_m=height_m,
        distance_m=math.hypot(north_m, east_m),
        stop_requested=bool(state.stop_reason),
        missed_decisions=state.missed,
        contradicted=identification is not None and bool(identification.contradiction),
        telemetry_age_s=age_s,
        link_growth_s=state.link_growth_s,
        clock_jump_s=state.clock.jumped_s,
        position_jump_m=state.jumps.recent_m(time_s),
        positioning_lost=bool(state.positioning.lost(vehicle, state.limits)),
        battery=1.0 if charge is None else charge,
        hover_thrust=observer.hover_thrust_estimate if state.phase in TRACKING else math.nan,
        full_thrust_sink_mps=_full_thrust_sink_mps(state),
        other_sender=_hears_other_sender(state),
        follows_others=_follows_others(state),
        other_vehicle=session.senders.ambiguous(state.now_s),
        disarmed_again=_disarmed_again(state),
        lifted_by_command=state.takes_off_by_command,
        request=state.request,
        switched=state.pilot.engaged,
        hasty=state.pilot.hasty,
        unclaimed=state.pilot.unclaimed and vehicle.landed != "unknown",
        left_engaged=state.left_engaged,
        handed=authority is not None and authority.standing is Standing.HANDED,
        excites=identification is not None and identification.wants_excitation,
        identified=identification is not None and identification.finished(time_s),
    )


def has_other_sender(state: FlightState) -> bool:
    """Whether another program controls the vehicle on this link, and that counts."""
    return _hears_other_sender(state) and not state.limits.begin_with_other_sender


def _hears_other_sender(state: FlightState) -> bool:
    return state.vehicle.age_s(OtherSender) < OTHER_SENDER_S


def _full_thrust_sink_mps(state: FlightState) -> float:
    """Downward speed while the newest setpoint demands the full thrust, else 0. Other rows of the
    ladder act on an old position (blind) and on missing setpoints (decisions)."""
    position, thrusts = state.vehicle.position, state.thrusts
    if state.phase not in TRACKING or position is None or not thrusts:
        return 0.0
    return max(position.velocity_ned_mps[2], 0.0) if thrusts[-1] >= FULL_THRUST else 0.0


def _follows_others(state: FlightState) -> bool:
    reported = state.vehicle.age_s(ThrustReport) < THRUST_REPORT_S
    return state.follows_others and reported and state.phase in TRACKING


def figures(
    state: FlightState,
    session: Session,
    now: Facts,
    identification: OnlineIdentification | None,
) -> dict[str, object]:
    """The values for the names in braces in the reasons of phase table and ladder: the facts, and
    what explains them."""
    vehicle, authority, other = state.vehicle, state.authority, state.vehicle.other_sender
    older = vehicle.position_age_s >= vehicle.attitude_age_s
    judged = ground(state, session)
    return {each.name: getattr(now, each.name) for each in fields(now)} | {
        "mode": vehicle.mode,
        "mode_wanted": authority.engage_mode if authority else "offboard mode",
        "lost": authority.lost_reason if authority else "",
        "authority_age_s": state.now_s - authority.heard_s if authority else math.inf,
        "blind_to": "LOCAL_POSITION_NED" if older else "ATTITUDE_QUATERNION",
        "last_known": f"last known: {'armed' if vehicle.armed else 'disarmed'} in {vehicle.mode}, "
        f"{now.height_m:.1f} m above the take-off point",
        "position_error_limit_m": state.limits.position_error_m,
        "tilt_deg": math.degrees(now.tilt_rad),
        "tilt_error_deg": math.degrees(now.tilt_error_rad),
        "battery_percent": 100.0 * now.battery,
        "hover_thrust_percent": 100.0 * now.hover_thrust,
        "other_sender": f"system {other.system_id} component {other.component_id}" if other else "",
        "companion": _other_companion(vehicle.other_companion),
        "systems": session.senders.named(state.now_s),
        "not_found": session.senders.why_none(session.counters)
        or "is it running, and sending to this port?",
        "stop": state.stop_reason,
        "failure": state.failure,
        "contradiction": identification.contradiction if identification else "",
        "not_landed": state.not_landed(),
        "positioning": state.positioning.lost(vehicle, state.limits),
        "still_armed": _still_armed(state),
        "refusals": "; ".join(preflight.refusals(judged)),
        "not_ready": preflight.not_ready(judged),
    }


def ground(state: FlightState, session: Session) -> Ground:
    """What the preflight list judges."""
    programme, contact, senders = state.programme, state.contact, session.senders
    vehicle, dialect = state.vehicle, state.dialect
    read = dialect and state.reading.complete(dialect, vehicle.parameters, state.now_s)
    from_origin = programme.serves and programme.anchor == "origin"
    return Ground(
        vehicle,
        state.limits,
        dialect,
        helicopter=state.model.airframe == "helicopter",
        rates_hz=session.rates_hz,
        delay=state.clock.delay,
        measures_delay=not state.clock.delay_is_measured(state.host_s),
        reads_parameters=not read,
        systems=senders.named(state.now_s) if senders.ambiguous(state.now_s) else "",
        other_sender=_hears_other_sender(state),
        in_the_air=contact.in_the_air,
        guarded=state.guarded,
        origin_missing=from_origin and contact.in_the_air and contact.rest_ned_m is None,
        serves=programme.serves,
    )


def _still_armed(state: FlightState) -> str:
    contact = state.contact
    shows = contact.stands and contact.detects_flight and state.vehicle.armed
    return f"; {STILL_ARMED}" if shows else ""


def position_error_m(state: FlightState) -> float:
    """Distance of the reported position from the reference; 0 without a reference."""
    position = state.vehicle.position
    sample = state.plan.sample(position.time_s) if position else None
    if position is None or sample is None:
        return 0.0
    return float(np.linalg.norm(np.array(position.position_ned_m) - sample.position_ned_m))


def _other_companion(other: OtherCompanion | None) -> str:
    """What it may have to do with a vehicle that does not follow; empty without one."""
    if other is None:
        return ""
    return (
        f"; another companion computer, system {other.system_id} component {other.component_id}, "
        "may send setpoints, too"
    )


def _shown_since_lost(state: FlightState) -> bool:
    """A HEARTBEAT has come since the vehicle was lost. PX4 leaves its landing mode when it disarms,
    and CURRENT_MODE shows that before HEARTBEAT shows the vehicle disarmed."""
    authority = state.authority
    heard_s = state.now_s - state.vehicle.age_s(Heartbeat)
    return authority is not None and heard_s > authority.lost_s


def _disarmed_again(state: FlightState) -> bool:
    """A HEARTBEAT that is newer than the acceptance shows it disarmed when it should be armed. On a
    lossy link the acceptance may come long after the first request, and a HEARTBEAT be missing."""
    vehicle = state.vehicle
    accepted = vehicle.results.get(ARM) == "ACCEPTED"
    since_s = state.now_s - vehicle.answered_s.get(ARM, state.now_s)
    shown = vehicle.disarmed and vehicle.age_s(Heartbeat) < since_s
    return accepted and shown and since_s > ARMING_SHOWN_S


def _from_take_off(state: FlightState) -> tuple[float, float, float]:
    """North, east and height of the newest position relative to the take-off point."""
    position = state.vehicle.position
    if position is None or state.plan.reference is None:
        return 0.0, 0.0, 0.0
    north, east, down = (
        each - origin
        for each, origin in zip(position.position_ned_m, state.home_ned_m, strict=True)
    )
    return north, east, -down


def _prediction_error_m(state: FlightState) -> float:
    """Distance of the newest position from the newest prediction for an earlier moment."""
    position = state.vehicle.position
    if position is None:
        return 0.0
    for predicted in reversed(state.predictions):
        passed_s = position.time_s - predicted.time_s
        if passed_s >= 0.0:
            then = predicted.position_ned_m + passed_s * predicted.velocity_ned_mps
            return float(np.linalg.norm(np.array(position.position_ned_m) - then))
    return 0.0


def _tilt_rad(state: FlightState) -> float:
    attitude = state.vehicle.attitude
    if attitude is None:
        return 0.0
    down = thrust_direction_from_quaternion(np.array(attitude.attitude))[2]
    return math.acos(min(1.0, max(-1.0, float(down))))


def _tilt_error_rad(state: FlightState) -> float:
    """Angle between the thrust direction and the nearest of the newest commands."""
    attitude = state.vehicle.attitude
    if attitude is None or len(state.commands) < (state.commands.maxlen or 0):
        return 0.0
    flown = thrust_direction_from_quaternion(np.array(attitude.attitude))
    nearest = max(float(flown @ np.array(each.thrust_direction_ned)) for each in state.commands)
    return math.acos(min(1.0, max(-1.0, nearest)))


def _lifted_off(state: FlightState) -> bool:
    if state.takes_off_by_command:
        return state.contact.height_m > TAKE_OVER_HEIGHT_M
    return state.contact.lifted_off


def _at_start(state: FlightState, observer: Observer) -> bool:
    if state.vehicle.position is None:
        return False
    time_s = state.time_s
    velocity_ned_mps = observer.predict(time_s).velocity_ned_mps
    position = np.array(state.vehicle.position.position_ned_m)
    return state.plan.at_start(time_s, position, velocity_ned_mps)
