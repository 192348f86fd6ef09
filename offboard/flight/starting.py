"""The phase table on the ground: from the connection to lift-off, and the service that waits."""

from __future__ import annotations

from offboard.flight import preflight
from offboard.flight.phases import ExitCode, Phase
from offboard.flight.preflight import ARMED_ALREADY, OTHER_SENDER, SEVERAL, Ground
from offboard.flight.requests import Request
from offboard.flight.rows import (
    REBOOTED,
    SHOWS,
    STOP,
    Transition,
    blind,
    engaged_in_the_air,
    longer_than,
    lost,
    lost_armed,
    lost_disarmed,
    mode_unknown,
    no_mode_report,
    no_position_or_attitude,
    no_telemetry,
    other_sender,
    other_sender_name,
    rebooted,
    silent,
    stop_requested,
    why_lost,
)
from offboard.flight.state import FlightState
from offboard.mavlink.events import Heartbeat

ARM = 400  # MAV_CMD_COMPONENT_ARM_DISARM
ARMING_SHOWN_S = 2.5  # HEARTBEAT, at 1 Hz, shows an accepted arming within this time
DISARMED_SHOWN_S = 1.5  # longer than a period of HEARTBEAT: arming may have been in progress
LISTENED_S = 0.5  # to hear another sender: PX4 leaves OFFBOARD below 2 Hz


def vehicle_found(flight: FlightState) -> bool:
    return flight.vehicle.found is not None


def _not_found(flight: FlightState) -> str:
    senders, counters = flight.session.senders, flight.session.counters
    why = senders.why_none(counters) or "is it running, and sending to this port?"
    return f"no vehicle heard in {flight.silence_s:.0f} s; {why}"


def silent_on_ground(flight: FlightState) -> bool:
    return flight.silence_s > flight.limits.connect_s


def silent_for_long(flight: FlightState) -> bool:
    return flight.silence_s > 2.0 * flight.limits.silence_s


def armed_by_another(flight: FlightState) -> bool:
    return flight.vehicle.armed and not flight.limits.begin_armed


def _mode_wanted(flight: FlightState) -> str:
    return flight.authority.engage_mode if flight.authority else "offboard mode"


def other_vehicle(flight: FlightState) -> bool:
    """Several vehicles are heard: which one is meant?"""
    return flight.session.senders.ambiguous(flight.now_s)


def ground_of(flight: FlightState) -> Ground:
    """What the preflight list judges."""
    vehicle, contact, dialect = flight.vehicle, flight.contact, flight.dialect
    senders, service = flight.session.senders, flight.service
    read = dialect and flight.reading.complete(dialect, vehicle.parameters, flight.now_s)
    from_origin = service is not None and service.anchor == "origin"
    return Ground(
        vehicle,
        flight.limits,
        dialect,
        helicopter=flight.model.airframe == "helicopter",
        rates_hz=flight.session.rates_hz,
        delay=flight.clock.delay,
        measures_delay=not flight.clock.delay_is_measured(flight.host_s),
        reads_parameters=not read,
        systems=senders.named(flight.now_s) if senders.ambiguous(flight.now_s) else "",
        other_sender=other_sender(flight),
        in_the_air=contact.in_the_air,
        guarded=flight.guarded,
        origin_missing=from_origin and contact.in_the_air and contact.rest_ned_m is None,
        serves=service is not None,
    )


def refused(flight: FlightState) -> bool:
    """By the preflight list, whatever is waited for."""
    return bool(preflight.refusals(ground_of(flight)))


def _refusals(flight: FlightState) -> str:
    return "; ".join(preflight.refusals(ground_of(flight)))


def ready(flight: FlightState) -> bool:
    """By the preflight list, nothing is to be waited for."""
    return not preflight.not_ready(ground_of(flight))


def _not_ready(flight: FlightState) -> str:
    return preflight.not_ready(ground_of(flight))


def usable(flight: FlightState) -> bool:
    """Nothing speaks against flying it."""
    return ready(flight) and not refused(flight)


# ---------------------------------------------------------------------- the service waits


def can_take_over(flight: FlightState) -> bool:
    """It flies in the mode of setpoints, and nobody else has it."""
    return (
        engaged_in_the_air(flight)
        and not flight.vehicle.in_failsafe
        and not other_sender(flight)
        and not mode_unknown(flight)
        and not preflight.unfit_type(ground_of(flight))
        and not silent(flight)
        and not blind(flight)
    )


def engaged_by_pilot(flight: FlightState) -> bool:
    return flight.pilot.engaged and can_take_over(flight) and usable(flight)


def engaged_but_unfit(flight: FlightState) -> bool:
    return flight.pilot.engaged and can_take_over(flight) and not usable(flight)


def _unfit(flight: FlightState) -> str:
    return f"not engaged: {_refusals(flight)}{_not_ready(flight)}"


def engaged_too_soon(flight: FlightState) -> bool:
    """Switched away and back so fast that a failsafe may have done it."""
    hasty = flight.pilot.hasty and flight.in_phase_s > LISTENED_S
    return hasty and can_take_over(flight)


