"""What is sent at a tick in each phase."""

from __future__ import annotations

import math

from offboard.flight import decision, outbox
from offboard.flight.authority import PilotSwitch, Standing
from offboard.flight.failsafe import telemetry_old
from offboard.flight.ground_contact import STANDING_S, STILL_ARMED
from offboard.flight.phases import BEFORE_FLIGHT, ENDING, FLYING, OUTAGE_MAX_S, TRACKING, Phase
from offboard.flight.preflight import other_sender
from offboard.flight.state import LEVEL_DIRECTION, FlightState
from offboard.mavlink.events import Heartbeat, ModeReport, VehicleIdentity
from offboard.mavlink.outgoing import CommandLong
from offboard.model.command import Command

HEARTBEAT, AUTOPILOT_VERSION = 0, 148  # message ids
# A HEARTBEAT is requested after so long; sooner without CURRENT_MODE (PX4 1.14), or a pilot might
# leave the mode and return unseen
HEARTBEAT_DUE_S, HEARTBEAT_ALONE_DUE_S, HEARTBEAT_EVERY_S = 1.3, 0.2, 0.15
MODE_REPORTED_S = 3.0  # PX4 1.15 sends CURRENT_MODE twice a second, and when it changes
FIT_EVERY_S = 4.0  # between two reductions of the telemetry: a backlog must drain first
SPOOL_UP_PER_S = 0.7  # thrust ramp before lift-off, in units of gravity
SPOOL_MAX = 2.0  # where the ramp ends, in units of gravity
SPOOL_UNSEEN = 0.9  # less than hover: without a new position the vehicle must not lift off or climb
SPOOL_KNOWN_S = 0.2  # greatest age of a position that shows the height
# Least and greatest height of an autopilot's own takeoff, which setpoints replace on the way:
# above the height that shows lift-off, and no higher than needed
TAKEOFF_HEIGHTS_M = 1.5, 3.0
DISARMING = (
    f"disarming: {STANDING_S:.0f} s without motion on the ground, and the vehicle does not disarm "
    "by itself"
)
# Setpoints go on for this time while land is requested: a link that loses messages may need several
# requests, one a second. If land is refused, they stop then, and the autopilot's failsafe lands
LAND_STREAM_S = 5.0


def act(flight: FlightState) -> None:
    """Send the requests of the phase, at most one setpoint, a TIMESYNC request, and a request for a
    missing HEARTBEAT."""
    if flight.in_end_phase:
        return
    time_s, flight.newest_setpoint = flight.time_s, None  # an older one is not repeated
    if flight.phase in BEFORE_FLIGHT:
        flight.observer.freeze(True)
        _prepare(flight, time_s)
    elif flight.phase is Phase.TAKEOFF:
        _take_off(flight, time_s)
    elif flight.phase not in TRACKING:
        act_without_decision(flight, time_s)
    elif flight.authority.permits_setpoint(flight.now_s) and not decision.decide(flight):
        outbox.send_level(flight, time_s, _level(flight))
    waits_aloft = flight.phase is Phase.STANDBY and flight.in_the_air
    if flight.phase in FLYING or flight.phase is Phase.LAND or waits_aloft:
        _request_heartbeat(flight)
    outbox.send(flight, flight.clock.request(time_s, flight.host_s))


def _request_heartbeat(flight: FlightState) -> None:
    """Request a HEARTBEAT that is overdue. The request changes nothing on the vehicle."""
    request = CommandLong.message(HEARTBEAT)
    alone = flight.vehicle.age_s(ModeReport) > MODE_REPORTED_S
    due_s = HEARTBEAT_ALONE_DUE_S if alone else HEARTBEAT_DUE_S
    waited_s = flight.now_s - flight.requested_s.get(request, outbox.NEVER)[0]
    if flight.vehicle.age_s(Heartbeat) > due_s and waited_s > HEARTBEAT_EVERY_S:
        outbox.send_request(flight, request)


