"""One configured flight, from names to a scored directory: what fly, compare and identify share."""

from __future__ import annotations

import atexit
import itertools
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path

from offboard.analysis import history, tlog
from offboard.analysis import score as scoring
from offboard.analysis.compare import Result, Trial
from offboard.analysis.document import as_text
from offboard.analysis.history import History
from offboard.analysis.score import Score
from offboard.analysis.tlog import TlogError
from offboard.config import FlightConfig, build_track, dump, load, locate, read_part, read_text
from offboard.control.catalogue import build
from offboard.control.fusion import observer_of
from offboard.flight import clock
from offboard.flight.companion import STOPPED, Companion, Outcome
from offboard.flight.link import LinkError
from offboard.flight.log import FlightLog, LogError
from offboard.flight.run import Bundled, Crew, fly
from offboard.flight.sitl import OWN_VEHICLES, Hangar
from offboard.flight.stop import StopRequests
from offboard.model.document import DocumentError


@dataclass(frozen=True, slots=True)
class Order:
    """What to fly and where: `choices` replaces vehicle, controller or reference by name or file,
    `bundled` None flies whatever is at `connection`."""

    directory: Path
    config: str = "flight"
    choices: Mapping[str, str] = field(default_factory=dict)
    assignments: tuple[str, ...] = ()
    seed: int | None = None
    connection: str = "udpin:127.0.0.1:14540"
    sitl: bool = False  # on a bundled simulator: the next three are its own, None its default
    firmware: str = "px4"
    scenario: str | None = None
    sim_vehicle: str | None = None

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
        """Before anything is built, which may compile. Raises DocumentError."""
        if self.firmware not in OWN_VEHICLES:
            known = ", ".join(OWN_VEHICLES)
            raise DocumentError(f"--firmware {self.firmware}: unknown; there is {known}")
        if self.scenario is not None:
            read_text(locate(self.scenario, "scenarios", "scenario"))
        if self.sim_vehicle is not None:
            read_part("vehicle", self.sim_vehicle)


def crew(config: FlightConfig) -> Crew:
    """Everything that flies, built. Raises DocumentError where the reference cannot be flown."""
    return Crew(
        vehicle=config.vehicle,
        controller=build(
            config.controller, config.vehicle, config.period_s, config.seed, clock.monotonic_s
        ),
        make_observer=lambda: observer_of(
            config.estimate, config.vehicle, config.observer, config.fusion
        ),
        track=build_track(config),
        limits=config.limits,
        period_s=config.period_s,
        deadline_s=config.deadline_s,
        learning=config.identify,
    )


def fly_order(
    order: Order,
    progress: Callable[[Companion], None] = lambda companion: None,
    tell: Callable[[str], None] = lambda sentence: None,
    hangar: Hangar | None = None,
    stops: StopRequests | None = None,
) -> Outcome:
    """Fly and log; a bundled simulator comes from `hangar`, or one for this flight alone, and who
    may stop us likewise from `stops`.

    Raises DocumentError, LinkError, LogError or KeyboardInterrupt before anything is sent.
    """
    with ExitStack() as stack:
        stops = stops or stack.enter_context(StopRequests())
        config = order.resolve()
        bundled = None
        if order.sitl:
            bundled = Bundled(
                hangar or stack.enter_context(Hangar()),
                order.scenario,
                config.seed,
                order.sim_vehicle,
                order.firmware,
            )
        return fly(
            crew(config),
            FlightLog(order.directory, dump(config)),
            connection=order.connection,
            bundled=bundled,
            stops=stops,
            progress=progress,
            tell=tell,
        )


def score_flight(flight: Path) -> tuple[Score, History]:
    """Score FLIGHT, a directory or a .tlog, from its log alone. Raises TlogError."""
    flown = history.gather(tlog.read(tlog.find(flight)))
    return scoring.score(flown), flown


def keep_score(directory: Path, score: Score, flown: History) -> None:
    """Write score.json into a flight directory. Raises LogError."""
    path = directory / "score.json"
    try:
        path.write_text(as_text(score, flown), encoding="utf-8")
    except OSError as error:
        with suppress(OSError):
            path.unlink()  # half a score is none
        raise LogError(f"{path} cannot be written ({error.strerror})") from None


def check_flyable(order: Order, controllers: Sequence[str], references: Sequence[str]) -> None:
    """Every controller with every reference, before the first flight. Raises DocumentError."""
    for controller, reference in itertools.product(controllers, references):
        build_track(_of_trial(order, controller, reference).resolve())


def _of_trial(order: Order, controller: str, reference: str) -> Order:
    named = {"controller": controller, "reference": reference}
    return replace(order, choices={**order.choices, **named})


@cache
def _hangar() -> Hangar:
    """Of this process, for all flights of a comparison that it flies."""
    hangar = Hangar().__enter__()
    atexit.register(hangar.close)
    return hangar


def fly_trial(order: Order, trial: Trial) -> Result:
    """Fly one row of a comparison like `order`; a flight that cannot be flown is a result too.

    It begins disarmed, unless `order` says otherwise: in the air, somebody else has the vehicle.
    """
    ordered = replace(
        _of_trial(order, trial.controller, trial.reference),
        assignments=("limits.begin_armed=false", *order.assignments),
        directory=trial.directory,
        scenario=trial.scenario,
        seed=trial.seed,
    )
    try:
        outcome = fly_order(ordered, hangar=_hangar() if order.sitl else None)
        score, flown = score_flight(trial.directory)
        keep_score(trial.directory, score, flown)
    except (DocumentError, LinkError, LogError, TlogError) as error:
        return Result(trial, 2, str(error), {})
    stopped = outcome.sentence.startswith(STOPPED)
    return Result(trial, outcome.exit_code, outcome.sentence, score.figures(), stopped)
