"""Runs the bundled simulator, either as a process that is watched and always stopped, or in this
process without a socket (campaigns, pytest). A flight is the same with either, byte for byte.

`offboard` never imports `simulator`. They exchange MAVLink. The simulator in this process is found
by its entry point.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from collections.abc import Hashable, Sequence
from dataclasses import dataclass
from functools import cache
from importlib.metadata import EntryPoint, entry_points
from typing import Any, Protocol

from offboard.documents import shipped
from offboard.documents.errors import UserError
from offboard.link import clock
from offboard.link.interface import Chunk, Link

OWN_VEHICLES = {"px4": "px4_sih", "ardupilot": "arducopter"}  # the simulator's default vehicles
# the process ends when the pipe to it closes, also if this process was killed
PROGRAM = "from simulator.cli import main_until_input_ends; main_until_input_ends()"
ERRORS_BYTES = 65536  # read from stderr of a simulator that has ended
USAGE = 2  # the simulator's exit code for options and files that it cannot use
GROUP, NAME = "pso_offboard.simulators", "bundled"  # the simulator's entry point


@dataclass(frozen=True, slots=True)
class Ending:
    """How a simulator ended. `unusable`: whether its options or files were wrong."""

    sentence: str
    unusable: bool


@cache
def check_scenario_named(name: str) -> None:
    """Check a scenario that is given by name or path. Shipped scenarios are valid and are not
    checked. Raises DocumentError."""
    path = shipped.locate(name, "scenario")
    if shipped.directory() not in path.parents:
        check_scenario(shipped.read_text(path), str(path))


def check_scenario(text: str, source: str) -> None:
    """Let the simulator validate the YAML `text` of a scenario; errors name it `source`. Raises
    DocumentError."""
    registered().load().check_scenario(text, source)


class SimulatorProcess:
    """Runs one vehicle after the other, each in a process of its own."""

    process: subprocess.Popen[bytes]

    def launch(self, options: Sequence[str]) -> None:
        """Start a vehicle with `options` of the `simulator` command."""
        self._errors = tempfile.TemporaryFile()  # noqa: SIM115 - closed by `recall`
        self.process = subprocess.Popen(
            [sys.executable, "-P", "-c", PROGRAM, *options],
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=self._errors,
            # Ctrl-C must reach only our process, which lands the vehicle
            start_new_session=True,
        )

    def ending(self) -> Ending | None:
        """How the vehicle's process ended, or None while it runs."""
        code = self.process.poll()
        if code is None:
            return None
        errors = os.pread(self._errors.fileno(), ERRORS_BYTES, 0)
        lines = errors.decode(errors="replace").strip().splitlines()
        if code == USAGE:
            return Ending(lines[-1] if lines else "the bundled simulator refused its options", True)
        how = f"signal {-code}" if code < 0 else f"exit code {code}"
        detail = f": {lines[-1]}" if lines else ""
        return Ending(f"the bundled simulator ended ({how}){detail}", False)

    def recall(self) -> None:
        """End the vehicle's process."""
        self.process.kill()
        self.process.communicate()  # it waits, and closes the pipe
        self._errors.close()


# --- in this process ---


class InMemoryVehicle(Protocol):
    """A simulated vehicle in lockstep. Its constructor has the arguments `firmware`, `scenario` and
    `vehicle` (name or file; None: the firmware's default), `seed` and `parameters`.

    `exchange` takes frames of the companion and returns sender and bytes of all datagrams up to the
    next barrier; it returns nothing until the companion has replied to the previous barrier.
    """

    def exchange(self, frames: Sequence[bytes]) -> list[tuple[int, bytes]]: ...


class InMemoryLink(Link):
    """The link to a vehicle in this process. `problem`: the exception that ended the vehicle."""

    def __init__(self, vehicle: InMemoryVehicle) -> None:
        super().__init__()
        self.problem: Exception | None = None
        self._vehicle = vehicle
        self._sent: list[bytes] = []

    def receive(self) -> list[Chunk]:
        """All datagrams up to the next barrier; the simulator computes them in this call."""
        frames, self._sent = self._sent, []
        if self.problem is not None:
            return []
        try:
            datagrams = self._vehicle.exchange(frames)
        except Exception as error:
            self.problem = error
            return []
        now_s = clock.monotonic_s()
        return [Chunk(data, ("simulator", sender), now_s) for sender, data in datagrams]

    def send(self, data: bytes, peer: Hashable | None) -> None:
        self._sent.append(data)


class InMemorySimulator:
    """Replaces a `SimulatorProcess`: runs one vehicle after the other in this process."""

    def __init__(self) -> None:
        self._link: InMemoryLink | None = None

    def open_link(self, **options: Any) -> InMemoryLink:
        """Start a vehicle and return the link to it; `options`: see `InMemoryVehicle`. Raises
        DocumentError."""
        vehicle: InMemoryVehicle = registered().load()(**options)
        self._link = InMemoryLink(vehicle)
        return self._link

    def ending(self) -> Ending | None:
        """How the vehicle ended, or None while it runs."""
        problem = self._link.problem if self._link else None
        if problem is None:
            return None
        return Ending(f"the bundled simulator failed ({type(problem).__name__}: {problem})", False)

    def recall(self) -> None:
        """Drop the vehicle."""
        self._link = None


@cache
def registered() -> EntryPoint:
    """The entry point of the bundled simulator. Raises UserError if it is not installed."""
    for point in entry_points(group=GROUP):
        if point.name == NAME:
            return point
    raise UserError(f"the bundled simulator is not registered ({GROUP}); install the package again")
