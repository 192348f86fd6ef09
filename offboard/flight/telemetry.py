"""What each received message changes in a flight. Only replies and announcements are sent.

`offboard/service/README.md` lists the commands of a ground station to our component.
"""

from __future__ import annotations

import numpy as np

from offboard.flight import outbox, transitions
from offboard.flight.authority import Authority, PilotSwitch
from offboard.flight.estimates import HoverEstimate, PositionJumps
from offboard.flight.ground_contact import GroundContact, Touchdown
from offboard.flight.phases import (
    BEFORE_FLIGHT,
    FLYING,
    TRACKING,
    WAITING,
    Phase,
    Request,
)
from offboard.flight.preflight import ParameterReading, other_sender
from offboard.flight.record import vehicle_record
from offboard.flight.state import FlightState
from offboard.flight.timing import VehicleClock
from offboard.link.interface import peer_name
from offboard.mavlink.events import (
    BOOTS,
    Attitude,
    ClockBehind,
    CommandRequest,
    Event,
    Heartbeat,
    LocalPosition,
    ModeReport,
    OtherCompanion,
    Parameter,
    PeerChanged,
    Rebooted,
    ThrustReport,
    TimesyncReply,
    VehicleFound,
    VehicleIdentity,
)
from offboard.mavlink.outgoing import CommandResult
from offboard.mavlink.senders import AUTOPILOT_COMPONENT

START, PAUSE_CONTINUE, SET_MODE = 300, 193, 176  # MAV_CMD
ACCEPTED, TEMPORARILY_REJECTED, DENIED, UNSUPPORTED = range(4)  # MAV_RESULT
SAME_THRUST = 1e-5  # of full throttle: rounding on the link
OTHER_COMPANION = (
    "another companion computer is on the link: system {system} component {component}; only one of "
    "them may send setpoints"
)
SAME_IDS = (
    "another program sends with the ids of the vehicle, system {system} component {component}: "
    "give it another component id"
)
DISARMED_SHOWN = (
    "a HEARTBEAT shows the vehicle disarmed: either it is wrong, or the motors have stopped"
)


def update(flight: FlightState, event: Event, arrived_s: float, *, turned_s: float) -> bool:
    """Update the flight with one event. `arrived_s` is the host time at which the event arrived,
    `turned_s` is the host time of the turn. Returns False where `VehicleState.update` does."""
    if isinstance(event, Parameter):
        _announce_change(flight, event)
    if not flight.vehicle.update(event, flight.session.link_time_s):
        return False
    match event:
        case Attitude(time_s, attitude, rates):
            _on_telemetry(flight, time_s, arrived_s, turned_s)
            flight.observer.on_attitude(time_s, attitude, rates)
            if flight.identification:
                flight.identification.on_attitude(time_s, attitude)
        case LocalPosition():
            _on_telemetry(flight, event.time_s, arrived_s, turned_s)
            _on_position(flight, event)
        case ThrustReport(thrust):
            flight.hover.on_thrust(flight.time_s, thrust, thrust * _lifting_share(flight))
            flight.follows_others = _is_of_others(flight, thrust)
        case Heartbeat(mode) | ModeReport(mode):
            _on_mode(flight, event, mode, arrived_s)
        case Parameter() if flight.identification and flight.phase in FLYING:
            flight.identification.on_shown(transitions.shown_limits(flight, flight.identification))
        case TimesyncReply():
            flight.clock.on_reply(event)
        case CommandRequest():
            _answer(flight, event)
        case VehicleFound():
            outbox.send(flight, vehicle_record(event))
        case PeerChanged(peer):
            outbox.announce(flight, f"the vehicle now sends from {peer_name(peer)}")
        case OtherCompanion(system, component):
            same = component == AUTOPILOT_COMPONENT
            sentence = (SAME_IDS if same else OTHER_COMPANION).format(
                system=system, component=component
            )
            outbox.announce(flight, sentence, once=True)
        case ClockBehind(system_id, _):  # it sets its time stamp to ours when it hears us
            sentence = f"the signing time of system {system_id} is behind: sending ours"
            outbox.announce(flight, sentence, once=True)
        case Rebooted():
            _on_reboot(flight)
    return True


