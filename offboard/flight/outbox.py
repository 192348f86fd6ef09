"""Outbox: the only place that creates setpoints, and the queue of all messages and records.

A setpoint is also given to the observer and the identification, which predict with the commands
that were sent. `flush` encodes what is queued. Decides nothing; owns no socket or file.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from offboard.estimation.observer import Observer
from offboard.flight.gate import LEVEL
from offboard.flight.online_identification import OnlineIdentification
from offboard.flight.supervisor import Guard
from offboard.mavlink.outgoing import AttitudeTarget, Outgoing, PositionTarget, Record
from offboard.mavlink.session import Session
from offboard.mavlink.texts import chunks
from offboard.model.command import Command, PositionCommand
from offboard.model.vehicle import Vehicle

WARNING, INFO = 4, 6  # MAV_SEVERITY
TEXT_ID_MAX = 65535  # STATUSTEXT.id; 0 is for texts of one chunk
REPEAT_S = 1.0  # period of a request that the vehicle has not followed


@dataclass(frozen=True, slots=True)
class Output:
    """Result of one call: frames to send, and all frames for the log, records included."""

    send: tuple[bytes, ...] = ()
    log: tuple[bytes, ...] = ()
    guard: Guard | None = None  # for the supervisor; None before the vehicle is found
    alive: bool = False  # telemetry has arrived: position or attitude, once both are received


class Outbox:
    """Creates and queues messages. `vehicle` is the vehicle model in use: it scales the thrust.

    `command` is the command in force, `announced` are the sentences for the user, oldest first.
    """

    def __init__(
        self,
        session: Session,
        observer: Observer,
        vehicle: Vehicle,
        identification: OnlineIdentification | None,
    ) -> None:
        self._session = session
        self._observer = observer
        self._identification = identification
        self.vehicle = vehicle
        self.command = Command(0.0, LEVEL, 0.0)
        self.announced: list[str] = []
        self._requested_s = -math.inf
        self._text_id = 0
        self._queue: list[Outgoing] = []

    # ------------------------------------------------------------------ setpoints

    def send_command(
        self, time_s: float, command: Command, body_z_down: float | None = None
    ) -> None:
        """Send an attitude setpoint. `body_z_down`: see `AttitudeTarget`."""
        self.set_command(time_s, command)
        if self._identification:
            self._identification.on_command(time_s, command)
        self.send(
            AttitudeTarget(
                time_s=time_s,
                thrust_mps2=command.thrust_mps2,
                thrust_direction_ned=command.thrust_direction_ned,
                course_rad=command.course_rad,
                hover_thrust=self.vehicle.hover_thrust,
                gravity_mps2=self.vehicle.gravity_mps2,
                body_z_down=body_z_down,
            )
        )

    def set_command(self, time_s: float, command: Command) -> None:
        """Note the command in force without sending it, for example the autopilot's own."""
        self.command = command
        self._observer.on_command(time_s, command)

    def send_position(self, time_s: float, command: PositionCommand) -> None:
        """Send a setpoint for the autopilot's position loop. The attitude that this loop commands
        is unknown, therefore the observer stops predicting with commands."""
        self._observer.freeze(True)
        self.command = Command(self.vehicle.gravity_mps2, LEVEL, command.course_rad)
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

    def hover_mps2(self) -> float:
        """Thrust that holds the weight, by the observer's estimate of the hover thrust."""
        share = self._observer.hover_thrust_estimate / self.vehicle.hover_thrust
        return (share if math.isfinite(share) else 1.0) * self.vehicle.gravity_mps2

    # ------------------------------------------------------------------ everything else

    def request(self, request: Outgoing, time_s: float) -> None:
        """Send a command, at most once a second: call it until the heartbeat shows the result."""
        if time_s - self._requested_s >= REPEAT_S - 1e-6:
            self._requested_s = time_s
            self.send(request)

    def restart_requests(self) -> None:
        """The next request is sent at once."""
        self._requested_s = -math.inf

    def announce(self, sentence: str, title: str = "") -> None:
        """Report to the user, and to the ground station with `title` before the sentence."""
        self.announced.append(sentence)
        self._send_text(INFO, title + sentence)

    def warn(self, sentence: str) -> None:
        """Report to the ground station and the log."""
        self._send_text(WARNING, sentence)

    def _send_text(self, severity: int, sentence: str) -> None:
        self._text_id = self._text_id % TEXT_ID_MAX + 1
        for chunk in chunks(severity, sentence, self._text_id):
            self.send(chunk)

    def send(self, *messages: Outgoing) -> None:
        """Queue messages to send and to log; records are only logged."""
        self._queue.extend(messages)

    def flush(self, received: tuple[bytes, ...], alive: bool) -> Output:
        """Encode the queue. In the log, the frames `received` come first."""
        frames = [(message, self._session.encode(message)) for message in self._queue]
        self._queue.clear()
        send = tuple(frame for message, frame in frames if not isinstance(message, Record))
        return Output(send, (*received, *(frame for _, frame in frames)), alive=alive)
