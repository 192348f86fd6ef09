"""One flight from a resolved configuration: build everything, rehearse, connect, fly, close.

Everything that may be slow (compiling, starting a simulator) happens before the vehicle is heard.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, replace

import numpy as np

from offboard.compiled import prepare
from offboard.control.base import Controller, Situation
from offboard.documents.reading import DocumentError
from offboard.estimation.fusion import FusedObserver
from offboard.estimation.observer import Observer
from offboard.flight import clock, manifest
from offboard.flight.companion import Companion, Outcome
from offboard.flight.flight_plan import FlightPlan
from offboard.flight.link import UdpLink, open_link
from offboard.flight.log import FlightLog
from offboard.flight.loop import Loop
from offboard.flight.online_identification import IdentifySettings
from offboard.flight.phases import Limits
from offboard.flight.record import COMPONENT_ID, RECORD_COMPONENT_ID
from offboard.flight.sitl import SimulatorProcess
from offboard.flight.stop import StopRequests
from offboard.identification import stages as identification
from offboard.mavlink.dialects.base import POSITIONING_TELEMETRY
from offboard.mavlink.session import DIALECTS, Session, SessionSettings
from offboard.model.command import Command
from offboard.model.vehicle import Vehicle
from offboard.reference.track import Track
from offboard.reference.transfer import Hold

REHEARSED_DECISIONS = 5  # of which the fastest counts: the machine may do something else too
SITL_PATIENCE_S = 180.0  # a bundled simulator may compile first, on a machine that does much else


@dataclass(frozen=True, slots=True)
class Bundled:
    """A vehicle of the bundled simulator, in lockstep; `scenario` and `vehicle` None are the
    firmware's own."""

    simulator: SimulatorProcess
    scenario: str | None
    seed: int
    vehicle: str | None = None
    firmware: str = "px4"

    def options(self, port: int) -> list[str]:
        """Of the `simulator` command: this vehicle, sending to a port of ours."""
        return [
            *("--connect", f"udpout:127.0.0.1:{port}", "--gcs", "none", "--lockstep"),
            *("--seed", str(self.seed), "--firmware", self.firmware),
            *(("--scenario", self.scenario) if self.scenario else ()),
            *(("--vehicle", self.vehicle) if self.vehicle else ()),
            *(f"--param={name}={value:g}" for name, value in self._parameters().items()),
        ]

    def _parameters(self) -> dict[str, float]:
        """What a user would set once on this autopilot to fly with us."""
        dialect = DIALECTS.get(self.firmware)
        watched = dialect.watched_parameters if dialect else ()
        return {p.name: float(p.required_bits) for p in watched if p.required_bits}


@dataclass(frozen=True, slots=True)
class FlightParts:
    """What one flight is made of, built from the configuration by the caller."""

    vehicle: Vehicle
    controller: Controller
    make_observer: Callable[[], Observer]
    track: Track
    limits: Limits
    period_s: float
    deadline_s: float
    learning: IdentifySettings | None = None


def rehearse(parts: FlightParts, *, keeps_deadline: bool) -> float:
    """Call every code path of observer and controller, compiled ones included, and forget it.

    A stall of seconds at the first decision in flight is a crash. Returns the seconds it took.
    `keeps_deadline`: raises DocumentError where no decision can be had within the deadline.
    """
    began_s = clock.monotonic_s()
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
            situation = Situation(time_s, state, reference, previous, parts.deadline_s)
            command = parts.controller.decide(situation).command
            if isinstance(command, Command):
                previous = command
                observer.on_command(time_s, command)
    if keeps_deadline:
        _check_deadline(parts, replace(situation, deadline_s=0.0))
    parts.track.sample(np.array([0.0, 1.0]))
    if parts.learning and parts.learning.online:
        identification.warm_up(parts.vehicle)
    parts.controller.reset()
    return clock.monotonic_s() - began_s


def _check_deadline(parts: FlightParts, cut_short: Situation) -> None:
    """The least a decision takes, a search's first look included, must fit in its deadline."""
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
    """Fly once over `connection`, or on a bundled simulator of our own.

    Raises LinkError, DocumentError or LogError before anything is sent, what can be known at once
    before anything slow; KeyboardInterrupt where `stops` was asked meanwhile. The log is opened
    last, so that a flight which cannot begin leaves no directory behind. `tell` is given a sentence
    about what takes so long.
    """
    with ExitStack() as stack:
        log.check()
        link = open_link("udpin:127.0.0.1:0" if bundled else connection)
        stack.callback(link.close)
        if bundled:
            assert isinstance(link, UdpLink)
            bundled.simulator.launch(bundled.options(link.port))
            stack.callback(bundled.simulator.recall)
        tell("preparing the controller")
        prepare(tell)
        rehearse(parts, keeps_deadline=bundled is None)
        stops.heed()
        stack.enter_context(log)
        observer = parts.make_observer()
        fuses = isinstance(observer, FusedObserver)
        session = Session(
            SessionSettings(
                component_id=COMPONENT_ID,
                record_component_id=RECORD_COMPONENT_ID,
                stream=link.is_stream,
                speaks_first=not (bundled or connection.startswith("udpin")),
                wanted_too=POSITIONING_TELEMETRY if fuses else (),
            )
        )
        for piece in manifest.pieces(log.configuration):
            log.begin(clock.unix_us(), session.encode(piece))
        loop = Loop(
            _companion(parts, session, observer, lockstep=bundled is not None),
            link,
            log,
            stops=stops,
            lockstep=bundled is not None,
            progress=progress,
            vehicle_process_ended=bundled.simulator.ended if bundled else lambda: None,
        )
        return loop.run()


def _companion(
    parts: FlightParts, session: Session, observer: Observer, *, lockstep: bool
) -> Companion:
    limits = parts.limits
    if lockstep:  # the vehicle waits for us: silence only says that the machine is busy
        patience = {"connect_s": SITL_PATIENCE_S, "silence_s": SITL_PATIENCE_S}
        limits = limits.model_copy(update=patience)
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
        learning=parts.learning,
    )
