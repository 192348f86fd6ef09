"""Outbox: the only place from which setpoints and commands leave, and the queue of all messages.

A setpoint passes the gate first, and is then given to the observer and the identification, which
predict with the commands that were sent. `flush` encodes what is to be sent, `records` what is only
logged, after that. Decides nothing; owns no socket or file.
"""

from __future__ import annotations

import math
from contextlib import suppress
from dataclasses import dataclass

from offboard.estimation.observer import Observer
from offboard.flight.gate import LEVEL, Clearance, Refused, admit
from offboard.flight.online_identification import OnlineIdentification
from offboard.flight.phases import Phase
from offboard.flight.state import FlightState
from offboard.flight.vehicle_state import GOOD_RESULTS
from offboard.mavlink.outgoing import (
    AttitudeTarget,
    CommandLong,
    Outgoing,
    PositionTarget,
    Record,
)
from offboard.mavlink.session import Session
from offboard.mavlink.texts import chunks
from offboard.model.command import Command, PositionCommand
from offboard.supervisor.supervisor import Supervised

WARNING, INFO = 4, 6  # MAV_SEVERITY
TEXT_ID_MAX = 65535  # STATUSTEXT.id; 0 is for texts of one chunk
REPEAT_S = 1.0  # after this a request that was refused, or not answered, is sent again


@dataclass(frozen=True, slots=True)
class Output:
    """What one turn sends."""

    send: tuple[bytes, ...] = ()
    supervised: Supervised | None = None  # for the supervisor; None before the vehicle is found


class Outbox:
    """Creates and queues messages.

    `command` is the command in force, `announced` are the sentences for the user, oldest first.
    """

    def __init__(
        self,
        state: FlightState,
        session: Session,
        observer: Observer,
        identification: OnlineIdentification | None,
    ) -> None:
        self._state = state
        self._session = session
        self._observer = observer
        self._identification = identification
        self.command = Command(0.0, LEVEL, 0.0)
        self.announced: list[str] = []
        self._requested_s: dict[tuple[Phase, CommandLong], float] = {}
        self._text_id = 0
        self._queue: list[Outgoing] = []
        self._records: list[Record] = []

    # ------------------------------------------------------------------ setpoints

    def send_command(
        self,
        time_s: float,
        command: Command,
        body_z_down: float | None = None,
        *,
        age_s: float = 0.0,
        late_s: float = 0.0,
    ) -> Command:
        """Send an attitude setpoint and return it as it was sent.

        `age_s` and `late_s` are those of the decision (see `gate.Clearance`), `body_z_down` is
        described in `AttitudeTarget`. Raises gate.Refused; then nothing is sent.
        """
        model = self._state.model
        command = admit(command, model, self._clearance(age_s, late_s))
        self.set_command(time_s, command)
        self._state.commands.append(command)
        self._state.setpoint_s = self._state.now_s
        self._state.thrusts.append(min(command.thrust_mps2 / model.thrust_max_mps2, 1.0))
        if self._identification:
            self._identification.on_command(self._state.sent_s(time_s), command)
        self.send(
            AttitudeTarget(
                time_s=time_s,
                thrust_mps2=command.thrust_mps2,
                thrust_direction_ned=command.thrust_direction_ned,
                course_rad=command.course_rad,
                hover_thrust=model.hover_thrust,
                gravity_mps2=model.gravity_mps2,
                body_z_down=body_z_down,
            )
        )
        return command

    def send_level(self, time_s: float, command: Command) -> None:
        """Send a setpoint that no decision was needed for, if the vehicle is ours."""
        with suppress(Refused):
            self.send_command(time_s, command)

    def set_command(self, time_s: float, command: Command) -> None:
        """Note the command in force without sending it, for example the autopilot's own."""
        self.command = command
        self._observer.on_command(self._state.sent_s(time_s), command)

    def send_position(
        self, time_s: float, command: PositionCommand, *, age_s: float = 0.0, late_s: float = 0.0
    ) -> PositionCommand:
        """Send a setpoint for the autopilot's position loop; see `send_command`.

        The attitude that this loop commands is unknown, therefore the observer stops predicting
        with commands.
        """
        command = admit(command, self._state.model, self._clearance(age_s, late_s))
        self._observer.freeze(True)
        self._state.setpoint_s = self._state.now_s
        self._state.thrusts.clear()  # the autopilot chooses the thrust
        self.command = Command(self._state.model.gravity_mps2, LEVEL, command.course_rad)
        self.send(
            PositionTarget(
                time_s,
                command.position_ned_m,
                command.velocity_ned_mps,
                command.acceleration_ned_mps2,
                command.course_rad,
                command.course_rate_radps,
            )
        )
        return command

    def hover_mps2(self) -> float:
        """Thrust that holds the weight, by the observer's estimate of the hover thrust."""
        model = self._state.model
        share = self._observer.hover_thrust_estimate / model.hover_thrust
        return (share if math.isfinite(share) else 1.0) * model.gravity_mps2

    def _clearance(self, age_s: float, late_s: float) -> Clearance:
        state = self._state
        return Clearance(
            ours=state.ours,
            on_ground=state.contact.certain,
            age_s=age_s,
            age_limit_s=state.limits.setpoint_age_s,
            late_s=late_s,
        )

    # ------------------------------------------------------------------ everything else

    def request(self, request: CommandLong) -> bool:
        """Send a command if the vehicle is ours; returns whether it was sent.

        In one phase it is sent once. Only one that was refused, or that nothing has answered, is
        sent again, after a second and a new report of the mode: a pilot may have changed it.
        """
        state = self._state
        key = state.phase, request
        result = state.vehicle.results.get(request.command)
        requested_s = self._requested_s.get(key, -math.inf)
        heard_s = state.authority.heard_s if state.authority else -math.inf
        waits = state.now_s - requested_s < REPEAT_S - 1e-6 or heard_s < requested_s
        done = math.isfinite(requested_s) and result in GOOD_RESULTS
        if waits or done or not state.may_command:
            return False
        self._requested_s[key] = state.now_s
        state.vehicle.results.pop(request.command, None)
        self.send(request)
        return True

    def renew(self) -> None:
        """After an outage of the link every request may be sent once more."""
        self._requested_s.clear()

    def announce(self, sentence: str, title: str = "") -> None:
        """Report to the user, and to the ground station with `title` before the sentence."""
        self.announced.append(sentence)
        self._send_text(INFO, title + sentence)

    def announce_once(self, sentence: str) -> None:
        """`announce`, unless it has been."""
        if sentence not in self.announced:
            self.announce(sentence)

    def warn(self, sentence: str) -> None:
        """Report to the ground station and the log."""
        self._send_text(WARNING, sentence)

    def _send_text(self, severity: int, sentence: str) -> None:
        self._text_id = self._text_id % TEXT_ID_MAX + 1
        for chunk in chunks(severity, sentence, self._text_id):
            self.send(chunk)

    def send(self, *messages: Outgoing) -> None:
        """Queue messages to send and to log; records are only logged."""
        for message in messages:
            if isinstance(message, Record):
                self._records.append(message)
            else:
                self._queue.append(message)

    def flush(self, supervised: Supervised | None = None) -> Output:
        """Encode what is to be sent."""
        queue, self._queue = self._queue, []  # empty, should one of them not be encodable
        return Output(tuple(map(self._session.encode, queue)), supervised)

    def records(self) -> list[bytes]:
        """Encode what is only logged."""
        records, self._records = self._records, []
        return [self._session.encode(record) for record in records]
