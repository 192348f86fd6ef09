"""One configured flight, from names and files to a log. Used by `fly`, `compare`, `identify`."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path

from offboard.documents.reading import DocumentError
from offboard.documents.signing_key import read_key
from offboard.estimation.observer import Observer
from offboard.flight.companion import Companion, Outcome
from offboard.link.log import FlightLog
from offboard.link.stop import StopRequests
from offboard.run.configuration import (
    FlightConfig,
    build_controller,
    build_track,
    dump,
    load,
    read_part,
)
from offboard.run.in_memory import InMemorySimulator
from offboard.run.one_flight import Bundled, FlightParts, fly
from offboard.run.sitl import OWN_VEHICLES, SimulatorProcess, check_scenario_named


@dataclass(frozen=True, slots=True)
class FlightRequest:
    """What to fly, and where to record it.

    `choices` replaces "vehicle", "controller" or "reference" of `config` by a name or a file (None:
    that of `config`);
    `assignments` are `key.path=value`. `sitl` flies the bundled simulator with `firmware`,
    `scenario` and `sim_vehicle` (None: its default) instead of the vehicle at `connection`.
    `system_id` is that of the vehicle, where several send; `signing_key` a key file.
    """

    directory: Path
    config: str = "flight"
    choices: Mapping[str, str | None] = field(default_factory=dict)
    assignments: tuple[str, ...] = ()
    seed: int | None = None
    connection: str = "udpin:127.0.0.1:14540"
    sitl: bool = False
    firmware: str = "px4"
    scenario: str | None = None
    sim_vehicle: str | None = None
    system_id: int | None = None
    signing_key: Path | None = None

    def resolve(self) -> FlightConfig:
        """The validated configuration. Raises DocumentError."""
        if self.sitl:
            self._check_bundled()
        return load(
            self.config,
            choices=self.choices,
            assignments=self.assignments,
            seed=self.seed,
            known_vehicle=OWN_VEHICLES[self.firmware] if self.sitl else None,
        )

    def _check_bundled(self) -> None:
        """Check the simulator's options before anything is compiled. Raises DocumentError."""
        if self.firmware not in OWN_VEHICLES:
            known = ", ".join(OWN_VEHICLES)
            raise DocumentError(f"--firmware {self.firmware}: unknown; there is {known}")
        if self.scenario is not None:
            check_scenario_named(self.scenario)
        if self.sim_vehicle is not None:
            read_part("vehicle", self.sim_vehicle)


def build_parts(config: FlightConfig) -> FlightParts:
    """Build the parts of a flight. Raises DocumentError if the reference cannot be flown."""
    return FlightParts(
        vehicle=config.vehicle,
        controller=build_controller(config),
        make_observer=lambda: Observer(config.vehicle),
        track=build_track(config),
        limits=config.limits,
        period_s=config.period_s,
        deadline_s=config.deadline_s,
        identify=config.identify,
    )


def fly_request(
    request: FlightRequest,
    progress: Callable[[Companion], None] = lambda companion: None,
    tell: Callable[[str], None] = lambda sentence: None,
    simulator: SimulatorProcess | InMemorySimulator | None = None,
    stops: StopRequests | None = None,
) -> Outcome:
    """Fly one flight and log it.

    `progress` is called often in flight, `tell` with sentences about the preparation. `simulator`
    and `stops` may be shared by several flights; without them this flight makes its own.

    Example: `fly_request(FlightRequest(Path("flights/1"), sitl=True)).exit_code` is 0 if the flight
    was flown and landed.

    Raises DocumentError, KeyFileError, SigningTimeError, LinkError, LogError or KeyboardInterrupt,
    all before anything is sent.
    """
    with ExitStack() as stack:
        stops = stops or stack.enter_context(StopRequests())
        config = request.resolve()
        key = read_key(request.signing_key) if request.signing_key else None
        bundled = None
        if request.sitl:
            bundled = Bundled(
                simulator or stack.enter_context(SimulatorProcess()),
                request.scenario,
                config.seed,
                request.sim_vehicle,
                request.firmware,
                request.signing_key,
            )
        return fly(
            build_parts(config),
            FlightLog(request.directory, dump(config), real_time=not request.sitl),
            connection=request.connection,
            bundled=bundled,
            system_id=request.system_id,
            signing_key=key,
            stops=stops,
            progress=progress,
            tell=tell,
        )
