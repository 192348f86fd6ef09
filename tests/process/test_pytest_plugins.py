"""The fixtures `sitl` and `fly` in a user's own test suite, run by pytest in pytest."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

# pytester moves the home directory, where it would be compiled anew
CACHE = os.environ.get("XDG_CACHE_HOME") or str(Path.home() / ".cache")


@pytest.fixture(autouse=True)
def compiled(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", CACHE)


TAKES_OFF = """
import math, os, pathlib
import pytest
from pymavlink import mavutil

def climb(sitl):
    vehicle = mavutil.mavlink_connection(sitl.connection, source_system=255)
    vehicle.wait_heartbeat(timeout=20)
    vehicle.mav.heartbeat_send(6, 8, 0, 0, 4)
    healthy = 0
    while not healthy & 1 << 28:
        status = vehicle.recv_match(type="SYS_STATUS", blocking=True)
        healthy = status.onboard_control_sensors_health
    vehicle.mav.command_long_send(1, 1, 22, 0, *[math.nan] * 7)
    vehicle.mav.command_long_send(1, 1, 400, 0, 1, 0, 0, 0, 0, 0, 0)
    height = 0.0
    while height < 2.0:
        height = -vehicle.recv_match(type="LOCAL_POSITION_NED", blocking=True).z
    vehicle.close()
    return height
"""

FLIES = (
    TAKES_OFF
    + """
@pytest.mark.sitl(scenario="calm", speed=10)
@pytest.mark.parametrize("run", [1, 2])
def test_climbs(sitl, run):
    assert repr(sitl) == f"<Sitl at {sitl.connection}, scenario calm>"
    assert climb(sitl) >= 2.0
"""
)

FAILS = """
@pytest.mark.sitl(scenario="calm", speed=10)
def test_fails(sitl):
    pathlib.Path("pid").write_text(str(sitl.process.pid))
    assert climb(sitl) < 0.0
"""


def is_running(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return True


def named_logs(result: pytest.RunResult) -> list[Path]:
    return [Path(line) for line in result.outlines if line.endswith(".tlog")]


@pytest.mark.slow
def test_vehicles_for_tests_of_two_workers(pytester: pytest.Pytester) -> None:
    pytester.makepyfile(FLIES)
    result = pytester.runpytest_subprocess("-q", "--strict-markers", "-n", "2", timeout=90)
    result.assert_outcomes(passed=2)
    assert named_logs(result) == []


def test_a_failed_test_keeps_its_log_and_stops_its_vehicle(pytester: pytest.Pytester) -> None:
    """One that passes keeps none."""
    pytester.makepyfile(FLIES.replace("[1, 2]", "[1]") + FAILS)
    result = pytester.runpytest_subprocess("-q", timeout=90)
    result.assert_outcomes(passed=1, failed=1)
    (log,) = named_logs(result)
    assert log.stat().st_size > 10_000
    assert not is_running(int((pytester.path / "pid").read_text()))


def test_a_wrong_marker_is_one_sentence(pytester: pytest.Pytester) -> None:
    pytester.makepyfile(
        """
        import pytest

        @pytest.mark.sitl(scenario="storm")
        def test_scenario(sitl):
            pass

        @pytest.mark.sitl(weather=3)
        def test_argument(sitl):
            pass
        """
    )
    result = pytester.runpytest_subprocess("-q", timeout=60)
    result.assert_outcomes(errors=2)
    result.stdout.fnmatch_lines(
        [
            "*there is no scenario named 'storm'; known are*",
            "*pytest.mark.sitl: weather is unknown; there is scenario, firmware*",
        ]
    )
    assert "Traceback" not in result.stdout.str()


def test_a_flight_in_one_call(pytester: pytest.Pytester) -> None:
    """The log of a failed test is kept; an unknown reference is one sentence, without a flight."""
    pytester.makepyfile(
        """
        SHORT = ("reference.duration_s=1.0", "reference.height_m=1.0", "identify.online=false")

        def test_hovers(fly):
            flight = fly(reference="hover", scenario="calm", seed=3, settings=SHORT)
            assert flight.score.rmse_position_m < 0.05
            assert flight.log.exists()

        def test_fails(fly):
            flight = fly(reference="hover", scenario="calm", seed=3, settings=SHORT)
            assert flight.score.rmse_position_m < 0.0

        def test_unknown(fly):
            fly(reference="moon")
        """
    )
    result = pytester.runpytest_subprocess("-q", timeout=120)
    result.assert_outcomes(passed=1, failed=2)
    (log,) = named_logs(result)
    assert log.stat().st_size > 10_000
    result.stdout.fnmatch_lines("nothing was flown: there is no reference named 'moon'*")


def test_other_test_suites_import_nothing(pytester: pytest.Pytester) -> None:
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
