"""The phase table on the ground: from the connection to lift-off, and while the service waits."""

from __future__ import annotations

from offboard.flight import preflight
from offboard.flight.authority import PilotSwitch
from offboard.flight.conditions import (
    OPERATOR,
    Transition,
    authority_lost,
    authority_lost_armed,
    blind,
    in_own_failsafe,
    longer_than,
    mode_unknown,
    rebooted,
    silent,
    silent_for,
    stop_requested,
)
from offboard.flight.phases import ExitCode, Phase, Request
from offboard.flight.preflight import armed_already, other_sender, other_vehicle, unfit_type
from offboard.flight.state import FlightState
from offboard.flight.vehicle_state import ARMED_KNOWN_S, DISARMED_S
from offboard.mavlink.events import Heartbeat
from offboard.mavlink.senders import OTHER_VEHICLE_S

ARM_DISARM = 400  # MAV_CMD_COMPONENT_ARM_DISARM
ARMING_SHOWN_S = 2.5  # HEARTBEAT, at 1 Hz, shows an accepted arming within this time
PREARM_S = 10.0  # time for the pre-arm checks of the mode that PX4 shows, without GPS
LISTENED_S = 0.5  # time to hear another sender of setpoints: PX4 leaves OFFBOARD below 2 Hz


def vehicle_found(flight: FlightState) -> str:
    return "vehicle found" if flight.session.vehicle is not None else ""


def not_found(flight: FlightState) -> str:
    if not silent_on_ground(flight):
        return ""
    why = flight.session.senders.why_none() or "is it running, and sending to this port?"
    return f"no vehicle heard in {flight.silence_s:.0f} s; {why}"


def silent_on_ground(flight: FlightState) -> str:
    return silent_for(flight, flight.limits.connect_s)


def silent_for_another(flight: FlightState) -> str:
    """After OTHER_VEHICLE_S of silence HEALTH begins again, if anything was heard in it."""
    return "" if flight.silent_since_health else silent_for(flight, OTHER_VEHICLE_S)


def refused(flight: FlightState) -> str:
    """What the preflight list refuses at once, without waiting."""
    return "; ".join(preflight.refusals(flight))


def unfit(flight: FlightState) -> str:
    """What the preflight list refuses at once, and the first problem that it waits for; empty if
    there is neither."""
    return "; ".join(filter(None, [*preflight.refusals(flight), preflight.awaited(flight)]))


def is_fit(flight: FlightState) -> bool:
    return not unfit(flight)


def only_mode_is_unfit(flight: FlightState) -> str:
    """See `preflight.only_mode_is_unfit`."""
    if flight.in_phase_s <= PREARM_S or not preflight.only_mode_is_unfit(flight):
        return ""
    shown, engaged = flight.vehicle.mode, flight.authority.engage_mode
    return f"its pre-arm checks do not pass in {shown}, but may pass in {engaged}"


def not_ready(flight: FlightState) -> str:
    return f"not ready: {unfit(flight)} (limits.health_s is {flight.limits.health_s:g})"


# ---------------------------------------------------------------------- the service waits


PREVENTED = other_sender, mode_unknown, silent, blind  # they prevent a take-over


def not_for_this_vehicle(flight: FlightState) -> str:
    """Why a setpoint may be for another vehicle, or not be accepted. In HEALTH none is sent."""
    return other_vehicle(flight) or preflight.signs(flight)


def firmware_unknown(flight: FlightState) -> bool:
    """Whether a parameter that the firmware must have was not answered. An ArduPlane may show the
    MAV_TYPE of a multirotor (Q_MAV_TYPE), and the numbers of its modes mean others: 4, GUIDED of
    ArduCopter, is ACRO."""
    dialect, known = flight.dialect, flight.vehicle.parameters
    return dialect is None or any(each.must_answer for each in dialect.without_reply(known))


def can_take_over(flight: FlightState) -> bool:
    """Whether the vehicle is of a fit type and firmware and flies in the mode of setpoints without
    a failsafe, its telemetry is recent, and no other program controls it."""
    if flight.vehicle.in_failsafe or firmware_unknown(flight) or not engaged_in_the_air(flight):
        return False
    return not any(each(flight) for each in (*PREVENTED, unfit_type))