def act_without_decision(flight: FlightState, time_s: float) -> None:
    """Send what needs no decision and no telemetry: level setpoints, and the requests that end the
    flight."""
    phase, command = flight.phase, _level(flight)
    if phase is Phase.STAND_DOWN:
        outbox.request(flight, CommandLong.disarm())
        command = Command(0.0, LEVEL_DIRECTION, flight.command.heading_rad)
    elif phase in ENDING:
        _end(flight)
        if flight.awaits_link or flight.in_phase_s >= LAND_STREAM_S or not flight.in_engage_mode:
            return
    elif phase is not Phase.TAKEOFF and phase not in TRACKING:
        return
    # Send none until the first decision has replaced the autopilot's own takeoff
    if math.isfinite(flight.setpoint_s):
        outbox.send_level(flight, time_s, command)


def _end(flight: FlightState) -> None:
    """Request hold or land."""
    dialect, authority = flight.known_dialect, flight.authority
    holds = flight.phase is not Phase.LAND
    if not holds:
        _await_link(flight)
    mode = flight.holds_in if holds else dialect.land_mode
    fails = authority.standing is Standing.FAILSAFE
    if fails and authority.mode == dialect.return_mode:
        return  # the owner has chosen this for missing setpoints: it lands where it took off
    if authority.mode != mode:
        if outbox.request(flight, dialect.set_mode(mode) if holds else CommandLong.land()):
            authority.request(mode)
    elif not holds:
        _disarm_if_standing(flight)


def _await_link(flight: FlightState) -> None:
    """Announce once that the landing waits for the link, and when the vehicle is heard again."""
    unreached_s, limits = flight.unreached_s, flight.limits
    waited, flight.awaits_link = flight.awaits_link, unreached_s > 2.0 * limits.silence_s
    if flight.awaits_link and not waited:
        silent = flight.silence_s > limits.silence_s
        missing = "telemetry" if silent else "report of the mode"
        outbox.announce(
            flight,
            f"no {missing} for {unreached_s:.1f} s: waiting for the link for at most "
            f"{OUTAGE_MAX_S:.0f} s; landing is asked again once the vehicle is heard",
        )
    elif waited and not flight.awaits_link:
        outbox.announce(flight, f"heard again: the vehicle shows {flight.vehicle.mode}")


def _disarm_if_standing(flight: FlightState) -> None:
    """Request disarming if the vehicle stands on the ground and stays armed; never by force, so
    that the autopilot refuses in the air. If its land detector reports flight, tell the user to
    disarm it instead. Wait first, because without a lift-off it has stood since before the landing.
    """
    contact = flight.contact
    if not contact.stands or flight.in_phase_s < min(STANDING_S, 0.5 * flight.limits.land_s):
        return
    if contact.detects_flight:
        outbox.announce(flight, STILL_ARMED, once=True)
    elif outbox.request(flight, CommandLong.disarm()):
        outbox.announce(flight, DISARMING, once=True)


def _prepare(flight: FlightState, time_s: float) -> None:
    if flight.phase is Phase.HEALTH:
        request_parameters(flight)
        _fit_telemetry(flight)
        return
    if flight.phase is Phase.STANDBY:
        _stand_by(flight, time_s)
        return
    if flight.phase is Phase.ENGAGE:
        outbox.request(flight, flight.known_dialect.engage())
    elif flight.phase is Phase.ARM:
        outbox.request(flight, CommandLong.arm())
    # On the ground without thrust, in the air with hover thrust
    flying = flight.contact.in_the_air
    if flight.takes_off_by_command and not flying:
        return
    thrust_mps2 = outbox.hover_mps2(flight) if flying else 0.0
    command = Command(thrust_mps2, LEVEL_DIRECTION, flight.vehicle.heading_rad)
    outbox.send_level(flight, time_s, command)


def _stand_by(flight: FlightState, time_s: float) -> None:
    """Stream setpoints that change nothing, because PX4 accepts OFFBOARD only while setpoints
    arrive: on the ground without thrust, in the air with the vehicle's own attitude and thrust.
    Send none in the air in a failsafe or just after it, because PX4 would return to OFFBOARD by
    itself, none while another program sends setpoints, and none on old telemetry or just after the
    vehicle was disarmed."""
    on_ground, vehicle = flight.contact.on_ground, flight.vehicle
    command = Command(0.0, LEVEL_DIRECTION, vehicle.heading_rad) if on_ground else _flown(flight)
    quiet = bool(flight.takes_off_by_command or telemetry_old(flight) or other_sender(flight))
    if on_ground:
        quiet |= vehicle.disarmed_lately or (vehicle.armed and vehicle.in_failsafe)
    else:
        quiet |= vehicle.in_failsafe or flight.pilot is not PilotSwitch.READY
    if quiet:
        outbox.set_command(flight, time_s, command)
    else:
        outbox.send_level(flight, time_s, command)


