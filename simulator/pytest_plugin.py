"""pytest plugin: the fixture `sitl`, a simulated vehicle for tests of MAVLink software.

Installed with the package. It imports the rest of the package when a test uses `sitl`, so that
other test suites are not slowed down.
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Generator, Iterator
from pathlib import Path
from typing import Any

import pytest

STOP_S = 2.0
OPTIONS = ("scenario", "firmware", "vehicle", "seed", "speed")  # names in marker and command
LOGS = pytest.StashKey[list[Path]]()
# the `simulator` command, which also ends if pytest crashes
PROGRAM = "from simulator.cli import main_until_input_ends; main_until_input_ends()"


class Sitl:
    """A simulated vehicle that runs as a process of its own, on free ports of this machine.

    The vehicle sends telemetry by UDP to two ports, as PX4 SITL does: to a companion computer
    (`connection`) and to a ground station (`ground_connection`). `log` is the .tlog of the
    companion's link; `output` has what the process printed to stderr.
    """

    def __init__(self, directory: Path, options: dict[str, Any]) -> None:
        from simulator.link.sockets import free_ports

        self.scenario = options.get("scenario")
        self.port, self.ground_port = free_ports(2)
        self.log = directory / "sitl.tlog"
        self.output = directory / "sitl.txt"
        command = [sys.executable, "-P", "-c", PROGRAM, "--log", str(self.log)]
        command += ["--connect", f"udpout:127.0.0.1:{self.port}"]
        command += ["--gcs", f"udpout:127.0.0.1:{self.ground_port}"]
        for name, value in options.items():
            command += [f"--{name}", str(value)]
        with self.output.open("wb") as errors:
            self.process = subprocess.Popen(
                command,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=errors,
                start_new_session=True,  # Ctrl-C reaches pytest only
            )

    def __repr__(self) -> str:
        scenario = self.scenario or "the firmware's own"
        return f"<Sitl at {self.connection}, scenario {scenario}>"

    @property
    def connection(self) -> str:
        """Address of the companion's link for pymavlink, MAVProxy and `offboard`, for example
        "udpin:127.0.0.1:14540"."""
        return f"udpin:127.0.0.1:{self.port}"

    @property
    def ground_connection(self) -> str:
        """Address of the ground station's link, in the same form."""
        return f"udpin:127.0.0.1:{self.ground_port}"

    @property
    def mavsdk_address(self) -> str:
        """Address of the companion's link for MAVSDK, for example "udpin://127.0.0.1:14540"."""
        return f"udpin://127.0.0.1:{self.port}"

    def wait_ready(self) -> None:
        """Wait until the vehicle sends. If its process ended, fail the test with its error
        message."""
        assert self.process.stdout is not None
        if not self.process.stdout.readline():
            self.process.wait()
            pytest.fail(f"sitl: {self.output.read_text().strip()}", pytrace=False)

    def stop(self) -> None:
        """Stop the process and wait for its end."""
        self.process.terminate()
        try:
            self.process.wait(STOP_S)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()
        for pipe in (self.process.stdin, self.process.stdout):
            assert pipe is not None
            pipe.close()


@pytest.fixture
def sitl(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Sitl]:
    """A simulated vehicle on free ports, running until the end of the test.

    The marker `sitl` sets its options: `scenario` and `vehicle` (a shipped name, see `offboard
    list`, or a file), `firmware` ("px4" or "ardupilot"), `seed` and `speed` (multiple of real
    time). Without the marker it is a PX4 vehicle in real time. When a test fails, the log is kept
    and its path printed.
    """
    marker = request.node.get_closest_marker("sitl")
    named, nameless = (marker.kwargs, marker.args) if marker else ({}, ())
    wrong = [f"name the option {value!r}" for value in nameless]
    wrong += [f"{name} is unknown" for name in sorted(set(named) - set(OPTIONS))]
    if wrong:
        known = ", ".join(OPTIONS)
        pytest.fail(f"pytest.mark.sitl: {wrong[0]}; there is {known}", pytrace=False)
    options = {name: value for name, value in named.items() if value is not None}
    vehicle = Sitl(tmp_path, options)
    request.node.stash.setdefault(LOGS, []).append(vehicle.log)
    try:
        vehicle.wait_ready()
        yield vehicle
    finally:
        vehicle.stop()


def pytest_configure(config: pytest.Config) -> None:
    """Register the marker `sitl`."""
    config.addinivalue_line(
        "markers",
        f"sitl({', '.join(OPTIONS)}): options of the vehicle of the fixture `sitl`",
    )


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(
    item: pytest.Item, call: pytest.CallInfo[None]
) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """Add the paths of the logs to the report of a failed test."""
    report = yield
    logs = [path for path in item.stash.get(LOGS, []) if path.exists()]
    if report.failed and logs:
        report.sections.append(("MAVLink logs", "\n".join(map(str, logs))))
    return report