def found_engaged(flight: FlightState) -> bool:
    """Found in the air, in the mode of setpoints: another program may fly it."""
    unclaimed = flight.pilot.unclaimed and flight.vehicle.landed != "unknown"
    return unclaimed and engaged_in_the_air(flight) and flight.in_phase_s > LISTENED_S


def abandoned(flight: FlightState) -> bool:
    """A flight of this service was cut short there, and nobody else flies it."""
    left = flight.left_engaged and not other_vehicle(flight)
    return left and found_engaged(flight) and can_take_over(flight)


def started_in_the_air(flight: FlightState) -> bool:
    return flight.request is Request.START and can_take_over(flight) and usable(flight)


def started_on_the_ground(flight: FlightState) -> bool:
    return flight.request is Request.START and not flight.vehicle.armed and usable(flight)


# ---------------------------------------------------------------------- to the air


def streamed(flight: FlightState) -> bool:
    return flight.in_phase_s >= flight.limits.stream_s


def needs_no_stream(flight: FlightState) -> bool:
    return flight.takes_off_by_command


def engaged(flight: FlightState) -> bool:
    return flight.engaged


def _not_engaged(flight: FlightState) -> str:
    return (
        f"the vehicle did not enter {_mode_wanted(flight)} in {flight.in_phase_s:.0f} s "
        f"(it shows {flight.vehicle.mode})"
    )


def armed(flight: FlightState) -> bool:
    return flight.vehicle.armed and flight.engaged


def disarmed_again(flight: FlightState) -> bool:
    """A HEARTBEAT that is newer than the acceptance shows it disarmed when it should be armed. On a
    lossy link the acceptance may come long after the first request, and a HEARTBEAT be missing."""
    vehicle = flight.vehicle
    accepted = vehicle.results.get(ARM) == "ACCEPTED"
    since_s = flight.now_s - vehicle.answered_s.get(ARM, flight.now_s)
    shown = vehicle.disarmed and vehicle.age_s(Heartbeat) < since_s
    return accepted and shown and since_s > ARMING_SHOWN_S


def stop_requested_on_ground(flight: FlightState) -> bool:
    """Every sign says that the vehicle stands there."""
    stands = flight.vehicle.armed and not flight.contact.in_the_air
    return stop_requested(flight) and stands and not lost(flight)


def rises(flight: FlightState) -> bool:
    """Positions or the land detector show flight: an autopilot refuses to disarm then. PX4's
    detector leaves the ground while the thrust is still well below hover."""
    return flight.contact.lifted_off or flight.contact.detects_flight


def disarmed_for_good(flight: FlightState) -> bool:
    return not flight.vehicle.armed and flight.in_phase_s > DISARMED_SHOWN_S


# ---------------------------------------------------------------------- rows

REFUSED, ABORTED, FLOWN = ExitCode.REFUSED, ExitCode.ABORTED, ExitCode.FLOWN
_ABANDONED = (
    "{flight.vehicle.mode} in the air, and nobody flies the vehicle: a flight was cut short"
)
_TOO_SOON = (
    "not engaged: {flight.vehicle.mode} again before a HEARTBEAT has shown another mode; "
    "switch again"
)
STREAMING = (Phase.STREAM, Phase.ENGAGE)

FLY_BEGINS = (
    Transition((Phase.CONNECT,), stop_requested, Phase.FAILED, STOP, REFUSED),
    Transition((Phase.CONNECT,), vehicle_found, Phase.HEALTH, "vehicle found"),
    Transition((Phase.CONNECT,), silent_on_ground, Phase.FAILED, _not_found, REFUSED),
)
SERVICE_WAITS = (
    Transition((Phase.CONNECT,), stop_requested, Phase.FAILED, STOP, FLOWN),
    Transition((Phase.CONNECT,), vehicle_found, Phase.HEALTH, "vehicle found"),
    Transition((Phase.STANDBY,), rebooted, Phase.FAILED, REBOOTED, FLOWN),
    Transition((Phase.HEALTH, Phase.STANDBY), stop_requested, Phase.FAILED, STOP, FLOWN),
    Transition((Phase.HEALTH, Phase.STANDBY), abandoned, Phase.HAND_BACK, _ABANDONED, FLOWN),
    Transition(
        (Phase.STANDBY,),
        engaged_by_pilot,
        Phase.CLIMB,
        "engaged: {flight.vehicle.mode} in the air",
        FLOWN,
    ),
    Transition((Phase.HEALTH, Phase.STANDBY), engaged_but_unfit, Phase.HAND_BACK, _unfit, REFUSED),
    Transition((Phase.HEALTH,), usable, Phase.STANDBY, "telemetry flows"),
    Transition((Phase.STANDBY,), engaged_too_soon, Phase.HAND_BACK, _TOO_SOON, REFUSED),
    Transition(
        (Phase.STANDBY,),
        started_in_the_air,
        Phase.CLIMB,
        "start requested, {flight.vehicle.mode}",
        FLOWN,
    ),
    Transition((Phase.STANDBY,), started_on_the_ground, Phase.STREAM, "start requested"),
)