def _announce_change(flight: FlightState, parameter: Parameter) -> None:
    """Announce each change of a watched parameter once (two programs may set it in turn), except of
    the hover thrust that ArduCopter learns in flight."""
    name, now, dialect = parameter.name, parameter.value, flight.dialect
    before = flight.vehicle.parameters.get(name, now)
    if before == now or dialect is None or name == dialect.hover_parameter:
        return
    watched = next(each for each in dialect.watched_parameters if each.name == name)
    fault = watched.fault(now)
    why = f": {fault.found}. Fix: {fault.fix}" if fault else ""
    outbox.announce(flight, f"{name} was changed from {before:g} to {now:g}{why}", once=True)


def is_of_another(flight: FlightState, event: Event) -> bool:
    """Whether the hardware number shows, while the flight waits, that this is not the same vehicle
    as before. Then everything that was known is forgotten, as after a reboot."""
    known = flight.vehicle.uid
    differs = isinstance(event, VehicleIdentity) and known is not None and event.uid != known
    return differs and flight.phase in WAITING


def _is_of_others(flight: FlightState, thrust: float) -> bool:
    """Whether the vehicle demands a thrust that no recent setpoint of ours had."""
    ours = flight.thrusts if _reports_thrust(flight) else ()
    return bool(ours) and all(abs(thrust - each) > SAME_THRUST for each in ours)


def _reports_thrust(flight: FlightState) -> bool:
    """Whether the autopilot reports the thrust of the setpoint; ArduCopter does not."""
    return flight.dialect is not None and not flight.dialect.divides_by_tilt


def _lifting_share(flight: FlightState) -> float:
    """Vertical part of a unit of the thrust that the autopilot reports: the cosine of the tilt, but
    1 for ArduCopter, which reports the thrust before it is raised for the tilt."""
    if flight.vehicle.attitude is None or not _reports_thrust(flight):
        return 1.0
    return float(flight.vehicle.thrust_direction_ned[2])


def _on_telemetry(flight: FlightState, stamp_s: float, arrived_s: float, turned_s: float) -> None:
    flight.telemetry_arrived_s = arrived_s
    # On a stream, only the earliest possible time of arrival is known: useless after our own pause
    host_s = turned_s if flight.session.settings.stream else arrived_s
    flight.clock.on_telemetry(stamp_s, flight.session.elapsed_s(host_s))


def _on_position(flight: FlightState, event: LocalPosition) -> None:
    time_s, down_mps = event.time_s, event.velocity_ned_mps[2]
    _follow_jump(flight, event)
    place_ned_m = flight.jumps.without(event.position_ned_m)
    flight.contact.on_position(time_s, place_ned_m, down_mps)
    flight.hover.on_position(time_s, flight.contact.height_m, down_mps)
    if flight.touchdown:
        flight.touchdown.on_position(time_s, place_ned_m, down_mps)
    flight.observer.on_position(time_s, event.position_ned_m, event.velocity_ned_mps)
    if flight.identification:
        flight.identification.on_position(time_s, place_ned_m, event.velocity_ned_mps)


def _follow_jump(flight: FlightState, event: LocalPosition) -> None:
    """If the position estimate has jumped, move the reference too: the vehicle did not move."""
    jump_ned_m = flight.jumps.on_position(event)
    if flight.phase not in FLYING:
        flight.jumps.forget()
    elif jump_ned_m is not None and flight.phase in TRACKING:
        back_s = flight.plan.follow_jump(event.time_s, jump_ned_m)
        outbox.announce(
            flight,
            f"the estimated position jumped by {np.linalg.norm(jump_ned_m):.2f} m: the "
            f"reference jumps with it, and returns within {back_s:.0f} s",
        )