def _flown(flight: FlightState) -> Command:
    """Return the attitude that the vehicle has, with the thrust that its autopilot reports."""
    model, share = flight.model, flight.hover.thrust(flight.time_s)
    north, east, down = flight.vehicle.thrust_direction_ned.tolist()
    thrust_mps2 = (1.0 if share is None else share / model.hover_thrust) * model.gravity_mps2
    return Command(thrust_mps2, (north, east, down), flight.vehicle.heading_rad)


def request_parameters(flight: FlightState) -> None:
    """In HEALTH, request what decides whether the vehicle can be flown. It needs no telemetry."""
    due = flight.reading.due(flight.known_dialect, flight.vehicle)
    outbox.send(flight, *due)
    if flight.service:
        if flight.vehicle.age_s(VehicleIdentity) > flight.in_phase_s:
            outbox.request(flight, CommandLong.message(AUTOPILOT_VERSION))
        return
    stale = flight.vehicle.mode == flight.known_dialect.engage_mode and flight.vehicle.disarmed
    if stale and not flight.vehicle.prearm_ok:  # PX4 returns to OFFBOARD after a landing
        outbox.request(flight, flight.known_dialect.hold())


def _fit_telemetry(flight: FlightState) -> None:
    """Request less telemetry while the link delay is too great to fly, because the link may be
    saturated."""
    link, limits = flight.clock.delay, flight.limits
    if link is None or flight.host_s - flight.clock.began_s < FIT_EVERY_S:
        return
    late = link.value > limits.link_delay_s or link.sd > limits.link_jitter_s
    if late and flight.session.telemetry.thin():
        flight.clock.measure_delay_again()
        delay = f"{1e3 * link.value:.0f} +- {1e3 * link.sd:.0f} ms"
        outbox.announce(flight, f"the delay of the link is {delay}: less telemetry is requested")


def _take_off(flight: FlightState, time_s: float) -> None:
    if flight.takes_off_by_command:
        _request_takeoff(flight, time_s)
        return
    gravity_mps2, reached_mps2 = flight.model.gravity_mps2, flight.command.thrust_mps2
    ramp_mps3, most = SPOOL_UP_PER_S * gravity_mps2, SPOOL_UNSEEN
    if flight.vehicle.position_age_s <= SPOOL_KNOWN_S:
        reached_mps2 += 2.0 * ramp_mps3 * flight.period_s  # no leap after a gap of positions
        most = SPOOL_MAX
    thrust_mps2 = min(most * gravity_mps2, ramp_mps3 * flight.in_phase_s, reached_mps2)
    outbox.send_level(
        flight, time_s, Command(thrust_mps2, LEVEL_DIRECTION, flight.command.heading_rad)
    )


def _request_takeoff(flight: FlightState, time_s: float) -> None:
    """Request the autopilot's own takeoff. No setpoint is sent, because one without thrust would
    cancel it.

    Give the observer hover thrust as the command in force. The autopilot's thrust is close to it,
    and the observer needs a command when setpoints take over.
    """
    least_m, most_m = TAKEOFF_HEIGHTS_M
    height_m = -float(flight.plan.track.sample(0.0).position_ned_m[2])
    outbox.request(flight, flight.known_dialect.take_off(min(max(height_m, least_m), most_m)))
    hovering = Command(flight.model.gravity_mps2, LEVEL_DIRECTION, flight.vehicle.heading_rad)
    outbox.set_command(flight, time_s, hovering)


def _level(flight: FlightState) -> Command:
    """Return a level command with hover thrust. Before lift-off is seen, it has the thrust that the
    ramp has reached, but less than lifts the vehicle."""
    reached_mps2, gravity_mps2 = flight.command.thrust_mps2, flight.model.gravity_mps2
    thrust_mps2 = min(reached_mps2, SPOOL_UNSEEN * gravity_mps2)
    if flight.plan.reference is not None:
        thrust_mps2 = outbox.hover_mps2(flight)
    return Command(thrust_mps2, LEVEL_DIRECTION, flight.command.heading_rad)