def engaged_by_pilot(flight: FlightState) -> str:
    fit = flight.pilot is PilotSwitch.ENGAGED and can_take_over(flight) and is_fit(flight)
    return f"engaged: {flight.vehicle.mode} in the air" if fit else ""


def engaged_but_unfit(flight: FlightState) -> str:
    may_fly = flight.pilot is PilotSwitch.ENGAGED and can_take_over(flight)
    why = unfit(flight) if may_fly else ""
    return f"not engaged: {why}" if why else ""


def engaged_too_soon(flight: FlightState) -> bool:
    """Whether the vehicle left the mode of setpoints and returned so soon that this may have been a
    failsafe."""
    too_soon = flight.pilot is PilotSwitch.TOO_SOON and flight.in_phase_s > LISTENED_S
    return too_soon and can_take_over(flight)


def found_engaged(flight: FlightState) -> bool:
    """Whether the vehicle was found in the air in the mode of setpoints: another program may fly
    it."""
    found = flight.pilot is PilotSwitch.FOUND and flight.vehicle.landed != "unknown"
    return found and flight.in_phase_s > LISTENED_S and bool(engaged_in_the_air(flight))


def abandoned(flight: FlightState) -> bool:
    """Whether a flight of this service was cut short and left the vehicle engaged, and no other
    program flies it."""
    left = flight.left_engaged and not other_vehicle(flight)
    return left and found_engaged(flight) and can_take_over(flight)


def started_in_the_air(flight: FlightState) -> str:
    started = flight.request is Request.START and flight.in_the_air and not not_started(flight)
    return f"start requested, {flight.vehicle.mode}" if started else ""


def started_on_the_ground(flight: FlightState) -> bool:
    return flight.request is Request.START and not flight.in_the_air and not not_started(flight)


def not_started(flight: FlightState) -> str:
    """Why a request to start is refused while the service waits; empty if it is not refused. In the
    air the vehicle must fly for certain, as it must for a pilot's switch."""
    vehicle, service = flight.vehicle, flight.service
    if not flight.in_the_air:
        if service is None or not service.arms:
            return "it is on the ground, and may not be armed without --arms"
        return "it is armed on the ground" if vehicle.armed else unfit(flight)
    if not flight.in_engage_mode:
        return f"it flies in {vehicle.mode}: switch to {flight.authority.engage_mode} instead"
    if vehicle.in_failsafe:
        return f"a failsafe of the vehicle flies it, in {vehicle.mode}"
    why = next(filter(None, (each(flight) for each in (unfit, *PREVENTED))), "")
    return why or ("" if flight.contact.flies else "it may stand on the ground")


# ---------------------------------------------------------------------- to the air


def engaged_in_the_air(flight: FlightState) -> str:
    """The vehicle flies in the mode in which it follows setpoints."""
    flies = flight.in_engage_mode and flight.contact.in_the_air
    return f"{flight.vehicle.mode} in the air" if flies else ""


def authority_lost_disarmed(flight: FlightState) -> str:
    return authority_lost(flight) if flight.shown_since_lost and not flight.vehicle.armed else ""


def streamed(flight: FlightState) -> str:
    if flight.takes_off_by_command:
        return f"{flight.authority.engage_mode} needs no setpoints beforehand"
    return "setpoints stream" if flight.in_phase_s >= flight.limits.stream_s else ""


def engaged(flight: FlightState) -> str:
    return f"the vehicle shows {flight.vehicle.mode}" if flight.in_engage_mode else ""


def not_engaged(flight: FlightState) -> str:
    unanswered = preflight.no_reply_for(flight.clock.unanswered_s(flight.host_s))
    return (
        f"the vehicle did not enter {flight.authority.engage_mode} in {flight.in_phase_s:.0f} s "
        f"(it shows {flight.vehicle.mode})" + (unanswered and f"; {unanswered}")
    )


def armed(flight: FlightState) -> str:
    return "armed" if flight.vehicle.armed and flight.in_engage_mode else ""


