"""`fly` flies one `FlightConfig` with one vehicle and logs the flight in a directory.

Everything slow (compilation, start of a simulator) happens before telemetry is read.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar

import numpy as np

from offboard.compiled import prepare
from offboard.control.base import Adaptive, Controller, Situation, decision_of
from offboard.documents.errors import DocumentError, Unavailable, outside
from offboard.documents.shipped import absolute
from offboard.documents.signing_key import read_key
from offboard.estimation.observer import Observer
from offboard.flight.flight import Flight
from offboard.flight.flight_plan import FlightPlan
from offboard.flight.outbox import usable
from offboard.flight.phases import Outcome, ServiceOptions
from offboard.flight.record import configuration_pieces
from offboard.identification.learner import Learner
from offboard.identification.vehicle_estimate import IdentifiedVehicle
from offboard.link import clock
from offboard.link.connection import open_link, open_lockstep_link
from offboard.link.interface import Link
from offboard.link.log import FlightLog
from offboard.link.signing_time import SigningTime
from offboard.link.stop import StopRequests
from offboard.mavlink.senders import DIALECTS
from offboard.mavlink.session import Session, SessionSettings
from offboard.mavlink.signing import Signing
from offboard.model.command import Command, PositionCommand
from offboard.model.vehicle import DelayUncertainty
from offboard.reference.track import Track, hold
from offboard.run.configuration import (
    FlightConfig,
    build_controller,
    build_track,
    dump,
    read_part,
)
from offboard.run.loop import Loop
from offboard.run.sitl import (
    OWN_VEHICLES,
    InMemorySimulator,
    SimulatorProcess,
    check_scenario_named,
)
from offboard.supervisor.supervisor import Supervisor

REHEARSED_DECISIONS = 5  # the fastest is compared with the deadline: the computer may be busy
REHEARSAL_S = 10.0  # a law may compile its own code when it is first called
DISCARDED_MAX = 20  # calls of `Link.receive` that `discard` makes at most


@dataclass(frozen=True, slots=True)
class Connection:
    """A vehicle at the link `address`. `system_id` selects it if several send on the link (None:
    the first autopilot heard); `signing_key` is the file with the MAVLink signing key."""

    address: str
    system_id: int | None = None
    signing_key: Path | None = None

    known_vehicle: ClassVar[None] = None  # no vehicle file is known to describe it

    def settings(self, link: Link) -> SessionSettings:
        """Settings of the session over `link`."""
        return SessionSettings(
            system_id=self.system_id,
            stream=link.is_stream,
            capacity_bytes_ps=link.capacity_bytes_ps,
            # except with udpin, the vehicle learns our address only from what we send
            sends_first=not self.address.startswith("udpin"),
        )

    def signing(self, stack: ExitStack) -> Signing | None:
        """Signing whose time stamps are kept on disk until `stack` closes. Raises UserError."""
        if self.signing_key is None:
            return None
        return stack.enter_context(SigningTime(read_key(self.signing_key)))


@dataclass(frozen=True, slots=True)
class Simulated:
    """A vehicle of the bundled simulator, in lockstep. `scenario` and `vehicle` are names or files;
    None: the defaults of the firmware."""

    firmware: str = "px4"
    scenario: str | None = None
    vehicle: str | None = None
    signing_key: Path | None = None

    def check(self) -> None:
        """Check the names and files, before anything is compiled. Raises DocumentError."""
        if self.firmware not in OWN_VEHICLES:
            known = ", ".join(OWN_VEHICLES)
            raise DocumentError(f"--firmware {self.firmware} is unknown; known are {known}")
        if self.scenario is not None:
            check_scenario_named(self.scenario)
        if self.vehicle is not None:
            read_part("vehicle", self.vehicle)

    @property
    def known_vehicle(self) -> str:
        """Name of the vehicle file that describes the firmware's default vehicle, for
        `configuration.load`."""
        return OWN_VEHICLES[self.firmware]

    def signing(self, stack: ExitStack) -> Signing | None:
        """Signing whose time stamps are not kept on disk: in lockstep they do not depend on the
        clock. Raises UserError."""
        return Signing(read_key(self.signing_key)) if self.signing_key else None

    def settings(self, link: Link) -> SessionSettings:
        """Settings of the session over `link`."""
        return SessionSettings(lockstep=True)

    def open_link(self, simulator: SimulatorProcess | InMemorySimulator, seed: int) -> Link:
        """Start the vehicle and return the link to it."""
        if isinstance(simulator, InMemorySimulator):
            return simulator.open_link(
                firmware=self.firmware,
                scenario=self.scenario,
                vehicle=self.vehicle,
                seed=seed,
                parameters=self._parameters(),
            )
        link = open_lockstep_link()
        simulator.launch(self.options(link.port, seed))
        return link

    def options(self, port: int, seed: int) -> list[str]:
        """Options of the `simulator` command for a vehicle that sends to the local UDP `port`."""
        return [
            *("--connect", f"udpout:127.0.0.1:{port}", "--gcs", "none", "--lockstep"),
            *("--seed", str(seed), "--firmware", self.firmware),
            *(("--scenario", absolute(self.scenario)) if self.scenario else ()),
            *(("--vehicle", absolute(self.vehicle)) if self.vehicle else ()),
            *(("--signing-key", str(self.signing_key.absolute())) if self.signing_key else ()),
            *(f"--param={name}={value:g}" for name, value in self._parameters().items()),
        ]

    def _parameters(self) -> dict[str, float]:
        """Parameters that a user must set once on a real autopilot of this firmware."""
        watched = DIALECTS[self.firmware].watched_parameters
        return {p.name: float(p.required.bits) for p in watched if p.required.bits}


# --- a configuration made ready ---


class BusyComputer(DocumentError):
    """A decision misses its deadline only because other programs use the processor."""

    code = Unavailable.code


@dataclass(frozen=True, slots=True)
class Prepared:
    """A configuration, and the controller and the reference built from it; `text` is the content of
    flight.yaml."""

    config: FlightConfig
    controller: Controller
    track: Track
    text: str

    def flight(
        self,
        session: Session,
        stopwatch: Callable[[], float],
        *,
        known: IdentifiedVehicle | None = None,
        service: ServiceOptions | None = None,
        before: Flight | None = None,
    ) -> Flight:
        """Build the `Flight` that uses `session`. `stopwatch` returns host time in seconds; `known`
        is what an earlier flight has identified about the vehicle; `before`: see `Flight`."""
        config, controller = self.config, self.controller
        observer, identification = Observer(config.vehicle), None
        if known:
            observer.set_vehicle(known.vehicle)
        if isinstance(controller, Adaptive):  # others cannot use an identified vehicle model
            identification = Learner(config.vehicle, config.identify, known=known)
        return Flight(
            limits=config.limits,
            plan=FlightPlan(self.track),
            model=known.vehicle if known else config.vehicle,
            session=session,
            observer=observer,
            controller=controller,
            period_s=config.period_s,
            stopwatch=stopwatch,
            deadline_s=None if session.settings.lockstep else config.budget_s,
            identification=identification,
            service=service,
            before=before,
        )


def build(config: FlightConfig) -> Prepared:
    """Build the controller and the reference of `config`. Raises DocumentError if they cannot be
    flown."""
    return Prepared(config, build_controller(config), build_track(config), dump(config))


def rehearse(
    prepared: Prepared, *, keeps_deadline: bool, tell: Callable[[str], None] = lambda _: None
) -> float:
    """Call every code path of observer and controller, so that nothing is compiled in flight: a
    pause of seconds at the first decision in flight would crash the vehicle. `tell` is called with
    a sentence if this takes longer than REHEARSAL_S.

    Returns the wall time of the shortest possible decision in seconds, NaN without
    `keeps_deadline`. Raises DocumentError if the control law fails or, with `keeps_deadline`, if a
    decision cannot meet the deadline.
    """
    law = prepared.config.controller.law
    waiting = f"waiting for the law {law}: it has not returned for {REHEARSAL_S:g} s"
    late = threading.Timer(REHEARSAL_S, tell, [waiting])
    late.daemon = True
    late.start()
    try:
        return _rehearsed(prepared, keeps_deadline=keeps_deadline)
    finally:
        late.cancel()


def _rehearsed(prepared: Prepared, *, keeps_deadline: bool) -> float:
    config, controller = prepared.config, prepared.controller
    observer = Observer(config.vehicle)
    reference = hold((0.0, 0.0, -2.0), 0.1)
    previous = Command(config.vehicle.gravity_mps2, (0.0, 0.0, 1.0), 0.0)
    observer.freeze(True)
    for step in range(60):
        time_s = 0.01 * step
        if step == 20:
            observer.freeze(False)
        observer.on_attitude(time_s, (1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
        observer.on_position(time_s, (0.0, 0.0, -2.0), (0.0, 0.0, 0.0))
        if step >= 20 and step % 10 == 0:
            state = observer.predict(time_s)
            situation = Situation(time_s, state, reference, previous, lambda: config.budget_s)
            command = _decided(controller, situation)
            if isinstance(command, Command):
                previous = command
                observer.on_command(time_s, command)
    least_s = math.nan
    if keeps_deadline:
        cut_short = replace(situation, remaining_s=lambda: 0.0)
        with outside("controller"):
            least_s = _check_deadline(controller, cut_short, config.budget_s)
    prepared.track.sample(np.array([0.0, 1.0]))
    with outside("controller"):
        if isinstance(controller, Adaptive):
            controller.set_vehicle(config.vehicle, DelayUncertainty())
        controller.reset()
    return least_s


def _decided(controller: Controller, situation: Situation) -> Command | PositionCommand:
    """Let the controller decide and return its command. Raises DocumentError if it raises, or
    returns a command that cannot be sent."""
    with outside("controller"):
        command = decision_of(controller, situation).command
    if not usable(command):
        raise DocumentError(
            f"controller: it decides {command}, which cannot be sent: all values must be finite "
            "numbers, vectors tuples of three, and the thrust direction of length 1"
        )
    return command


def _check_deadline(controller: Controller, cut_short: Situation, budget_s: float) -> float:
    """Return the wall time of the shortest possible decision in seconds. Raises DocumentError if it
    exceeds `budget_s`, BusyComputer if only the wall time does and not the CPU time."""
    least_s = needed_s = math.inf
    for _ in range(REHEARSED_DECISIONS):
        began_s, computed_s = clock.monotonic_s(), clock.thread_s()
        controller.decide(cut_short)
        least_s = min(least_s, clock.monotonic_s() - began_s)
        needed_s = min(needed_s, clock.thread_s() - computed_s)
    if least_s > budget_s >= needed_s:
        raise BusyComputer(
            f"this computer is too busy: a decision needs {1e3 * needed_s:.1f} ms of its processor "
            f"and takes {1e3 * least_s:.1f} ms; close other programs, and "
            "let the controller wait for nothing"
        )
    if least_s > budget_s:
        raise DocumentError(
            f"controller: a decision takes at least {1e3 * least_s:.1f} ms here, longer than "
            f"deadline_s or period_s ({1e3 * budget_s:.1f} ms); plan fewer steps or allow more time"
        )
    return least_s


# --- the flight ---


def fly(
    config: FlightConfig,
    directory: Path,
    vehicle: Connection | Simulated,
    *,
    simulator: SimulatorProcess | InMemorySimulator | None = None,
    stops: StopRequests | None = None,
    progress: Callable[[Flight], None] = lambda flight: None,
    tell: Callable[[str], None] = lambda sentence: None,
) -> Outcome:
    """Fly `config` once with `vehicle` and log the flight in `directory`.

    `progress` is called often during the flight; `tell` is called with sentences about the
    preparation. `simulator` (by default a process) and `stops` may be shared by several flights.

    Example: `fly(load("flight"), Path("flights/1"), Simulated()).exit_code` is 0 if the vehicle has
    flown the reference and landed.

    During the preparation, before anything is sent, it raises UserError if the flight cannot begin,
    and KeyboardInterrupt if a stop is requested. The log is created last: a flight that cannot
    begin leaves no directory.
    """
    simulated = isinstance(vehicle, Simulated)
    with ExitStack() as stack:
        stops = stops or stack.enter_context(StopRequests())
        signing = vehicle.signing(stack)
        if isinstance(vehicle, Simulated):
            simulator = simulator or SimulatorProcess()
            link = vehicle.open_link(simulator, config.seed)
            stack.callback(simulator.recall)
        else:
            link = open_link(vehicle.address)
        stack.callback(link.close)
        prepared = build(config)  # while the simulator starts
        log = FlightLog(directory, prepared.text, real_time=not simulated)
        log.check()
        supervisor = None if simulated else stack.enter_context(Supervisor(signing))
        tell("preparing the controller")
        prepare(tell)
        rehearse(prepared, keeps_deadline=not simulated, tell=tell)
        if supervisor:
            supervisor.await_ready()
        stops.check()
        stops.in_flight = True  # from now on there is a log, which must not end without an outcome
        stack.enter_context(log)
        session = Session(vehicle.settings(link), signing)
        for piece in configuration_pieces(prepared.text):
            log.begin(clock.unix_us(), session.encode(piece))
        loop = Loop(
            prepared.flight(session, clock.monotonic_s),
            link,
            log,
            stops=stops,
            progress=progress,
            simulator=simulator if simulated else None,
            supervisor=supervisor,
        )
        if supervisor:
            discard(link)
        return loop.run()


def discard(link: Link) -> None:
    """Drop the telemetry that arrived during the preparation: it is too old to use."""
    for _ in range(DISCARDED_MAX):
        if not link.receive():
            return
