"""What each received message changes in the state of the flight. Sends nothing but answers."""

from __future__ import annotations

import numpy as np

from offboard.estimation.observer import Observer
from offboard.flight.authority import Authority
from offboard.flight.ground_contact import GroundContact
from offboard.flight.hover_estimate import HoverEstimate
from offboard.flight.manifest import vehicle_record
from offboard.flight.online_identification import OnlineIdentification
from offboard.flight.outbox import Outbox
from offboard.flight.phases import BEFORE_FLIGHT, TRACKING, WAITING, Phase
from offboard.flight.position_jumps import PositionJumps
from offboard.flight.preflight import ParameterReading
from offboard.flight.requests import Circumstances, Request, Result, answer
from offboard.flight.rows import other_sender
from offboard.flight.starting import can_take_over, usable
from offboard.flight.state import FlightState
from offboard.mavlink.dialects.base import ThrustRule
from offboard.mavlink.events import (
    Attitude,
    ClockBehind,
    CommandRequest,
    Event,
    Heartbeat,
    LocalPosition,
    ModeReport,
    OtherCompanion,
    PeerChanged,
    Rebooted,
    ThrustReport,
    TimesyncReply,
    VehicleFound,
)
from offboard.mavlink.outgoing import CommandResult
from offboard.mavlink.session import Session
from offboard.model.frames import thrust_direction_from_quaternion

SAME_THRUST = 1e-5  # of full throttle: rounding on the link