def disarmed_again(flight: FlightState) -> bool:
    """Whether the vehicle accepted the request to arm in this phase, more than ARMING_SHOWN_S ago,
    and a HEARTBEAT since then shows it disarmed. On a lossy link the acceptance may come long after
    the first request, and a HEARTBEAT may be missing."""
    vehicle = flight.vehicle
    accepted = vehicle.results.get(ARM_DISARM) == "ACCEPTED"
    since_s = flight.now_s - vehicle.answered_s.get(ARM_DISARM, flight.now_s)
    shown = vehicle.disarmed and vehicle.age_s(Heartbeat) < since_s
    return accepted and shown and ARMING_SHOWN_S < since_s <= flight.in_phase_s


def stop_requested_on_ground(flight: FlightState) -> str:
    """A stop is requested while the vehicle is armed and certainly stands on the ground."""
    stands = flight.vehicle.armed and not flight.contact.in_the_air
    stopped = flight.stop_reason and stands and not authority_lost(flight)
    return f"{flight.stop_reason} before lift-off" if stopped else ""


def rises(flight: FlightState) -> bool:
    """Whether positions or the land detector show flight, in which an autopilot refuses to disarm.
    PX4's land detector reports flight while the thrust is still well below hover."""
    return flight.contact.lifted_off or flight.contact.detects_flight


def disarmed_for_good(flight: FlightState) -> bool:
    """Whether a HEARTBEAT of this phase shows the vehicle disarmed, DISARMED_S after the beginning
    of the phase: before that it may still have been arming."""
    shown = flight.vehicle.disarmed and flight.vehicle.age_s(Heartbeat) < flight.in_phase_s
    return shown and flight.in_phase_s > DISARMED_S


def not_armed(flight: FlightState) -> str:
    silent_s = flight.vehicle.age_s(Heartbeat)
    if silent_s > ARMED_KNOWN_S:
        return f"no HEARTBEAT for {silent_s:.0f} s: it is not known whether the vehicle has armed"
    return f"the vehicle did not arm in {flight.in_phase_s:.0f} s"


def still_armed(flight: FlightState) -> str:
    unheard = flight.vehicle.age_s(Heartbeat) > ARMED_KNOWN_S
    state = "no HEARTBEAT shows whether it is armed" if unheard else "still armed"
    return f"{state} after {flight.in_phase_s:.0f} s"


# ---------------------------------------------------------------------- rows

(CONNECT, HEALTH, STANDBY, STREAM, ENGAGE, ARM, TAKEOFF, CLIMB, EXCITE, JOIN, TRACK, PAUSE, HOVER,
 HAND_BACK, HOLD, STAND_DOWN, LAND, DISARMED, YIELDED, FAILED) = Phase  # fmt: skip
FLOWN, REFUSED, ABORTED = ExitCode.FLOWN, ExitCode.REFUSED, ExitCode.ABORTED
STREAMING = {STREAM, ENGAGE}
ABANDONED = "{flight.vehicle.mode} in the air, and nobody flies it: an earlier flight was cut short"
TOO_SOON = (
    "not engaged: {flight.vehicle.mode} again before a HEARTBEAT has shown another mode, or while "
    "a flight ended; switch again"
)
BEFORE_TAKEOFF = "{flight.stop_reason} before takeoff"
DISARMED_AGAIN = "the vehicle accepted arming, but its HEARTBEAT shows it disarmed"
FLIGHT_DETECTED = "flight was detected while it was asked to disarm"
LOST_AS_IT_ARMED = "{flight.authority.lost_reason} as it armed"

