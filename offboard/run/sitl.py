"""Runs the bundled simulator, either as a process that is watched and always stopped, or in this
process without a socket (for campaigns). A flight is the same with either, byte for byte.

`offboard` never imports `simulator`. They exchange MAVLink; a pipe carries the simulator's options.
The simulator in this process is found by its entry point.
"""

from __future__ import annotations

import json
import os
import select
import signal
import subprocess
import sys
import tempfile
from collections.abc import Hashable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from importlib.metadata import EntryPoint, entry_points
from typing import Any, Protocol

from offboard.documents import shipped
from offboard.documents.errors import UserError
from offboard.link import clock
from offboard.link.interface import Chunk, Link

OWN_VEHICLES = {"px4": "px4_sih", "ardupilot": "arducopter"}  # the simulator's default vehicles
STOP_S = 2.0  # for the vehicle's process to end, before it is killed
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
    """Context manager for `python -m simulator.pool`. The pool loads the simulator once, then
    starts one vehicle after the other, each as its child process. Leaving the context ends all
    processes."""

    def __init__(self) -> None:
        self._ending: Ending | None = None

    def __enter__(self) -> SimulatorProcess:
        self._open()
        return self

    def _open(self) -> None:
        self._errors = tempfile.TemporaryFile()  # noqa: SIM115 - closed by `close`
        self.process = subprocess.Popen(
            [sys.executable, "-P", "-m", "simulator.pool"],
            bufsize=0,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._errors,
            # Ctrl-C must reach only our process, which lands the vehicle
            start_new_session=True,
        )

    def launch(self, options: Sequence[str]) -> None:
        """Start a vehicle with `options` of the `simulator` command."""
        if self.process.poll() is not None:  # the pool died in an earlier flight
            self.close()
            self._open()
        self._errors_before = os.fstat(self._errors.fileno()).st_size
        self._ending = None
        self._write(json.dumps(options).encode() + b"\n")

    def ending(self, timeout_s: float = 0.0) -> Ending | None:
        """How the vehicle's process ended, or None if it still runs after `timeout_s`."""
        assert self.process.stdout is not None
        if self._ending is None and select.select([self.process.stdout], [], [], timeout_s)[0]:
            code = self.process.stdout.readline()
            self._ending = self._explain(int(code) if code else self.process.wait())
            if not code:
                self.close()  # the pool died, its vehicle may still run
        return self._ending

    def recall(self) -> None:
        """End the vehicle's process."""
        if self.ending() is None:
            self._write(b"\n")
            if self.ending(STOP_S) is None:
                self.close()

    def _write(self, line: bytes) -> None:
        assert self.process.stdin is not None
        with suppress(BrokenPipeError):  # the pool died; `ending` reports it
            self.process.stdin.write(line)

    def _explain(self, code: int) -> Ending:
        errors = os.pread(self._errors.fileno(), ERRORS_BYTES, self._errors_before)
        lines = errors.decode(errors="replace").strip().splitlines()
        if code == USAGE:
            return Ending(lines[-1] if lines else "the bundled simulator refused its options", True)
        how = f"signal {-code}" if code < 0 else f"exit code {code}"
        detail = f": {lines[-1]}" if lines else ""
        return Ending(f"the bundled simulator ended ({how}){detail}", False)

    def close(self) -> None:
        """End all processes."""
        if self._errors.closed:
            return
        with suppress(ProcessLookupError, PermissionError):  # no process is left
            os.killpg(self.process.pid, signal.SIGKILL)  # the pool and its vehicle
        self.process.wait()
        for pipe in (self.process.stdin, self.process.stdout, self._errors):
            assert pipe is not None
            pipe.close()

    def __exit__(self, *_: object) -> None:
        self.close()


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

    def ending(self, timeout_s: float = 0.0) -> Ending | None:
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