def _on_mode(
    flight: FlightState, event: Heartbeat | ModeReport, mode: str, arrived_s: float
) -> None:
    dialect = flight.known_dialect
    boots = isinstance(event, Heartbeat) and event.system_status == BOOTS
    if boots and not flight.rebooted and flight.phase in FLYING | {Phase.LAND}:
        _on_reboot(flight)  # first, or the mode that it shows would count as a pilot's choice
    if not flight.authority.engage_mode:
        flight.authority = Authority(dialect.engage_mode)
    vehicle, authority = flight.vehicle, flight.authority
    authority.setpoint_loss = dialect.setpoint_loss(vehicle.parameters)
    flight.mode_after_s = flight.clock.answered_s
    authority.on_mode(
        mode,
        flight.now_s,
        arrived_s=arrived_s,
        failsafe=vehicle.in_failsafe,
        heartbeat=isinstance(event, Heartbeat),
        setpoints_missing=flight.setpoints_missing,
        sticks=vehicle.sticks,
    )
    if isinstance(event, Heartbeat) and not event.armed and flight.phase in FLYING:
        outbox.announce(flight, DISARMED_SHOWN, once=True)  # one does not end a flight
    switched = flight.pilot is PilotSwitch.READY and flight.in_engage_mode
    in_the_air, flies, why = flight.in_the_air, flight.contact.flies, ""
    flight.pilot = flight.pilot.after(
        in_engage_mode=flight.in_engage_mode,
        in_the_air=in_the_air,
        flies=flies,
        failsafe=vehicle.in_failsafe if isinstance(event, Heartbeat) else None,
    )
    if flight.pilot is PilotSwitch.ENGAGED and other_sender(flight):
        flight.pilot, why = PilotSwitch.IDLE, "another program sends setpoints"  # not for us
    elif in_the_air and not flies:
        why = "the vehicle may stand on the ground"
    if switched and why and flight.phase in WAITING:
        outbox.announce(flight, f"not engaged: {mode}, but {why}")


def _on_reboot(flight: FlightState) -> None:
    """Forget what was known about vehicle and link, because the vehicle was rebooted. This ends the
    flight, unless it is still in CONNECT or HEALTH. A landing continues, but the flight counts as
    aborted."""
    flight.observer.reset()
    flight.contact, flight.clock = GroundContact(flight.vehicle), VehicleClock()
    flight.hover, flight.jumps = HoverEstimate(), PositionJumps()
    flight.reading = ParameterReading()
    flight.took_off = False  # the local frame has another origin now
    if flight.phase in BEFORE_FLIGHT:
        flight.authority = Authority()
    flight.authority.forget(flight.now_s)  # the time without a report counts from now
    flight.rebooted = flight.phase not in (Phase.CONNECT, Phase.HEALTH)
    flight.pilot = PilotSwitch.FOUND
    if flight.phase is Phase.LAND:
        flight.touchdown = Touchdown(None)
    transitions.advance(flight)


# ---------------------------------------------------------------------- requests


def _answer(flight: FlightState, asked: CommandRequest) -> None:
    """Obey a command to our component if possible, and acknowledge it. A command that is being
    obeyed already is accepted again, because a ground station that missed the acknowledgement
    repeats it."""
    request, result = Request.NONE, UNSUPPORTED
    if flight.service:
        request = {START: Request.START, SET_MODE: Request.HAND_BACK}.get(asked.command, request)
        if asked.command == PAUSE_CONTINUE:
            wanted = {0.0: Request.PAUSE, 1.0: Request.CONTINUE}
            request, result = wanted.get(asked.parameters[0], request), DENIED
    if request is not Request.NONE:
        sender = f"system {asked.system_id} component {asked.component_id}"
        obeyed = transitions.obey(flight, request, sender)
        result = ACCEPTED if obeyed else TEMPORARILY_REJECTED
    outbox.send(flight, CommandResult(asked.command, result, asked.system_id, asked.component_id))
