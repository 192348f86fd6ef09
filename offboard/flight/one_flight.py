"""One flight with given parts: start the simulator, rehearse, connect, fly, close.

Everything slow (compilation, start of a simulator) happens before telemetry is read.
"""

from __future__ import annotations

import math
import traceback
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import astuple, dataclass, replace

import numpy as np

from offboard.compiled import prepare
from offboard.control.base import Controller, Situation
from offboard.documents.reading import DocumentError
from offboard.estimation.fusion import FusedObserver
from offboard.estimation.observer import Observer
from offboard.flight import clock, manifest
from offboard.flight.companion import Companion, Outcome
from offboard.flight.connection import open_link, open_lockstep_link
from offboard.flight.flight_plan import FlightPlan
from offboard.flight.gate import usable
from offboard.flight.link import Link
from offboard.flight.log import FlightLog
from offboard.flight.loop import Loop
from offboard.flight.online_identification import IdentifySettings
from offboard.flight.phases import Limits
from offboard.flight.record import COMPONENT_ID, RECORD_COMPONENT_ID
from offboard.flight.sitl import SimulatorProcess
from offboard.flight.stop import StopRequests
from offboard.flight.supervisor import Supervisor
from offboard.flight.udp_link import LockstepLink
from offboard.mavlink.dialects.base import POSITIONING_TELEMETRY
from offboard.mavlink.session import DIALECTS, Session, SessionSettings
from offboard.model.command import Command, PositionCommand
from offboard.model.vehicle import Vehicle
from offboard.reference.track import Track
from offboard.reference.transfer import Hold

REHEARSED_DECISIONS = 5  # the fastest counts: the machine may be busy
DISCARDED_MAX = 20  # batches of a link
SITL_TIMEOUT_S = 180.0  # for simulator and companion in lockstep: either may compile, or be slow


@dataclass(frozen=True, slots=True)
class Bundled:
    """A vehicle of the bundled simulator, in lockstep. `scenario` and `vehicle` None: the defaults
    of the firmware."""

    simulator: SimulatorProcess
    scenario: str | None
    seed: int
    vehicle: str | None = None
    firmware: str = "px4"

    def options(self, port: int) -> list[str]:
        """Options of the `simulator` command, for a vehicle that sends to our local `port`."""
        return [
            *("--connect", f"udpout:127.0.0.1:{port}", "--gcs", "none", "--lockstep"),
            *("--patience", f"{SITL_TIMEOUT_S:g}"),
            *("--seed", str(self.seed), "--firmware", self.firmware),
            *(("--scenario", self.scenario) if self.scenario else ()),
            *(("--vehicle", self.vehicle) if self.vehicle else ()),
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


def rehearse(parts: FlightParts, *, keeps_deadline: bool) -> None:
    """Call every code path of observer and controller, so that nothing is compiled in flight.

    A pause of seconds at the first decision in flight is a crash. Raises DocumentError if the
    control law fails or, with `keeps_deadline`, if a decision cannot meet the deadline.
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
    if keeps_deadline:
        _check_deadline(parts, replace(situation, remaining_s=lambda: 0.0))
    parts.track.sample(np.array([0.0, 1.0]))
    parts.controller.reset()


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


def _check_deadline(parts: FlightParts, cut_short: Situation) -> None:
    """The shortest possible decision must meet the deadline."""
    least_s = math.inf
    for _ in range(REHEARSED_DECISIONS):
        began_s = clock.monotonic_s()
        parts.controller.decide(cut_short)
        least_s = min(least_s, clock.monotonic_s() - began_s)
    if least_s > parts.deadline_s:
        raise DocumentError(
            f"controller: a decision takes at least {1e3 * least_s:.1f} ms here, longer than "
            f"deadline_s ({1e3 * parts.deadline_s:.1f} ms); plan fewer steps or allow more time"
        )


def fly(
    parts: FlightParts,
    log: FlightLog,
    *,
    connection: str,
    bundled: Bundled | None,
    stops: StopRequests,
    progress: Callable[[Companion], None],
    tell: Callable[[str], None] = lambda sentence: None,
) -> Outcome:
    """Fly once over `connection`, or on the `bundled` simulator.

    Raises LinkError, DocumentError, SupervisorError or LogError before anything is sent, and
    KeyboardInterrupt if a stop was requested meanwhile. The log is created last: a flight that
    cannot begin leaves no directory. `tell` is called with sentences about the preparation.
    """
    with ExitStack() as stack:
        log.check()
        link = open_lockstep_link() if bundled else open_link(connection)
        stack.callback(link.close)
        if bundled:
            assert isinstance(link, LockstepLink)
            bundled.simulator.launch(bundled.options(link.port))
            stack.callback(bundled.simulator.recall)
        supervisor = None if bundled else stack.enter_context(Supervisor())
        tell("preparing the controller")
        prepare(tell)
        rehearse(parts, keeps_deadline=bundled is None)
        if supervisor:
            supervisor.await_ready()
        stops.check()
        stack.enter_context(log)
        observer = parts.make_observer()
        fuses = isinstance(observer, FusedObserver)
        session = Session(
            SessionSettings(
                component_id=COMPONENT_ID,
                record_component_id=RECORD_COMPONENT_ID,
                stream=link.is_stream,
                capacity_bytes_ps=None if bundled else link.capacity_bytes_ps,
                lockstep=bundled is not None,
                sends_first=not (bundled or connection.startswith("udpin")),
                extra_wanted=POSITIONING_TELEMETRY if fuses else (),
            )
        )
        for piece in manifest.pieces(log.configuration):
            log.begin(clock.unix_us(), session.encode(piece))
        loop = Loop(
            _companion(parts, session, observer, lockstep=bundled is not None),
            link,
            log,
            stops=stops,
            progress=progress,
            simulator_ended=bundled.simulator.ended if bundled else lambda: None,
            supervisor=supervisor,
            lands_without_log=parts.limits.log_lost == "land",
        )
        if supervisor:
            discard(link)
        return loop.run()


def discard(link: Link) -> None:
    """Drop the telemetry that arrived during the preparation: it is too old to use."""
    for _ in range(DISCARDED_MAX):
        if not link.receive(0.0):
            return


def _companion(
    parts: FlightParts, session: Session, observer: Observer, *, lockstep: bool
) -> Companion:
    limits = parts.limits
    if lockstep:  # the simulator waits for us: silence only means that the machine is busy
        timeouts = {"connect_s": SITL_TIMEOUT_S, "silence_s": SITL_TIMEOUT_S}
        limits = limits.model_copy(update=timeouts)
    return Companion(
        vehicle=parts.vehicle,
        session=session,
        observer=observer,
        controller=parts.controller,
        plan=FlightPlan(parts.track),
        limits=limits,
        period_s=parts.period_s,
        deadline_s=None if lockstep else parts.deadline_s,
        stopwatch=clock.monotonic_s,
        identify=parts.identify,
    )