def starting(before: tuple[Phase, ...]) -> tuple[Transition, ...]:
    """From the ground to lift-off. `before`: the phases in which a flight is refused."""
    return (
        # first: from then on it is ours, and whatever ends the flight must ask for hold or land
        Transition(
            (Phase.ENGAGE,),
            engaged_in_the_air,
            Phase.CLIMB,
            "{flight.vehicle.mode} in the air",
        ),
        Transition(STREAMING, rebooted, Phase.FAILED, REBOOTED, REFUSED),
        Transition(
            STREAMING,
            armed_by_another,
            Phase.FAILED,
            ARMED_ALREADY,
            REFUSED,
        ),
        Transition(before, silent_on_ground, Phase.FAILED, no_telemetry, REFUSED),
        Transition(
            before,
            stop_requested,
            Phase.FAILED,
            "{flight.stop_reason} before take-off",
            REFUSED,
        ),
        Transition(
            STREAMING,
            other_sender,
            Phase.FAILED,
            lambda flight: OTHER_SENDER.format(other_sender=other_sender_name(flight)),
            REFUSED,
        ),
        Transition(
            STREAMING,
            other_vehicle,
            Phase.FAILED,
            lambda flight: SEVERAL.format(systems=flight.session.senders.named(flight.now_s)),
            REFUSED,
        ),
        Transition(STREAMING, blind, Phase.FAILED, no_position_or_attitude, REFUSED),
        Transition(STREAMING, mode_unknown, Phase.FAILED, no_mode_report, REFUSED),
        Transition(STREAMING, lost, Phase.FAILED, why_lost, REFUSED),
        Transition(
            (Phase.STREAM,),
            needs_no_stream,
            Phase.ENGAGE,
            "the autopilot takes off by itself",
        ),
        Transition((Phase.STREAM,), streamed, Phase.ENGAGE, "setpoints stream"),
        Transition((Phase.ENGAGE,), engaged, Phase.ARM, SHOWS),
        Transition((Phase.ENGAGE,), longer_than("engage_s"), Phase.FAILED, _not_engaged, REFUSED),
        Transition((Phase.ARM,), rebooted, Phase.FAILED, REBOOTED, REFUSED),
        Transition(
            (Phase.ARM,),
            lost_armed,
            Phase.YIELDED,
            lambda flight: f"{why_lost(flight)} as it armed",
            ABORTED,
        ),
        Transition((Phase.ARM,), lost_disarmed, Phase.FAILED, why_lost, REFUSED),
        Transition((Phase.ARM,), silent, Phase.STAND_DOWN, no_telemetry, REFUSED),
        Transition((Phase.ARM,), blind, Phase.STAND_DOWN, no_position_or_attitude, REFUSED),
        Transition((Phase.ARM,), stop_requested, Phase.STAND_DOWN, STOP, REFUSED),
        Transition((Phase.ARM,), armed, Phase.TAKEOFF, "armed"),
        Transition(
            (Phase.ARM,),
            disarmed_again,
            Phase.FAILED,
            "the vehicle was disarmed just after it had armed",
            REFUSED,
        ),
        Transition(
            (Phase.ARM,),
            longer_than("arm_s"),
            Phase.STAND_DOWN,
            "the vehicle did not arm in {flight.in_phase_s:.0f} s",
            REFUSED,
        ),
        Transition(
            (Phase.TAKEOFF,),
            stop_requested_on_ground,
            Phase.STAND_DOWN,
            "{flight.stop_reason} before lift-off",
            REFUSED,
        ),
        Transition(
            (Phase.STAND_DOWN,),
            rises,
            Phase.LAND,
            "flight is detected as it was to disarm",
            ABORTED,
        ),
        Transition((Phase.STAND_DOWN,), rebooted, Phase.FAILED, REBOOTED, REFUSED),
        Transition((Phase.STAND_DOWN,), silent_for_long, Phase.FAILED, no_telemetry, REFUSED),
        Transition((Phase.STAND_DOWN,), disarmed_for_good, Phase.FAILED, "disarmed on the ground"),
        Transition(
            (Phase.STAND_DOWN,),
            longer_than("disarm_s"),
            Phase.FAILED,
            "still armed after {flight.in_phase_s:.0f} s",
            ABORTED,
        ),
    )


FLY_IS_READY = (
    Transition((Phase.HEALTH,), refused, Phase.FAILED, _refusals, REFUSED),
    Transition((Phase.HEALTH,), ready, Phase.STREAM, "telemetry flows and the vehicle can arm"),
    Transition(
        (Phase.HEALTH,),
        longer_than("health_s"),
        Phase.FAILED,
        lambda flight: f"not ready: {_not_ready(flight)}",
        REFUSED,
    ),
)
