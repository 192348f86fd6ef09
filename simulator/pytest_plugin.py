"""pytest: the fixture `sitl`, a running vehicle for the test of whoever writes MAVLink software.

Installed with the package; imports the rest of it when the first test wants a vehicle, so that
other tests pay nothing. The vehicle is a process of its own, stopped with its test whatever
becomes of the test.

    @pytest.mark.sitl(scenario="wind_2mps", firmware="px4", seed=7, speed=5.0)
    def test_mine(sitl):
        vehicle = mavutil.mavlink_connection(sitl.connection)
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Generator, Iterator
from pathlib import Path
from typing import Any

import pytest

STOP_S = 2.0
OPTIONS = ("scenario", "firmware", "vehicle", "seed", "speed")  # of the marker and the command
LOGS = pytest.StashKey[list[Path]]()


class Sitl:
    """A running vehicle. `connection` and `ground_connection`: where a client listens for it."""

    def __init__(self, directory: Path, options: dict[str, Any]) -> None:
        from simulator.link.links import free_ports

        self.scenario = options.get("scenario")
        self.port, self.ground_port = free_ports(2)
        self.log = directory / "sitl.tlog"
        self.output = directory / "sitl.txt"
        command = [sys.executable, "-m", "simulator", "--log", str(self.log)]
        command += ["--connect", f"udpout:127.0.0.1:{self.port}"]
        command += ["--gcs", f"udpout:127.0.0.1:{self.ground_port}"]
        for name, value in options.items():
            command += [f"--{name}", str(value)]
        with self.output.open("wb") as errors:
            self.process = subprocess.Popen(
                command,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=errors,
                start_new_session=True,  # Ctrl-C is pytest's business
            )

    def __repr__(self) -> str:
        scenario = self.scenario or "the firmware's own"
        return f"<Sitl at {self.connection}, scenario {scenario}>"

    @property
    def connection(self) -> str:
        """For pymavlink, MAVProxy and `offboard`."""
        return f"udpin:127.0.0.1:{self.port}"

    @property
    def ground_connection(self) -> str:
        """The same on the ground station's link."""
        return f"udpin:127.0.0.1:{self.ground_port}"

    @property
    def mavsdk_address(self) -> str:
        """For MAVSDK."""
        return f"udpin://127.0.0.1:{self.port}"

    def wait_ready(self) -> None:
        """Return when it is about to send; fail with its own sentence when it ended instead."""
        assert self.process.stdout is not None
        if not self.process.stdout.readline():
            self.process.wait()
            pytest.fail(f"sitl: {self.output.read_text().strip()}", pytrace=False)

    def stop(self) -> None:
        """Stop it and wait until it is gone."""
        self.process.terminate()
        try:
            self.process.wait(STOP_S)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()
        assert self.process.stdout is not None
        self.process.stdout.close()


@pytest.fixture
def sitl(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Sitl]:
    """A running vehicle on free ports, as the marker `sitl` describes it."""
    marker = request.node.get_closest_marker("sitl")
    named = marker.kwargs if marker else {}
    if unknown := sorted(set(named) - set(OPTIONS)):
        known = ", ".join(OPTIONS)
        pytest.fail(f"pytest.mark.sitl: {unknown[0]} is unknown; there is {known}", pytrace=False)
    options = {name: value for name, value in named.items() if value is not None}
    vehicle = Sitl(tmp_path, options)
    request.node.stash.setdefault(LOGS, []).append(vehicle.log)
    try:
        vehicle.wait_ready()
        yield vehicle
    finally:
        vehicle.stop()


def pytest_configure(config: pytest.Config) -> None:
    """Make the marker known."""
    config.addinivalue_line(
        "markers",
        f"sitl({', '.join(OPTIONS)}): what the fixture `sitl` flies, and how",
    )


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(
    item: pytest.Item, call: pytest.CallInfo[None]
) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """Name the logs of a failed test."""
    report = yield
    logs = [path for path in item.stash.get(LOGS, []) if path.exists()]
    if report.failed and logs:
        report.sections.append(("MAVLink logs", "\n".join(map(str, logs))))
    return report
