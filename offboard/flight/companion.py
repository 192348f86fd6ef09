"""The companion computer, sans-I/O: datagrams and times in, frames out. It owns no socket or file.

One instance flies one flight. Telemetry goes to the view and the observer; when vehicle time
crosses a multiple of the control period the phase table is asked, and `_emit` (the only place
that makes a setpoint; `_hand_over` for the autopilot's own loop) answers with at most one.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Hashable
from dataclasses import dataclass

import numpy as np

from offboard.control.base import (
    Adopting,
    Command,
    Controller,
    Decision,
    DecisionError,
    PositionCommand,
    PredictedState,
    Situation,
)
from offboard.control.observer import Observer
from offboard.flight.assessment import Assessment, Course
from offboard.flight.learning import RECORD_ID as IDENTIFIED_ID
from offboard.flight.learning import RECORD_NAME as IDENTIFIED_NAME
from offboard.flight.learning import Adoption, IdentifySettings, Learner
from offboard.flight.mission import Mission
from offboard.flight.phases import (
    BEFORE_FLIGHT,
    ENDS,
    PHASE_CODES,
    TRACKING,
    ExitCode,
    Limits,
    Phase,
)
from offboard.flight.readiness import Readiness
from offboard.flight.record import RECORD_ID, RECORD_NAME, TickRecord, reference_record
from offboard.flight.setpoint import LEVEL, clamp, usable
from offboard.flight.table import Row, next_row
from offboard.flight.view import VehicleView
from offboard.mavlink.dialect import TAKEOFF, Dialect, Takeoff
from offboard.mavlink.events import Attitude, Event, LocalPosition, Reset
from offboard.mavlink.outgoing import (
    AttitudeTarget,
    CommandLong,
    Outgoing,
    PositionTarget,
    Record,
    SolverRecord,
    StatusTextOut,
)
from offboard.mavlink.session import Session
from offboard.model.frames import course_from_quaternion
from offboard.model.vehicle import Vehicle

WARNING, INFO = 4, 6  # MAV_SEVERITY
ASK_AGAIN_S = 1.0  # between repetitions of a command the vehicle has not obeyed
SPOOL_UP_PER_S = 0.7  # thrust ramp before lift-off, in units of gravity
SPOOL_MAX = 1.6
TAKEOFF_HEIGHT_M = 3.0  # asked of an autopilot that takes off by itself; we take over on the way
LAND_STREAM_S = 3.0  # a refused landing ends in silence: the autopilot's own failsafe lands
BRIDGED_SHARE = 0.3  # of the longest silence, after which level setpoints bridge it


@dataclass(frozen=True, slots=True)
class Output:
    """What one call produced: frames to send, and all frames for the log, records included."""

    send: tuple[bytes, ...] = ()
    log: tuple[bytes, ...] = ()
    alive: bool = False  # the vehicle was heard: its state, once that flows


@dataclass(frozen=True, slots=True)
class Outcome:
    """How the flight ended: the exit code of the contract and one sentence."""

    exit_code: int
    sentence: str


class Companion:
    """Flies `mission` with `controller`. `stopwatch` reads seconds, for solve times only."""

    def __init__(
        self,
        *,
        vehicle: Vehicle,
        session: Session,
        observer: Observer,
        controller: Controller,
        mission: Mission,
        limits: Limits,
        period_s: float,
        deadline_s: float | None,
        stopwatch: Callable[[], float],
        learning: IdentifySettings | None = None,
    ) -> None:
        self._vehicle = vehicle
        self._session = session
        self._observer = observer
        self._controller = controller
        self._mission = mission
        self._limits = limits
        self._period_s = period_s
        self._deadline_s = deadline_s
        self._stopwatch = stopwatch
        self._readiness = Readiness()
        self.view = VehicleView()
        self._assessment = Assessment(
            self.view, session, mission, observer, self._readiness, limits
        )
        self._learner = _learner(vehicle, controller, period_s, learning)
        self.phase = Phase.CONNECT
        self.peer: Hashable | None = None  # where the vehicle's datagrams come from
        self.outcome: Outcome | None = None
        self.announced: list[str] = []
        self._phase_began_s = 0.0  # on the session's link time
        self._tick = -1
        self._missed_ticks = 0
        self._missed_decisions = 0
        self._failure = ""
        self._asked_s = -math.inf
        self._command = Command(0.0, LEVEL, 0.0)
        self._stop_requested = False
        self._rebooted = False
        self._silence_s = 0.0
        self._bridged_s = 0.0
        self._send_out: list[bytes] = []
        self._log_out: list[bytes] = []

    # ------------------------------------------------------------------ the outside calls these

    def has_ended(self) -> bool:
        return self.phase in ENDS

    def request_stop(self) -> None:
        """The operator wants the vehicle on the ground: obeyed at the next tick or poll."""
        self._stop_requested = True

    def receive(self, datagram: bytes, peer: Hashable, now_s: float) -> Output:
        """Take one datagram in, decide if it completes a tick, answer in order."""
        arrived_s = self._stopwatch()
        reception = self._session.receive(datagram, peer, now_s)
        if reception.events:
            self.peer = peer
        for event in reception.events:
            self._note(event)
        alive = any(self._is_sign_of_life(event) for event in reception.events)
        if alive:
            self._silence_s = self._bridged_s = 0.0
        if self.view.has_state and not self.has_ended():
            self._tick_if_due(arrived_s)
        self._collect(self._session.poll(now_s))
        for reply in reception.replies:
            self._send(reply)
        return self._output(reception.frames, alive)

    def poll(self, now_s: float, silence_s: float) -> Output:
        """Call when nothing arrives. `silence_s`: wall time since `Output.alive`."""
        self._silence_s = silence_s
        patience_s = min(self._limits.silence_s, self._limits.connect_s)
        if not self.has_ended() and (
            not self.view.has_state or self._stop_requested or silence_s > patience_s
        ):
            self._advance()
        if not self.has_ended() and silence_s > BRIDGED_SHARE * self._limits.silence_s:
            self._bridge_silence()
        self._collect(self._session.poll(now_s))
        return self._output((), False)

    # ------------------------------------------------------------------ telemetry in

    def _is_sign_of_life(self, event: Event) -> bool:
        """Whether the vehicle is heard: by its state once that flows, for without it vehicle time
        stands still and nothing is decided, whatever heartbeats say."""
        return isinstance(event, (Attitude, LocalPosition)) or not self.view.has_state

    def _note(self, event: Event) -> None:
        self.view.note(event)
        match event:
            case Attitude(time_s, attitude, rates):
                self._observer.on_attitude(time_s, attitude, rates)
                if self._learner:
                    self._learner.on_attitude(time_s, attitude)
            case LocalPosition(time_s, position, velocity):
                self._observer.on_position(time_s, position, velocity)
                if self._learner:
                    self._learner.on_position(time_s, position, velocity)
            case Reset():
                self._observer.reset()
                self._tick = -1
                self._asked_s = -math.inf
                self._rebooted = self.phase not in (Phase.CONNECT, Phase.HEALTH)
                self._advance()

    def _tick_if_due(self, arrived_s: float) -> None:
        time_s = self.view.time_s
        tick = math.floor(time_s / self._period_s + 1e-6)
        if tick <= self._tick:
            return
        self._missed_ticks = tick - self._tick - 1 if self._tick >= 0 else 0
        self._tick = tick
        self._advance()
        if not self.has_ended():
            self._act(time_s, arrived_s)

    # ------------------------------------------------------------------ phases

    def _advance(self) -> None:
        while not self.has_ended():
            course = Course(
                phase=self.phase,
                in_phase_s=self._in_phase_s(),
                silence_s=self._silence_s,
                rebooted=self._rebooted,
                stop_requested=self._stop_requested,
                missed_decisions=self._missed_decisions,
                failure=self._failure,
                excites=self._learner is not None and self._learner.wants_excitation,
                learnt=self._learner is not None and self._learner.finished(self.view.time_s),
            )
            picture = self._assessment.picture(course)
            row = next_row(self.phase, picture)
            if row is None:
                return
            self._enter(row, row.reason.format(**self._assessment.words(picture, course)))

    def _in_phase_s(self) -> float:
        return self._session.link_time_s - self._phase_began_s

    def _enter(self, row: Row, reason: str) -> None:
        self.announced.append(f"{row.target.value}: {reason}")
        self._conclude(row, reason)
        self.view.forget_words()
        self.phase = row.target
        self._phase_began_s = self._session.link_time_s
        self._asked_s = -math.inf
        self._send(StatusTextOut(INFO, f"offboard: {row.target.value}: {reason}"))
        if self._learner:
            self._learner.on_phase(row.target, self.view.time_s)
        if row.target is Phase.TAKEOFF:
            self._begin_takeoff()
        elif row.target is Phase.CLIMB:
            self._begin_climb(in_the_air=row.source is Phase.ENGAGE)
        elif row.target is Phase.JOIN:
            self._mission.join(self.view.time_s)

    def _conclude(self, row: Row, reason: str) -> None:
        """The first row with an exit code decides it; what follows is added to the sentence."""
        if row.exit_code is not None:
            if self.outcome is None:
                self.outcome = Outcome(row.exit_code, reason + self.view.explanation())
            else:
                said = f"{self.outcome.sentence}; {reason}"
                self.outcome = Outcome(self.outcome.exit_code, said)
        elif row.target is Phase.DISARMED and self.outcome is None:
            self.outcome = Outcome(ExitCode.FLOWN, "flown and landed")

    def _begin_takeoff(self) -> None:
        assert self.view.position is not None
        self._mission.settle(self.view.position.position_ned_m)

    def _begin_climb(self, *, in_the_air: bool) -> None:
        assert self.view.position is not None
        north, east, down = self.view.position.position_ned_m
        velocity = np.array(self.view.position.velocity_ned_mps)
        if in_the_air:  # nobody saw the take-off: below us, at the height of the local origin
            self._mission.settle((north, east, 0.0))
        self._observer.freeze(False)
        if self._learner and isinstance(self._controller, Adopting):
            self._controller.adopt(self._vehicle, self._learner.cautious_bandwidth_radps)
        self._mission.lift_off(
            self.view.time_s, np.array([north, east, down]), velocity, self._course_rad()
        )

    # ------------------------------------------------------------------ actions of one tick

    def _act(self, time_s: float, arrived_s: float) -> None:
        if self.phase in BEFORE_FLIGHT:
            self._observer.freeze(True)
            self._prepare(time_s)
        elif self.phase is Phase.TAKEOFF and self._lifted_by_command:
            self._watch_takeoff(time_s)
        elif self.phase is Phase.TAKEOFF:
            spool = min(SPOOL_MAX, SPOOL_UP_PER_S * self._in_phase_s())
            thrust_mps2 = spool * self._vehicle.gravity_mps2
            self._emit(time_s, Command(thrust_mps2, LEVEL, self._command.course_rad))
        elif self.phase in TRACKING:
            self._decide(time_s, arrived_s)
        else:
            self._hold(time_s)

    def _prepare(self, time_s: float) -> None:
        if self.phase is Phase.HEALTH:
            known, now_s = self.view.parameters, self._session.link_time_s
            for request in self._readiness.due(self._dialect, known, now_s):
                self._send(request)
            stale = self.view.mode == self._dialect.engage_mode and not self.view.armed
            if stale and not self.view.prearm_ok:  # PX4 shows OFFBOARD again after a landing
                self._ask(self._dialect.hold(), time_s)
            return
        if self.phase is Phase.ENGAGE:
            self._ask(self._dialect.engage(), time_s)
        elif self.phase is Phase.ARM:
            self._ask(CommandLong.arm(), time_s)
        # On the ground without thrust; in the air with what takes over from the autopilot
        flying = self.view.armed and self.view.in_the_air
        if self._lifted_by_command and not flying:
            return
        thrust_mps2 = self._hover_mps2() if flying else 0.0
        self._emit(time_s, Command(thrust_mps2, LEVEL, self._course_rad()))

    def _watch_takeoff(self, time_s: float) -> None:
        """The autopilot lifts off; a setpoint without thrust would cancel that, so none is sent.

        Its thrust is about what hovers, which the observer must know to take over from it.
        """
        if TAKEOFF not in self.view.accepted:
            self._ask(self._dialect.take_off(TAKEOFF_HEIGHT_M), time_s)
        self._command = Command(self._vehicle.gravity_mps2, LEVEL, self._course_rad())
        self._observer.on_command(time_s, self._command)

    def _hold(self, time_s: float) -> None:
        """What a phase does that needs no state: level, and the request that ends the flight."""
        if self._lifted_by_command and self._mission.reference is None:
            self._hold_on_the_ground(time_s)
        elif self.phase is Phase.TAKEOFF or self.phase in TRACKING:
            self._emit(time_s, self._level())
        elif self.phase is Phase.LAND:
            if not self._has_the_vehicle:
                return
            self._ask(self._dialect.land(), time_s)
            if self._in_phase_s() < LAND_STREAM_S:
                self._emit(time_s, self._level())
        elif self.phase is Phase.STAND_DOWN:
            self._ask(CommandLong.disarm(), time_s)
            self._emit(time_s, Command(0.0, LEVEL, self._command.course_rad))

    def _hold_on_the_ground(self, time_s: float) -> None:
        """Without setpoints: not ours to fly before the autopilot's takeoff is taken over."""
        if self.phase is Phase.LAND and self._has_the_vehicle:
            self._ask(self._dialect.land(), time_s)
        elif self.phase is Phase.STAND_DOWN:
            self._ask(CommandLong.disarm(), time_s)

    def _bridge_silence(self) -> None:
        """Telemetry stopped: go on without, each period of wall time, until the table ends it."""
        if self._silence_s - self._bridged_s >= self._period_s:
            self._bridged_s = self._silence_s
            self._hold(self.view.time_s + self._silence_s)

    def _decide(self, time_s: float, arrived_s: float) -> None:
        reference = self._mission.reference
        assert reference is not None
        try:
            state = self._observer.predict(time_s)
            situation = Situation(
                time_s,
                state,
                reference,
                previous=self._command,
                deadline_s=self._deadline_s,
                origin_ned_m=self._mission.origin_ned_m,
                track_time_s=self._mission.track_time_s(time_s),
            )
            decision = self._controller.decide(situation)
            command = decision.command
            if isinstance(command, Command):
                command = clamp(self._excited(command, time_s), self._vehicle)
            if not usable(command):
                raise DecisionError(f"unusable {command}")
        except Exception as error:  # whatever it is, the vehicle is in the air
            self._miss(f"{type(error).__name__}: {error}")
            self._emit(time_s, self._level())
            return
        self._missed_decisions = 0
        if isinstance(command, PositionCommand):
            self._hand_over(time_s, command)
        else:
            body_z_down = float(state.thrust_direction_ned[2])
            self._emit(time_s, command, body_z_down)
        self._record(time_s, state, decision, arrived_s)
        self._learn(time_s)

    def _excited(self, command: Command, time_s: float) -> Command:
        if self._learner is None or self.phase is not Phase.EXCITE:
            return command
        return self._learner.excited(command, time_s, self._assessment.position_error_m())

    def _learn(self, time_s: float) -> None:
        """After the setpoint has left, so that it waits for nothing."""
        if self._learner is None:
            return
        try:
            adoption = self._learner.learn(self.phase, time_s)
            if adoption is not None:
                self._adopt(time_s, adoption)
        except Exception as error:  # flying on with what is believed is always possible
            self._learner.give_up()
            self._send(StatusTextOut(WARNING, f"identification ended: {error}"))

    def _adopt(self, time_s: float, adoption: Adoption) -> None:
        assert isinstance(self._controller, Adopting)
        limit = adoption.bandwidth_limit_radps
        self._controller.adopt(adoption.vehicle, limit, gains=adoption.gains)
        self._observer.adopt(adoption.vehicle)
        self._vehicle = adoption.vehicle
        if adoption.record:
            record = SolverRecord(time_s, adoption.record, IDENTIFIED_ID, IDENTIFIED_NAME)
            self._note_down(record)
        for sentence in adoption.sentences:
            self.announced.append(sentence)
            self._send(StatusTextOut(INFO, sentence))

    def _miss(self, failure: str) -> None:
        self._missed_decisions += 1
        self._failure = failure
        self._send(StatusTextOut(WARNING, f"decision missed: {failure}"))

    def _level(self) -> Command:
        """Level, at the thrust that hovers; before lift-off at the thrust reached."""
        flying = self._mission.reference is not None
        thrust_mps2 = self._hover_mps2() if flying else self._command.thrust_mps2
        return Command(thrust_mps2, LEVEL, self._command.course_rad)

    def _hover_mps2(self) -> float:
        """Thrust that holds the weight, by the observer's account."""
        share = self._observer.hover_thrust_estimate / self._vehicle.hover_thrust
        return (share if math.isfinite(share) else 1.0) * self._vehicle.gravity_mps2

    def _course_rad(self) -> float:
        assert self.view.attitude is not None
        return float(course_from_quaternion(np.array(self.view.attitude.attitude)))

    @property
    def _lifted_by_command(self) -> bool:
        dialect = self._session.dialect
        return dialect is not None and dialect.takeoff is Takeoff.COMMAND

    @property
    def _has_the_vehicle(self) -> bool:
        """The vehicle obeys us: in any other mode it lands, or a failsafe or a pilot has it."""
        return self.view.mode == self._dialect.engage_mode

    @property
    def _dialect(self) -> Dialect:
        assert self._session.dialect is not None
        return self._session.dialect

    # ------------------------------------------------------------------ frames out

    def _ask(self, request: Outgoing, time_s: float) -> None:
        """Send a command, and again while it is not obeyed; the heartbeat is the verdict."""
        if time_s - self._asked_s >= ASK_AGAIN_S - 1e-6:
            self._asked_s = time_s
            self._send(request)

    def _emit(self, time_s: float, command: Command, body_z_down: float | None = None) -> None:
        """The one place that emits a setpoint. `body_z_down`: of the body, when it acts."""
        self._command = command
        self._observer.on_command(time_s, command)
        if self._learner:
            self._learner.on_command(time_s, command)
        self._send(
            AttitudeTarget(
                time_s=time_s,
                thrust_mps2=command.thrust_mps2,
                thrust_direction_ned=command.thrust_direction_ned,
                course_rad=command.course_rad,
                hover_thrust=self._vehicle.hover_thrust,
                gravity_mps2=self._vehicle.gravity_mps2,
                body_z_down=body_z_down,
            )
        )

    def _hand_over(self, time_s: float, command: PositionCommand) -> None:
        """Emit a setpoint for the autopilot's own position loop. What it commands its attitude
        loop is not ours to know: the observer only listens."""
        self._observer.freeze(True)
        self._command = Command(self._vehicle.gravity_mps2, LEVEL, command.course_rad)
        self._send(
            PositionTarget(
                time_s=time_s,
                position_ned_m=command.position_ned_m,
                velocity_ned_mps=command.velocity_ned_mps,
                acceleration_ned_mps2=command.acceleration_ned_mps2,
                course_rad=command.course_rad,
                course_rate_radps=command.course_rate_radps,
            )
        )

    def _record(
        self, time_s: float, state: PredictedState, decision: Decision, arrived_s: float
    ) -> None:
        sample = self._mission.sample(time_s)
        assert sample is not None
        self._note_down(reference_record(time_s, sample))
        record = TickRecord.of(
            phase=PHASE_CODES[self.phase],
            decision=decision,
            state=state,
            lateness_s=self._stopwatch() - arrived_s,
            missed_ticks=self._missed_ticks,
            hover_thrust=self._observer.hover_thrust_estimate,
            track_time_s=self._mission.track_time_s(time_s),
        )
        self._note_down(SolverRecord(time_s, record.data(), RECORD_ID, RECORD_NAME))

    def _note_down(self, record: Record) -> None:
        """For the log alone."""
        self._log_out.append(self._session.encode(record))

    def _send(self, outgoing: Outgoing) -> None:
        self._collect((self._session.encode(outgoing),))

    def _collect(self, frames: tuple[bytes, ...]) -> None:
        self._send_out.extend(frames)
        self._log_out.extend(frames)

    def _output(self, heard: tuple[bytes, ...], alive: bool) -> Output:
        send, log = tuple(self._send_out), (*heard, *self._log_out)
        self._send_out, self._log_out = [], []
        return Output(send, log, alive)


def _learner(
    vehicle: Vehicle, controller: Controller, period_s: float, settings: IdentifySettings | None
) -> Learner | None:
    """Nothing is learnt for a controller that could not take it over."""
    if settings is None or not settings.online or not isinstance(controller, Adopting):
        return None
    bandwidth = controller.bandwidth_radps
    return Learner(vehicle, settings, period_s=period_s, bandwidth_radps=bandwidth)
