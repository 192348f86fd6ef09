"""pytest: the fixture `fly`, a whole flight on the bundled simulator as one call of a test.

Installed with the package; imports the rest of it when the first test flies.

    def test_tracks(fly):
        flight = fly(reference="lemniscate", controller="pso", scenario="gusts", seed=3)
        assert flight.score.rmse_position_m < 0.15
"""

from __future__ import annotations

import gc
from collections.abc import Callable, Generator, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from offboard.analysis.score import Score
    from offboard.flight.sitl import SimulatorProcess

FLIGHTS = pytest.StashKey[list[Path]]()


@dataclass(frozen=True, slots=True)
class Flight:
    """A flight that took place. `exit_code` 0: flown to its end; `sentence` says why it ended."""

    exit_code: int
    sentence: str
    score: Score
    directory: Path

    @property
    def log(self) -> Path:
        return self.directory / "flight.tlog"


@pytest.fixture(scope="session")
def _simulator() -> Iterator[SimulatorProcess]:
    """What the flights of all tests start from."""
    from offboard.flight.sitl import SimulatorProcess

    with SimulatorProcess() as simulator:
        yield simulator


@pytest.fixture
def fly(
    request: pytest.FixtureRequest, tmp_path: Path, _simulator: SimulatorProcess
) -> Callable[..., Flight]:
    """Fly on the bundled simulator, in lockstep: a flight is a function of its arguments.

    The function takes reference, controller and vehicle (a shipped name or a file), scenario,
    firmware, seed, config, and `settings`, each "key.path=value". Unless `must_succeed` is False,
    a flight that does not come to its end fails the test with its sentence.
    """
    flown = request.node.stash.setdefault(FLIGHTS, [])

    def fly_once(
        *,
        reference: str | None = None,
        controller: str | None = None,
        vehicle: str | None = None,
        scenario: str | None = None,
        firmware: str = "px4",
        seed: int | None = None,
        config: str = "flight",
        settings: Sequence[str] = (),
        must_succeed: bool = True,
    ) -> Flight:
        from offboard.analysis.trial import score_flight
        from offboard.documents.reading import DocumentError
        from offboard.flight.link import LinkError
        from offboard.flight.log import LogError
        from offboard.flight.request import FlightRequest, fly_request

        named = {"reference": reference, "controller": controller, "vehicle": vehicle}
        directory = tmp_path / f"flight-{len(flown) + 1}"
        flown.append(directory / "flight.tlog")
        request = FlightRequest(
            directory=directory,
            config=config,
            choices={part: name for part, name in named.items() if name is not None},
            assignments=tuple(settings),
            seed=seed,
            sitl=True,
            firmware=firmware,
            scenario=scenario,
        )
        problem, outcome = "", None
        try:
            outcome = fly_request(request, simulator=_simulator)
        except (DocumentError, LinkError, LogError) as error:
            problem = str(error)
        finally:
            gc.unfreeze()  # the flight's loop froze what the other tests need collected
        if outcome is None:
            pytest.fail(f"nothing was flown: {problem}", pytrace=False)
        if must_succeed and outcome.exit_code != 0:
            pytest.fail(f"the flight did not succeed: {outcome.sentence}", pytrace=False)
        score, _ = score_flight(directory)
        return Flight(int(outcome.exit_code), outcome.sentence, score, directory)

    return fly_once


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(
    item: pytest.Item, call: pytest.CallInfo[None]
) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """Name the logs of a failed test."""
    report = yield
    logs = [path for path in item.stash.get(FLIGHTS, []) if path.exists()]
    if report.failed and logs:
        report.sections.append(("flight logs", "\n".join(map(str, logs))))
    return report
