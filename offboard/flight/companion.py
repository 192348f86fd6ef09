"""The companion computer, sans-I/O: datagrams and times in, frames out. It owns no socket or file.

One instance flies one flight. Telemetry goes to the view and the observer; when vehicle time
crosses a multiple of the control period the phase table is asked, and `_emit` (the only place
that makes a setpoint) answers with at most one SET_ATTITUDE_TARGET.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Hashable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from offboard.control.base import Command, Controller, Decision, PredictedState, Situation
from offboard.control.observer import Observer
from offboard.flight.mission import Mission
from offboard.flight.phases import (
    ENDS,
    ON_GROUND,
    PHASES,
    UNDER_CONTROL,
    ExitCode,
    Limits,
    Phase,
    Picture,
    Row,
    next_row,
)
from offboard.flight.record import RECORD_ID, RECORD_NAME, TickRecord
from offboard.flight.view import VehicleView
from offboard.mavlink.dialect import Dialect
from offboard.mavlink.events import Attitude, Event, LocalPosition, Reset
from offboard.mavlink.outgoing import (
    AttitudeTarget,
    CommandLong,
    Outgoing,
    ReferenceRecord,
    SolverRecord,
    StatusTextOut,
)
from offboard.mavlink.session import Session
from offboard.model.frames import course_from_quaternion, thrust_direction_from_quaternion
from offboard.model.vehicle import Vehicle

Array = NDArray[np.float64]
INFO = 6  # MAV_SEVERITY
LEVEL = (0.0, 0.0, 1.0)
ASK_AGAIN_S = 1.0  # between repetitions of a command the vehicle has not obeyed
SPOOL_UP_PER_S = 0.7  # thrust ramp before lift-off, in units of gravity
SPOOL_MAX = 1.6
LIFT_OFF_HEIGHT_M = 0.15
LIFT_OFF_CLIMB_MPS = 0.4
LAND_STREAM_S = 3.0  # a refused landing ends in silence: the autopilot's own failsafe lands
MINIMUM_TELEMETRY_HZ = 10.0


@dataclass(frozen=True, slots=True)
class Output:
    """What one call produced, in order: frames heard (for the log), then frames to send."""

    heard: tuple[bytes, ...] = ()
    alive: bool = False  # the vehicle itself said something
    send: tuple[bytes, ...] = ()


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
        self.view = VehicleView()
        self._peer: Hashable | None = None
        self.phase = Phase.CONNECT
        self.outcome: Outcome | None = None
        self._row: Row | None = None
        self._phase_began_s = math.nan  # vehicle time, or link time before telemetry
        self._tick = -1
        self._missed = 0
        self._asked_s = -math.inf
        self._last_emit_s = -math.inf
        self._command = Command(0.0, LEVEL, 0.0)
        self._ground_height_m = 0.0
        self._stop_requested = False
        self._failure = ""
        self._silence_s = 0.0
        self._out: list[bytes] = []
        self.announced: list[str] = []

    # ------------------------------------------------------------------ the outside calls these

    @property
    def peer(self) -> Hashable | None:
        """Where the vehicle is: the peer that its datagrams come from."""
        return self._peer

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
            self._silence_s = 0.0
            self._peer = peer
        for event in reception.events:
            self._note(event)
        if self.view.has_state and not self.has_ended():
            self._tick_if_due(now_s, arrived_s)
        self._out.extend(self._session.poll(now_s))
        send = (*self._take(), *reception.replies)
        return Output(reception.frames, bool(reception.events), send)

    def poll(self, now_s: float, silence_s: float) -> Output:
        """Call when nothing arrives. `silence_s`: wall time since the last datagram."""
        self._silence_s = silence_s
        if not self.has_ended():
            if (
                not self.view.has_state
                or silence_s > self._limits.silence_s
                or self._stop_requested
            ):
                self._advance(now_s)
            if self.phase in UNDER_CONTROL and silence_s > 0.3 * self._limits.silence_s:
                self._bridge_silence(now_s, silence_s)
        self._out.extend(self._session.poll(now_s))
        return Output(send=self._take())

    # ------------------------------------------------------------------ telemetry in

    def _note(self, event: Event) -> None:
        self.view.note(event)
        match event:
            case Attitude(time_s, attitude, rates):
                self._observer.on_attitude(time_s, attitude, rates)
            case LocalPosition(time_s, position, velocity):
                self._observer.on_position(time_s, position, velocity)
            case Reset():
                self._observer.reset()
                self._tick = -1

    def _tick_if_due(self, now_s: float, arrived_s: float) -> None:
        time_s = self.view.time_s
        tick = math.floor(time_s / self._period_s + 1e-6)
        if tick <= self._tick:
            return
        self._missed = tick - self._tick - 1 if self._tick >= 0 else 0
        self._tick = tick
        self._advance(now_s)
        if not self.has_ended():
            self._act(time_s, arrived_s)

    # ------------------------------------------------------------------ phases

    def _advance(self, now_s: float) -> None:
        clock_s = self.view.time_s if self.view.has_state else now_s
        if math.isnan(self._phase_began_s):
            self._phase_began_s = clock_s
        while (row := next_row(self.phase, self._picture(clock_s))) is not None:
            self._enter(row, clock_s)

    def _enter(self, row: Row, clock_s: float) -> None:
        picture = self._picture(clock_s)
        reason = row.reason.format(**self._words(picture))
        self.announced.append(f"{row.target.value}: {reason}")
        if row.exit_code is not None and (self._row is None or self._row.exit_code is None):
            self._row = row
            self.outcome = Outcome(row.exit_code, reason + self.view.explanation())
        self.phase = row.target
        self._phase_began_s = clock_s
        self._asked_s = -math.inf
        self._send(StatusTextOut(INFO, f"offboard: {row.target.value}: {reason}"[:50]))
        if row.target is Phase.TAKEOFF:
            self._begin_takeoff()
        elif row.target is Phase.CLIMB:
            self._begin_climb()
        elif row.target is Phase.JOIN:
            self._mission.join(self.view.time_s)
        elif row.target is Phase.DISARMED and self.outcome is None:
            self.outcome = Outcome(ExitCode.FLOWN, "flown and landed")

    def _begin_takeoff(self) -> None:
        assert self.view.position is not None
        self._mission.settle(self.view.position.position_ned_m)
        self._ground_height_m = -self.view.position.position_ned_m[2]

    def _begin_climb(self) -> None:
        assert self.view.position is not None
        self._observer.freeze(False)
        self._mission.lift_off(
            self.view.time_s,
            np.array(self.view.position.position_ned_m),
            np.array(self.view.position.velocity_ned_mps),
            self._course_rad(),
        )

    def _picture(self, clock_s: float) -> Picture:
        view, mission, time_s = self.view, self._mission, self.view.time_s
        track, dialect = mission.track, self._session.dialect
        return Picture(
            limits=self._limits,
            in_phase_s=0.0 if math.isnan(self._phase_began_s) else clock_s - self._phase_began_s,
            silence_s=self._silence_s,
            found=view.found is not None,
            telemetry_ok=view.has_state and self._telemetry_hz() >= MINIMUM_TELEMETRY_HZ,
            prearm_ok=view.prearm_ok,
            configured=True,
            engaged=dialect is not None and view.mode == dialect.engage_mode,
            armed=view.armed,
            airborne=view.landed == "in_air",
            lifted_off=self._lifted_off(),
            at_start=self._at_start(time_s),
            track_time_s=mission.track_time_s(time_s),
            track_start_s=track.track_start_s,
            track_end_s=track.track_end_s,
            rest_time_s=track.duration_s + 0.5,
            position_error_m=self._position_error_m(),
            tilt_rad=self._tilt_rad(),
            stop_requested=self._stop_requested,
            controller_failed=bool(self._failure),
        )

    def _words(self, picture: Picture) -> dict[str, object]:
        """The figures that a row's reason may quote."""
        dialect = self._session.dialect
        return {
            "mode": self.view.mode,
            "mode_wanted": dialect.engage_mode if dialect else "offboard mode",
            "silence_s": picture.silence_s,
            "in_phase_s": picture.in_phase_s,
            "tilt_deg": math.degrees(picture.tilt_rad),
            "position_error_m": picture.position_error_m,
            "position_error_limit_m": self._limits.position_error_m,
            "failure": self._failure,
            "unready": self._unready(),
        }

    def _unready(self) -> str:
        if not self.view.has_state:
            return "no LOCAL_POSITION_NED or ATTITUDE_QUATERNION arrives"
        if self._telemetry_hz() < MINIMUM_TELEMETRY_HZ:
            return (
                f"telemetry arrives at {self._telemetry_hz():.1f} Hz, "
                f"{MINIMUM_TELEMETRY_HZ:.0f} Hz are needed"
            )
        return "its pre-arm checks do not pass"

    def _telemetry_hz(self) -> float:
        rates = self._session.rates_hz
        return min(rates.get(name, 0.0) for name in ("LOCAL_POSITION_NED", "ATTITUDE_QUATERNION"))

    # ------------------------------------------------------------------ facts from the state

    def _course_rad(self) -> float:
        assert self.view.attitude is not None
        return float(course_from_quaternion(np.array(self.view.attitude.attitude)))

    def _tilt_rad(self) -> float:
        if self.view.attitude is None:
            return 0.0
        down = thrust_direction_from_quaternion(np.array(self.view.attitude.attitude))[2]
        return math.acos(min(1.0, max(-1.0, float(down))))

    def _lifted_off(self) -> bool:
        position = self.view.position
        if position is None or self.phase is not Phase.TAKEOFF:
            return False
        height_m = -position.position_ned_m[2] - self._ground_height_m
        return height_m > LIFT_OFF_HEIGHT_M or -position.velocity_ned_mps[2] > LIFT_OFF_CLIMB_MPS

    def _position_error_m(self) -> float:
        position = self.view.position
        sample = self._mission.sample(position.time_s) if position else None
        if position is None or sample is None:
            return 0.0
        return float(np.linalg.norm(np.array(position.position_ned_m) - sample.position_ned_m))

    def _at_start(self, time_s: float) -> bool:
        if self.phase is not Phase.CLIMB or self.view.position is None:
            return False
        state = self._observer.predict(time_s)
        position = np.array(self.view.position.position_ned_m)
        return self._mission.at_start(time_s, position, state.velocity_ned_mps)

    # ------------------------------------------------------------------ actions of one tick

    def _act(self, time_s: float, arrived_s: float) -> None:
        if self.phase in ON_GROUND:
            self._observer.freeze(True)
        if self.phase is Phase.ENGAGE:
            self._ask(self._dialect.engage(), time_s)
        elif self.phase is Phase.ARM:
            self._ask(CommandLong.arm(), time_s)
        elif self.phase is Phase.LAND and self.view.mode != self._dialect.land_mode:
            self._ask(self._dialect.land(), time_s)
        if self.phase in (Phase.STREAM, Phase.ENGAGE, Phase.ARM):
            self._emit(time_s, Command(0.0, LEVEL, self._course_rad()))
        elif self.phase is Phase.TAKEOFF:
            in_phase_s = time_s - self._phase_began_s
            spool = min(SPOOL_MAX, SPOOL_UP_PER_S * in_phase_s) * self._vehicle.gravity_mps2
            self._emit(time_s, Command(spool, LEVEL, self._command.course_rad))
        elif self.phase is Phase.LAND:
            if self._engaged_still() and time_s - self._phase_began_s < LAND_STREAM_S:
                self._emit(time_s, self._level())
        elif self.phase in UNDER_CONTROL:
            self._decide(time_s, arrived_s)

    @property
    def _dialect(self) -> Dialect:
        assert self._session.dialect is not None
        return self._session.dialect

    def _engaged_still(self) -> bool:
        return self.view.mode == self._dialect.engage_mode

    def _decide(self, time_s: float, arrived_s: float) -> None:
        reference = self._mission.reference
        assert reference is not None
        state = self._observer.predict(time_s)
        situation = Situation(time_s, state, reference, self._command, self._deadline_s)
        try:
            decision = self._controller.decide(situation)
        except (ArithmeticError, ValueError, np.linalg.LinAlgError) as error:
            self._failure = f"{type(error).__name__}: {error}"
            self._emit(time_s, self._level())
            return
        if not _finite(decision.command):
            self._failure = "the decision was not finite"
            self._emit(time_s, self._level())
            return
        self._emit(time_s, decision.command)
        self._record(time_s, state, decision, arrived_s)

    def _level(self) -> Command:
        """Level, at the thrust that hovers by the observer's account."""
        hover = self._observer.hover_thrust_estimate / self._vehicle.hover_thrust
        return Command(hover * self._vehicle.gravity_mps2, LEVEL, self._command.course_rad)

    def _bridge_silence(self, now_s: float, silence_s: float) -> None:
        """Telemetry stopped: level hold, then a landing request; the table ends it in silence."""
        if now_s - self._last_emit_s < self._period_s:
            return
        self._last_emit_s = now_s
        self._emit(self.view.time_s + silence_s, self._level())
        if silence_s > 0.7 * self._limits.silence_s:
            self._ask(self._dialect.land(), self.view.time_s + silence_s)

    # ------------------------------------------------------------------ frames out

    def _ask(self, request: Outgoing, time_s: float) -> None:
        """Send a command, and again while it is not obeyed; the heartbeat is the verdict."""
        if time_s - self._asked_s >= ASK_AGAIN_S - 1e-6:
            self._asked_s = time_s
            self._send(request)

    def _emit(self, time_s: float, command: Command) -> None:
        """The one place that emits a setpoint."""
        self._command = command
        self._observer.on_command(time_s, command)
        self._send(
            AttitudeTarget(
                time_s=time_s,
                thrust_mps2=command.thrust_mps2,
                thrust_direction_ned=command.thrust_direction_ned,
                course_rad=command.course_rad,
                hover_thrust=self._vehicle.hover_thrust,
                gravity_mps2=self._vehicle.gravity_mps2,
            )
        )

    def _record(
        self, time_s: float, state: PredictedState, decision: Decision, arrived_s: float
    ) -> None:
        sample = self._mission.sample(time_s)
        assert sample is not None
        self._send(
            ReferenceRecord(
                time_s=time_s,
                position_ned_m=_triple(sample.position_ned_m),
                velocity_ned_mps=_triple(sample.velocity_ned_mps),
                acceleration_ned_mps2=_triple(sample.acceleration_ned_mps2),
                course_rad=float(sample.course_rad),
                course_rate_radps=float(sample.course_rate_radps),
            )
        )
        record = TickRecord.of(
            phase=PHASES.index(self.phase),
            decision=decision,
            state=state,
            lateness_s=self._stopwatch() - arrived_s,
            missed_ticks=self._missed,
            hover_thrust=self._observer.hover_thrust_estimate,
            track_time_s=self._mission.track_time_s(time_s),
        )
        self._send(SolverRecord(time_s, record.data(), RECORD_ID, RECORD_NAME))

    def _send(self, outgoing: Outgoing) -> None:
        self._out.append(self._session.encode(outgoing))

    def _take(self) -> tuple[bytes, ...]:
        taken, self._out = tuple(self._out), []
        return taken


def _finite(command: Command) -> bool:
    values = (command.thrust_mps2, *command.thrust_direction_ned, command.course_rad)
    return all(math.isfinite(value) for value in values)


def _triple(values: Array) -> tuple[float, float, float]:
    return float(values[0]), float(values[1]), float(values[2])
