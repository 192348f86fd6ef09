"""The fixtures `sitl` and `fly` in a user's own test suite, run by pytest in pytest."""

from __future__ import annotations

import os
import re
import signal
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import pytest

from offboard.pytest_plugin import Flight

# pytester changes the home directory, so that everything would be compiled again
CACHE = os.environ.get("XDG_CACHE_HOME") or str(Path.home() / ".cache")


@pytest.fixture(autouse=True)
def compiled(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", CACHE)


README = (Path(__file__).parents[2] / "README.md").read_text()
MINE = """
import pathlib
import pytest
from pymavlink import mavutil

@pytest.mark.sitl(scenario="calm", speed=10)
def test_fails(sitl):
    pathlib.Path("pid").write_text(str(sitl.process.pid))
    assert repr(sitl) == f"<Sitl at {sitl.connection}, scenario calm>"
    vehicle = mavutil.mavlink_connection(sitl.connection, source_system=255)
    vehicle.wait_heartbeat(timeout=20)
    for _ in range(300):
        assert vehicle.recv_match(blocking=True)
    vehicle.close()
    pytest.fail("it fails")

def test_is_perfect(fly, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    pathlib.Path("mine.yaml").write_text("{name: mine, conditions: {thrust_scale: 1.01}}")
    settings = ("reference.duration_s=1.0", "reference.height_m=1.0", "identify.online=false")
    flight = fly(reference="hover", scenario="mine.yaml", seed=3, settings=settings)
    assert flight.log.exists()
    assert flight.score.rmse_position_m < 0.05
    assert flight.score.rmse_position_m < 0.0

def test_unknown_reference(fly):
    fly(reference="moon")

def test_path_of_a_file(fly, tmp_path):
    table = tmp_path / "table.csv"
    table.write_text("time_s,north_m,east_m,altitude_m")
    fly(reference=table)

@pytest.mark.sitl(scenario="storm")
def test_unknown_scenario(sitl):
    pass

@pytest.mark.sitl(weather=3)
def test_unknown_argument(sitl):
    pass

@pytest.mark.sitl("wind_2mps")
def test_argument_without_name(sitl):
    pass
"""


@pytest.mark.parametrize("workers", [0, pytest.param(2, marks=pytest.mark.slow)])
def test_pytest_fixtures_work_as_in_the_readme(workers: int, pytester: pytest.Pytester) -> None:
    """A test that fails keeps its log and ends its vehicle, one that passes keeps none. A wrong
    option is one sentence, without a flight."""
    (example,) = re.findall(r"```python\n(.*?)```", README, re.DOTALL)
    assert example.count("\ndef test_") == 2
    pytester.makepyfile(test_readme=example, test_mine=MINE)
    result = pytester.runpytest_subprocess("-q", "--strict-markers", f"-n{workers}", timeout=120)
    result.assert_outcomes(passed=2, failed=4, errors=3)
    logs = [Path(line) for line in result.outlines if line.endswith(".tlog")]
    assert len(logs) == 2
    assert all(log.stat().st_size > 10_000 for log in logs)
    with pytest.raises(ProcessLookupError):
        os.kill(int((pytester.path / "pid").read_text()), 0)
    for line in (
        "*Failed: it fails*",
        "*assert * < 0.0*",
        "*nothing was flown: there is no reference named 'moon'*",
        "*nothing was flown: reference */table.csv: */table.csv has 0 rows of data*",
        "*there is no scenario named 'storm'; known are*",
        "*pytest.mark.sitl: weather is unknown; there is scenario, firmware*",
        "*pytest.mark.sitl: name the option 'wind_2mps'; there is scenario, firmware*",
    ):
        result.stdout.fnmatch_lines(line)


def test_vehicle_ends_with_a_pytest_that_crashes(pytester: pytest.Pytester) -> None:
    pytester.makepyfile(
        """
        import os, pathlib

        def test_crashes(sitl):
            pathlib.Path("pid").write_text(str(sitl.process.pid))
            os._exit(9)
        """
    )
    assert pytester.runpytest_subprocess("-q", timeout=60).ret == 9
    vehicle = int((pytester.path / "pid").read_text())
    ended_by_s = time.monotonic() + 20.0
    with suppress(ProcessLookupError):
        while time.monotonic() < ended_by_s:
            os.kill(vehicle, 0)
            time.sleep(0.01)
        pytest.fail("the vehicle still runs")


def test_ctrl_c_and_a_timeout_in_a_flight_end_the_test(
    fly: Callable[..., Flight], tmp_path: Path
) -> None:
    """pytest-timeout raises its exception in a handler of SIGALRM."""

    def times_out(*_: object) -> None:
        pytest.fail("it takes too long")

    def send(number: int, flight: Path) -> None:
        log = flight / "flight.tlog"
        while not log.exists() or log.stat().st_size < 100_000:  # some seconds of a flight
            time.sleep(0.01)
        os.kill(os.getpid(), number)

    before = signal.signal(signal.SIGALRM, times_out)
    for count, (number, ending, says) in enumerate(
        (
            (signal.SIGINT, KeyboardInterrupt, None),
            (signal.SIGALRM, pytest.fail.Exception, "^it takes too long$"),
        ),
        1,
    ):
        arguments = (number, tmp_path / f"flight-{count}")
        threading.Thread(target=send, args=arguments, daemon=True).start()
        with pytest.raises(ending, match=says):
            fly(must_succeed=False)
    signal.signal(signal.SIGALRM, before)


def test_plugins_import_no_heavy_modules_in_other_suites(pytester: pytest.Pytester) -> None:
    pytester.makepyfile(
        """
        import os, sys

        def test_nothing_is_imported():
            heavy = {"numba", "numpy", "scipy", "pymavlink", "pydantic", "typer"}
            assert heavy & set(sys.modules) == set()
            assert "offboard.pytest_plugin" in sys.modules
            assert "simulator.pytest_plugin" in sys.modules
        """
    )
    result = pytester.runpytest_subprocess("-q", "-p", "no:hypothesispytest", timeout=60)
    result.assert_outcomes(passed=1)