class EventProcessor:
    """Updates `state`, observer and identification by one event after the other.

    `telemetry_arrived_s` is the host time at which the newest position or attitude has arrived.
    """

    def __init__(
        self,
        *,
        state: FlightState,
        session: Session,
        observer: Observer,
        identification: OnlineIdentification | None,
        outbox: Outbox,
    ) -> None:
        self._state = state
        self._session = session
        self._observer = observer
        self._identification = identification
        self._outbox = outbox
        self.telemetry_arrived_s = 0.0

    def process(self, event: Event, arrived_s: float, *, turned_s: float) -> None:
        """`arrived_s` is the host time of the event's arrival, `turned_s` that of the turn."""
        state = self._state
        state.now_s = self._session.link_time_s
        state.vehicle.update(event, state.now_s)
        match event:
            case Attitude(time_s, attitude, rates) if not state.vehicle.repeated:
                self._on_telemetry(time_s, arrived_s, turned_s)
                self._observer.on_attitude(time_s, attitude, rates)
                if self._identification:
                    self._identification.on_attitude(time_s, attitude)
            case LocalPosition() if not state.vehicle.repeated:
                self._on_telemetry(event.time_s, arrived_s, turned_s)
                self._on_position(event)
            case ThrustReport(thrust):
                state.hover.on_thrust(state.time_s, thrust, thrust * self._lifting_share())
                state.follows_others = self._is_of_others(thrust)
            case Heartbeat(mode) | ModeReport(mode):
                self._on_mode(event, mode, arrived_s)
            case TimesyncReply():
                state.clock.on_reply(event)
            case CommandRequest():
                self._answer(event)
            case VehicleFound():
                self._outbox.send(vehicle_record(event))
            case PeerChanged(peer):
                self._outbox.announce(f"the vehicle now sends from another port: {peer}")
            case OtherCompanion(system, component):
                self._outbox.announce_once(
                    f"another companion computer is on the link: system {system} component "
                    f"{component}; only one of them may send setpoints"
                )
            case ClockBehind(system_id, _):  # its time stamps follow ours once it has heard us
                self._outbox.announce_once(
                    f"the signing time of system {system_id} is behind: sending ours"
                )
            case Rebooted():
                self._on_reboot()

    def _is_of_others(self, thrust: float) -> bool:
        """Whether the vehicle demands a thrust that no recent setpoint of ours had. False on
        ArduCopter, which does not report the thrust of the setpoint."""
        state = self._state
        if state.dialect is None or state.dialect.thrust_rule is not ThrustRule.COLLECTIVE:
            return False
        return bool(state.thrusts) and all(abs(thrust - t) > SAME_THRUST for t in state.thrusts)

    def _lifting_share(self) -> float:
        """Vertical part of the thrust that the autopilot reports: the cosine of the tilt, unless it
        reports it before it is raised for the tilt."""
        attitude, dialect = self._state.vehicle.attitude, self._state.dialect
        if attitude is None or dialect is None or dialect.thrust_rule is not ThrustRule.COLLECTIVE:
            return 1.0
        return float(thrust_direction_from_quaternion(np.array(attitude.attitude))[2])

    def _on_telemetry(self, stamp_s: float, arrived_s: float, turned_s: float) -> None:
        self.telemetry_arrived_s = arrived_s
        # A stream says only how early it may have arrived: after a pause of ours it would be ahead
        host_s = turned_s if self._session.settings.stream else arrived_s
        self._state.clock.on_telemetry(stamp_s, self._session.clock_s(host_s))

    def _on_position(self, event: LocalPosition) -> None:
        state, time_s, down_mps = self._state, event.time_s, event.velocity_ned_mps[2]
        self._follow_jump(event)
        state.contact.on_position(event)
        state.hover.on_position(time_s, state.contact.height_m, down_mps)
        if state.touchdown:
            state.touchdown.on_position(time_s, event.position_ned_m, down_mps)
        self._observer.on_position(time_s, event.position_ned_m, event.velocity_ned_mps)
        if self._identification:
            north, east, down = np.subtract(event.position_ned_m, state.jumps.total_ned_m).tolist()
            self._identification.on_position(time_s, (north, east, down), event.velocity_ned_mps)

    def _follow_jump(self, event: LocalPosition) -> None:
        """The vehicle does not step when its estimate does."""
        state, jump_ned_m = self._state, self._state.jumps.on_position(event)
        if jump_ned_m is not None:
            state.move_ground(jump_ned_m.tolist())
        if state.phase not in TRACKING:
            state.jumps.forget()
        elif jump_ned_m is not None:
            back_s = state.plan.follow_jump(event.time_s, jump_ned_m)
            self._outbox.announce(
                f"the estimated position jumped by {np.linalg.norm(jump_ned_m):.2f} m: the "
                f"reference jumps with it, and returns within {back_s:.0f} s"
            )

    def _on_mode(self, event: Heartbeat | ModeReport, mode: str, arrived_s: float) -> None:
        state = self._state
        if state.authority is None:
            state.dialect = self._session.dialect
            assert state.dialect is not None
            state.authority = Authority(state.dialect.engage_mode)
        assert state.dialect is not None
        vehicle = state.vehicle
        state.authority.loss = state.dialect.setpoint_loss(vehicle.parameters)
        state.authority.on_mode(
            mode,
            state.now_s,
            arrived_s=arrived_s,
            failsafe=vehicle.in_failsafe,
            heartbeat=isinstance(event, Heartbeat),
            starved=state.starved,
            sticks=vehicle.sticks,
        )
        ours = mode == state.authority.engage_mode
        contact = state.contact
        flies, switched = contact.in_the_air, ours and state.pilot.elsewhere
        state.pilot.on_mode(ours=ours, in_the_air=flies, certainly=contact.certainly_flies)
        why = "" if state.pilot.engaged or not flies else "the vehicle may stand on the ground"
        if state.pilot.engaged and other_sender(state):
            state.pilot.engaged = False  # it was not switched for us
            why = "another program sends setpoints"
        if switched and why and state.phase in WAITING:
            self._outbox.announce(f"not engaged: {mode}, but {why}")
        if isinstance(event, Heartbeat):
            state.pilot.on_heartbeat(ours=ours, failsafe=state.vehicle.in_failsafe)

    def _answer(self, asked: CommandRequest) -> None:
        """Acknowledge a command to us; the next tick does what it asks for."""
        state, result = self._state, Result.UNSUPPORTED
        if state.service:
            fit = state.phase is Phase.STANDBY and usable(state)
            circumstances = Circumstances(
                state.phase,
                state.vehicle.armed,
                state.service.arms,
                fit,
                fit and can_take_over(state),
            )
            result, request = answer(asked.command, asked.parameters, circumstances)
            if request is not Request.NONE:
                state.request = request
                sender = f"system {asked.system_id} component {asked.component_id}"
                self._outbox.announce(f"{request.value} requested by {sender}")
        self._outbox.send(CommandResult(asked.command, result, asked.system_id, asked.component_id))

    def _on_reboot(self) -> None:
        """Nothing that was known of vehicle and link is known any more."""
        state = self._state
        self._observer.reset()
        state.clock.reset()
        state.contact = GroundContact(state.vehicle)
        state.hover, state.jumps = HoverEstimate(), PositionJumps()
        state.reading = ParameterReading()
        state.takeoff_ned_m = None  # the local frame begins elsewhere
        if state.authority and state.phase not in BEFORE_FLIGHT:
            state.authority.forget(state.now_s)
        else:
            state.authority = None
