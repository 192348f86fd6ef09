"""One flight with given parts: start the simulator, rehearse, connect, fly, close.

Everything slow (compilation, start of a simulator) happens before telemetry is read.
"""

from __future__ import annotations

import math
import traceback
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import astuple, dataclass, replace
from pathlib import Path

import numpy as np

from offboard.compiled import prepare
from offboard.control.base import Controller, Situation
from offboard.documents.reading import DocumentError
from offboard.estimation.observer import Observer
from offboard.flight import manifest
from offboard.flight.companion import Companion, Outcome
from offboard.flight.flight_plan import FlightPlan
from offboard.flight.gate import usable
from offboard.flight.online_identification import IdentifySettings
from offboard.flight.phases import Limits
from offboard.flight.record import COMPONENT_ID, RECORD_COMPONENT_ID
from offboard.link import clock
from offboard.link.connection import open_link, open_lockstep_link
from offboard.link.interface import Link
from offboard.link.log import FlightLog
from offboard.link.signing_time import SigningTime
from offboard.link.stop import StopRequests
from offboard.mavlink.session import DIALECTS, Session, SessionSettings
from offboard.mavlink.signing import Signing
from offboard.model.command import Command, PositionCommand
from offboard.model.vehicle import Vehicle
from offboard.reference.track import Track
from offboard.reference.transfer import Hold
from offboard.run.in_memory import InMemorySimulator
from offboard.run.loop import Loop
from offboard.run.sitl import SimulatorProcess
from offboard.supervisor.supervisor import Supervisor

REHEARSED_DECISIONS = 5  # the fastest counts: the machine may be busy
DISCARDED_MAX = 20  # batches of a link
SITL_TIMEOUT_S = 180.0  # for simulator and companion in lockstep: either may compile, or be slow


@dataclass(frozen=True, slots=True)
class Bundled:
    """A vehicle of the bundled simulator, in lockstep. `scenario` and `vehicle` None: the defaults
    of the firmware."""

    simulator: SimulatorProcess | InMemorySimulator
    scenario: str | None
    seed: int
    vehicle: str | None = None
    firmware: str = "px4"
    signing_key: Path | None = None

    def open_link(self) -> Link:
        """Start the vehicle and return the link to it."""
        if isinstance(self.simulator, InMemorySimulator):
            return self.simulator.open_link(
                firmware=self.firmware,
                scenario=self.scenario,
                vehicle=self.vehicle,
                seed=self.seed,
                parameters=self._parameters(),
            )
        link = open_lockstep_link()
        self.simulator.launch(self.options(link.port))
        return link

    def options(self, port: int) -> list[str]:
        """Options of the `simulator` command, for a vehicle that sends to our local `port`."""
        return [
            *("--connect", f"udpout:127.0.0.1:{port}", "--gcs", "none", "--lockstep"),
            *("--patience", f"{SITL_TIMEOUT_S:g}"),
            *("--seed", str(self.seed), "--firmware", self.firmware),
            *(("--scenario", self.scenario) if self.scenario else ()),
            *(("--vehicle", self.vehicle) if self.vehicle else ()),
            *(("--signing-key", str(self.signing_key.absolute())) if self.signing_key else ()),
            *(f"--param={name}={value:g}" for name, value in self._parameters().items()),
        ]

    def _parameters(self) -> dict[str, float]:
        """Parameters that a user must set once on this autopilot."""
        dialect = DIALECTS.get(self.firmware)
        watched = dialect.watched_parameters if dialect else ()
        return {p.name: float(p.required_bits) for p in watched if p.required_bits}


@dataclass(frozen=True, slots=True)
class FlightParts:
    """Parts of one flight, see `request.build_parts`. `deadline_s`: wall time of one decision."""

    vehicle: Vehicle
    controller: Controller
    make_observer: Callable[[], Observer]
    track: Track
    limits: Limits
    period_s: float
    deadline_s: float
    identify: IdentifySettings | None = None