FLY_BEGINS = (
    Transition({CONNECT}, stop_requested, FAILED, REFUSED, OPERATOR),
    Transition({CONNECT}, vehicle_found, HEALTH),
    Transition({CONNECT}, not_found, FAILED, REFUSED, "link"),
    Transition({HEALTH}, silent_on_ground, FAILED, REFUSED, "link"),
    Transition({HEALTH}, stop_requested, FAILED, REFUSED, OPERATOR, BEFORE_TAKEOFF),
    Transition({HEALTH}, refused, FAILED, REFUSED),
    Transition({HEALTH}, is_fit, STREAM, reason="telemetry flows and the vehicle can arm"),
    Transition({HEALTH}, only_mode_is_unfit, STREAM),
    Transition({HEALTH}, longer_than("health_s", not_ready), FAILED, REFUSED),
)
SERVICE_BEGINS = (
    Transition({CONNECT}, stop_requested, FAILED, FLOWN, OPERATOR),
    Transition({CONNECT}, vehicle_found, HEALTH),
    Transition({STANDBY}, rebooted, FAILED, FLOWN, "restart"),
    Transition({HEALTH, STANDBY}, silent_for_another, HEALTH),
    # before the row of a stop, so that a vehicle that was engaged just now is handed back
    Transition({HEALTH, STANDBY}, abandoned, HAND_BACK, FLOWN, reason=ABANDONED),
    Transition({STANDBY}, engaged_by_pilot, CLIMB, FLOWN),
    Transition({HEALTH, STANDBY}, engaged_but_unfit, HAND_BACK, REFUSED),
    Transition({HEALTH, STANDBY}, stop_requested, FAILED, FLOWN, OPERATOR),
    Transition({STANDBY}, not_for_this_vehicle, HEALTH),
    Transition({HEALTH}, is_fit, STANDBY, reason="telemetry flows"),
    Transition({STANDBY}, engaged_too_soon, HAND_BACK, REFUSED, reason=TOO_SOON),
    Transition({STANDBY}, started_in_the_air, CLIMB, FLOWN),
    Transition({STANDBY}, started_on_the_ground, STREAM, reason="start requested"),
)
STARTING = (
    # first, because the vehicle is ours then: whatever ends the flight must request hold or land
    Transition(STREAMING, engaged_in_the_air, CLIMB),
    Transition(STREAMING, rebooted, FAILED, REFUSED, "restart"),
    Transition(STREAMING, armed_already, FAILED, REFUSED),
    Transition(STREAMING, stop_requested, FAILED, REFUSED, OPERATOR, BEFORE_TAKEOFF),
    Transition(STREAMING, other_sender, FAILED, REFUSED, "second sender"),
    Transition(STREAMING, other_vehicle, FAILED, REFUSED),
    Transition(STREAMING, blind, FAILED, REFUSED, "link"),
    Transition(STREAMING, mode_unknown, FAILED, REFUSED, "link"),
    Transition(STREAMING, authority_lost, FAILED, REFUSED, "mode change"),
    Transition({STREAM}, streamed, ENGAGE),
    Transition({ENGAGE}, engaged, ARM),
    Transition({ENGAGE}, longer_than("engage_s", not_engaged), FAILED, REFUSED),
    Transition({ARM}, rebooted, STAND_DOWN, REFUSED, "restart"),
    Transition({ARM}, authority_lost_armed, YIELDED, ABORTED, "mode change", LOST_AS_IT_ARMED),
    Transition({ARM}, authority_lost_disarmed, FAILED, REFUSED, "mode change"),
    Transition({ARM}, in_own_failsafe, STAND_DOWN, REFUSED, "link"),
    Transition({ARM}, silent, STAND_DOWN, REFUSED, "link"),
    Transition({ARM}, blind, STAND_DOWN, REFUSED, "link"),
    Transition({ARM}, stop_requested, STAND_DOWN, REFUSED, OPERATOR),
    Transition({ARM}, armed, TAKEOFF),
    Transition({ARM}, disarmed_again, STAND_DOWN, REFUSED, reason=DISARMED_AGAIN),
    Transition({ARM}, longer_than("arm_s", not_armed), STAND_DOWN, REFUSED),
    Transition({TAKEOFF}, stop_requested_on_ground, STAND_DOWN, REFUSED, OPERATOR),
    Transition({STAND_DOWN}, rises, LAND, ABORTED, reason=FLIGHT_DETECTED),
    Transition({STAND_DOWN}, disarmed_for_good, FAILED, reason="disarmed on the ground"),
    Transition({STAND_DOWN}, longer_than("disarm_s", still_armed), FAILED, ABORTED),
)
