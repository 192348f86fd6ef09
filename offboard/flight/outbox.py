"""What leaves the companion: the one place that makes a setpoint, and every other frame.

A setpoint that leaves is also given to the observer and the identification, so that they replay
exactly what was sent. Frames are queued until `take`. Decides nothing; owns no socket or file.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from offboard.estimation.observer import Observer
from offboard.flight.online_identification import OnlineIdentification
from offboard.flight.setpoint import LEVEL
from offboard.mavlink.outgoing import (
    AttitudeTarget,
    Outgoing,
    PositionTarget,
    Record,
)
from offboard.mavlink.session import Session
from offboard.mavlink.texts import chunks
from offboard.model.command import Command, PositionCommand
from offboard.model.vehicle import Vehicle

WARNING, INFO = 4, 6  # MAV_SEVERITY
MOST_TEXTS = 65535  # STATUSTEXT.id; 0 is for those that are complete in themselves
ASK_AGAIN_S = 1.0  # between repetitions of a command the vehicle has not obeyed


@dataclass(frozen=True, slots=True)
class Output:
    """What one call produced: frames to send, and all frames for the log, records included."""

    send: tuple[bytes, ...] = ()
    log: tuple[bytes, ...] = ()
    alive: bool = False  # the vehicle was heard: its state, once that flows


class Outbox:
    """One flight's way out. `vehicle` is the one now believed: it scales the thrust sent."""

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
        self.command = Command(0.0, LEVEL, 0.0)  # in force
        self.announced: list[str] = []
        self._asked_s = -math.inf
        self._texts = 0  # id of the last one
        self._send_out: list[bytes] = []
        self._log_out: list[bytes] = []

    # ------------------------------------------------------------------ setpoints

    def emit(self, time_s: float, command: Command, body_z_down: float | None = None) -> None:
        """The one place that emits a setpoint. `body_z_down`: of the body, when it acts."""
        self.assume(time_s, command)
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

    def assume(self, time_s: float, command: Command) -> None:
        """The command in force, whoever gave it; nothing leaves."""
        self.command = command
        self._observer.on_command(time_s, command)

    def hand_over(self, time_s: float, command: PositionCommand) -> None:
        """Emit a setpoint for the autopilot's own position loop. What it commands its attitude
        loop is not ours to know: the observer only listens."""
        self._observer.freeze(True)
        self.command = Command(self.vehicle.gravity_mps2, LEVEL, command.course_rad)
        self.send(
            PositionTarget(
                time_s=time_s,
                position_ned_m=command.position_ned_m,
                velocity_ned_mps=command.velocity_ned_mps,
                acceleration_ned_mps2=command.acceleration_ned_mps2,
                course_rad=command.course_rad,
                course_rate_radps=command.course_rate_radps,
            )
        )

    def hover_mps2(self) -> float:
        """Thrust that holds the weight, by the observer's account."""
        share = self._observer.hover_thrust_estimate / self.vehicle.hover_thrust
        return (share if math.isfinite(share) else 1.0) * self.vehicle.gravity_mps2

    # ------------------------------------------------------------------ everything else

    def ask(self, request: Outgoing, time_s: float) -> None:
        """Send a command, and again while it is not obeyed; the heartbeat is the verdict."""
        if time_s - self._asked_s >= ASK_AGAIN_S - 1e-6:
            self._asked_s = time_s
            self.send(request)

    def forget_asking(self) -> None:
        """The next command is a new one, or the vehicle's time is."""
        self._asked_s = -math.inf

    def announce(self, sentence: str, title: str = "") -> None:
        """Tell the user here and at the ground station, there under a title."""
        self.announced.append(sentence)
        self._say(INFO, title + sentence)

    def warn(self, sentence: str) -> None:
        """Tell the ground station and the log."""
        self._say(WARNING, sentence)

    def _say(self, severity: int, sentence: str) -> None:
        self._texts = self._texts % MOST_TEXTS + 1
        for chunk in chunks(severity, sentence, self._texts):
            self.send(chunk)

    def send(self, outgoing: Outgoing) -> None:
        self.pass_on((self._session.encode(outgoing),))

    def pass_on(self, frames: tuple[bytes, ...]) -> None:
        """Frames that somebody else has encoded."""
        self._send_out.extend(frames)
        self._log_out.extend(frames)

    def note_down(self, record: Record) -> None:
        """For the log alone."""
        self._log_out.append(self._session.encode(record))

    def take(self, heard: tuple[bytes, ...], alive: bool) -> Output:
        """All that gathered since the last call, and for the log what was heard before it."""
        send, log = tuple(self._send_out), (*heard, *self._log_out)
        self._send_out, self._log_out = [], []
        return Output(send, log, alive)