def rehearse(parts: FlightParts, *, keeps_deadline: bool) -> float:
    """Call every code path of observer and controller, so that nothing is compiled in flight.

    A pause of seconds at the first decision in flight is a crash. Returns the wall time of the
    shortest possible decision, measured with `keeps_deadline`. Raises DocumentError if the control
    law fails or, with `keeps_deadline`, if a decision cannot meet the deadline.
    """
    observer = parts.make_observer()
    reference = Hold((0.0, 0.0, -2.0), 0.1)
    previous = Command(parts.vehicle.gravity_mps2, (0.0, 0.0, 1.0), 0.0)
    observer.freeze(True)
    for step in range(60):
        time_s = 0.01 * step
        if step == 20:
            observer.freeze(False)
        observer.on_attitude(time_s, (1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
        observer.on_position(time_s, (0.0, 0.0, -2.0), (0.0, 0.0, 0.0))
        if step >= 20 and step % 10 == 0:
            state = observer.predict(time_s)
            situation = Situation(time_s, state, reference, previous, lambda: parts.deadline_s)
            command = _decided(parts.controller, situation)
            if isinstance(command, Command):
                previous = command
                observer.on_command(time_s, command)
    least_s = math.nan
    if keeps_deadline:
        least_s = _check_deadline(parts, replace(situation, remaining_s=lambda: 0.0))
    parts.track.sample(np.array([0.0, 1.0]))
    parts.controller.reset()
    return least_s


def _decided(controller: Controller, situation: Situation) -> Command | PositionCommand:
    """The command of a decision. Raises DocumentError if the law fails: better here than in
    flight."""
    try:
        decision = controller.decide(situation)
        command = decision.command
        [float(figure) for figure in astuple(decision.certificate)]  # as the log will have them
    except Exception as error:
        where = traceback.extract_tb(error.__traceback__)[-1]
        raise DocumentError(
            f"controller: {type(error).__name__}: {error} ({where.filename}:{where.lineno})"
        ) from error
    if not usable(command):
        raise DocumentError(f"controller: it decides {command}, which cannot be sent")
    return command


def _check_deadline(parts: FlightParts, cut_short: Situation) -> float:
    """The shortest possible decision must meet the deadline; returns its time."""
    least_s = needed_s = math.inf
    for _ in range(REHEARSED_DECISIONS):
        began_s, computed_s = clock.monotonic_s(), clock.thread_s()
        parts.controller.decide(cut_short)
        least_s = min(least_s, clock.monotonic_s() - began_s)
        needed_s = min(needed_s, clock.thread_s() - computed_s)
    if least_s > parts.deadline_s >= needed_s:
        raise DocumentError(
            f"this computer is too busy: a decision needs {1e3 * needed_s:.1f} ms of its processor "
            f"and takes {1e3 * least_s:.1f} ms; close other programs"
        )
    if least_s > parts.deadline_s:
        raise DocumentError(
            f"controller: a decision takes at least {1e3 * least_s:.1f} ms here, longer than "
            f"deadline_s ({1e3 * parts.deadline_s:.1f} ms); plan fewer steps or allow more time"
        )
    return least_s


def fly(
    parts: FlightParts,
    log: FlightLog,
    *,
    connection: str,
    bundled: Bundled | None,
    system_id: int | None = None,
    signing_key: bytes | None = None,
    stops: StopRequests,
    progress: Callable[[Companion], None],
    tell: Callable[[str], None] = lambda sentence: None,
) -> Outcome:
    """Fly once over `connection`, or on the `bundled` simulator. `system_id`: of the vehicle, where
    several send; `signing_key`: of MAVLink 2 signing.

    Raises LinkError, DocumentError, SupervisorError, SigningTimeError or LogError before anything
    is sent, and KeyboardInterrupt if a stop was requested meanwhile. The log is created last: a
    flight that cannot begin leaves no directory. `tell` is called with sentences about the
    preparation.
    """
    with ExitStack() as stack:
        log.check()
        link = bundled.open_link() if bundled else open_link(connection)
        stack.callback(link.close)
        if bundled:
            stack.callback(bundled.simulator.recall)
        signing = None
        if signing_key:  # in lockstep no stamp depends on the clock
            kept = SigningTime(signing_key)
            signing = Signing(signing_key) if bundled else stack.enter_context(kept)
        supervisor = None if bundled else stack.enter_context(Supervisor(signing))
        tell("preparing the controller")
        prepare(tell)
        rehearse(parts, keeps_deadline=bundled is None)
        if supervisor:
            supervisor.await_ready()
        stops.check()
        stack.enter_context(log)
        observer = parts.make_observer()
        session = session_of(
            signing,
            system_id=system_id,
            stream=link.is_stream,
            capacity_bytes_ps=None if bundled else link.capacity_bytes_ps,
            lockstep=bundled is not None,
            sends_first=not (bundled or connection.startswith("udpin")),
        )
        for piece in manifest.pieces(log.configuration):
            log.begin(clock.unix_us(), session.encode(piece))
        loop = Loop(
            companion_of(parts, session, observer, clock.monotonic_s),
            link,
            log,
            stops=stops,
            progress=progress,
            simulator_ended=bundled.simulator.ended if bundled else lambda: None,
            patience_s=SITL_TIMEOUT_S if bundled else math.inf,
            supervisor=supervisor,
        )
        if supervisor:
            discard(link)
        return loop.run()


def discard(link: Link) -> None:
    """Drop the telemetry that arrived during the preparation: it is too old to use."""
    for _ in range(DISCARDED_MAX):
        if not link.receive(0.0):
            return


def session_of(
    signing: Signing | None = None,
    *,
    system_id: int | None = None,
    stream: bool,
    capacity_bytes_ps: float | None,
    lockstep: bool,
    sends_first: bool,
) -> Session:
    """The session of a flight; see `SessionSettings`."""
    return Session(
        SessionSettings(
            system_id=system_id,
            component_id=COMPONENT_ID,
            record_component_id=RECORD_COMPONENT_ID,
            stream=stream,
            capacity_bytes_ps=capacity_bytes_ps,
            lockstep=lockstep,
            sends_first=sends_first,
        ),
        signing,
    )


def companion_of(
    parts: FlightParts, session: Session, observer: Observer, stopwatch: Callable[[], float]
) -> Companion:
    """The companion of a flight with these parts. `stopwatch` reads host time."""
    return Companion(
        vehicle=parts.vehicle,
        session=session,
        observer=observer,
        controller=parts.controller,
        plan=FlightPlan(parts.track),
        limits=parts.limits,
        period_s=parts.period_s,
        deadline_s=None if session.settings.lockstep else parts.deadline_s,
        stopwatch=stopwatch,
        identify=parts.identify,
    )
