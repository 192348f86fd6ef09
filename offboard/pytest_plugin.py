"""pytest plugin: the fixture `fly`, a flight on the bundled simulator as one call of a test.

Installed with the package. It imports the rest of the package when a test uses `fly`, so that other
test suites are not slowed down.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from offboard.analysis.score import Score

FLIGHTS = pytest.StashKey[list[Path]]()


@dataclass(frozen=True, slots=True)
class Flight:
    """A flight that has ended.

    `exit_code` is that of `offboard fly`: 0 flown and landed, 3 not flown, 4 aborted. `sentence`
    says how it ended. `score` has the metrics of the flight (see `offboard.analysis.score.Score`),
    `directory` holds flight.tlog and flight.yaml.
    """

    exit_code: int
    sentence: str
    score: Score
    directory: Path

    @property
    def log(self) -> Path:
        """The .tlog of the flight."""
        return self.directory / "flight.tlog"


@pytest.fixture
def fly(request: pytest.FixtureRequest, tmp_path: Path) -> Callable[..., Flight]:
    """A function that flies on the bundled simulator and returns a `Flight`.

    The flight is flown in lockstep: the same arguments give the same telemetry and setpoints. All
    arguments are keywords and optional:

    - `reference`, `controller`, `vehicle`: a shipped name (`offboard list`) or a file
    - `scenario`: a shipped name or a file; default: the estimator errors of the firmware
    - `firmware`: "px4" (default) or "ardupilot"
    - `seed`: of the swarm and the simulator
    - `config`: a shipped configuration or a file; default: "flight"
    - `settings`: a sequence of "key.path=value", as --set of `offboard fly`
    - `must_succeed`: False returns a flight that was aborted too; by default it fails the test

    A configuration that cannot be flown fails the test with its error. The log of a failed test is
    kept and its path printed.
    """
    flown = request.node.stash.setdefault(FLIGHTS, [])

    def fly_once(
        *,
        reference: str | Path | None = None,
        controller: str | Path | None = None,
        vehicle: str | Path | None = None,
        scenario: str | Path | None = None,
        firmware: str = "px4",
        seed: int | None = None,
        config: str | Path = "flight",
        settings: Sequence[str] = (),
        must_succeed: bool = True,
    ) -> Flight:
        from offboard.analysis.score import judged, score_flight
        from offboard.documents.errors import UserError
        from offboard.link.stop import StopRequests
        from offboard.run.configuration import load
        from offboard.run.flight import Simulated, fly
        from offboard.run.sitl import InMemorySimulator

        directory = tmp_path / f"flight-{len(flown) + 1}"
        flown.append(directory / "flight.tlog")
        problem, outcome = "", None
        try:
            simulated = Simulated(firmware, str(scenario) if scenario else None)
            simulated.check()
            chosen = {"reference": reference, "controller": controller, "vehicle": vehicle}
            flown_config = load(
                str(config),
                choices={part: str(file) for part, file in chosen.items() if file},
                assignments=settings,
                seed=seed,
                known_vehicle=simulated.known_vehicle,
            )
            simulator = InMemorySimulator()
            with StopRequests() as stops:
                outcome = fly(flown_config, directory, simulated, simulator=simulator, stops=stops)
            stops.check()  # Ctrl-C ends pytest, too
        except UserError as error:
            problem = str(error)
        if outcome is None:
            pytest.fail(f"nothing was flown: {problem}", pytrace=False)
        score, _ = score_flight(directory)
        outcome = judged(outcome, score)
        if must_succeed and outcome.exit_code != 0:
            pytest.fail(f"the flight did not succeed: {outcome.sentence}", pytrace=False)
        return Flight(int(outcome.exit_code), outcome.sentence, score, directory)

    return fly_once


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(
    item: pytest.Item, call: pytest.CallInfo[None]
) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """Add the paths of the logs to the report of a failed test."""
    report = yield
    logs = [path for path in item.stash.get(FLIGHTS, []) if path.exists()]
    if report.failed and logs:
        report.sections.append(("flight logs", "\n".join(map(str, logs))))
    return report
