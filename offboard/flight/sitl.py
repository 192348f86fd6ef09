"""The bundled simulator as processes of their own: started, watched and always stopped.

`offboard` never imports `simulator`; they meet on the wire, and on a pipe that says what to fly.
"""

from __future__ import annotations

import json
import os
import select
import signal
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType

from offboard.documents.reading import DocumentError

OWN_VEHICLES = {"px4": "px4_sih", "ardupilot": "arducopter"}  # flown by default, so known
STOP_S = 2.0
ERRORS_BYTES = 65536
USAGE = 2  # the simulator's exit code for options and files that it cannot use


@dataclass(frozen=True, slots=True)
class Ending:
    """Why a simulator is gone: one sentence, and whether its options or files are to blame."""

    sentence: str
    unusable: bool


def check_scenario(path: Path) -> None:
    """Have the simulator read a scenario file. Raises DocumentError with what is wrong in it."""
    command = [sys.executable, "-m", "simulator", "--check", str(path)]
    answer = subprocess.run(command, capture_output=True, text=True, check=False)
    if answer.returncode:
        raise DocumentError(*answer.stderr.strip().splitlines())


class SimulatorProcess:
    """`python -m simulator.pool`: loads from when it is entered, then flies vehicles one after
    the other, each a process of its own. A context manager; leaving it ends everything."""

    def __init__(self) -> None:
        self._ending: Ending | None = None

    def __enter__(self) -> SimulatorProcess:
        self._open()
        return self

    def _open(self) -> None:
        self._errors = tempfile.TemporaryFile()  # noqa: SIM115 - closed by `close`
        self._process = subprocess.Popen(
            [sys.executable, "-m", "simulator.pool"],
            bufsize=0,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._errors,
            # Ctrl-C in the terminal must land the vehicle, not kill it
            start_new_session=True,
        )

    def launch(self, options: Sequence[str]) -> None:
        """Start a vehicle with `options` of the `simulator` command."""
        if self._process.poll() is not None:  # a flight that lost it shall not be the last one
            self.close()
            self._open()
        self._said_before = os.fstat(self._errors.fileno()).st_size
        self._ending = None
        self._tell(json.dumps(options).encode() + b"\n")

    @property
    def pid(self) -> int:
        """Of the process that loaded; a vehicle is its child."""
        return self._process.pid

    def ended(self, patience_s: float = 0.0) -> Ending | None:
        """How the vehicle's process ended, or None while it runs; waits for its end so long."""
        assert self._process.stdout is not None
        if self._ending is None and select.select([self._process.stdout], [], [], patience_s)[0]:
            answer = self._process.stdout.readline()
            self._ending = self._explained(int(answer) if answer else self._process.wait())
            if not answer:
                self.close()  # what it flew lives on
        return self._ending

    def recall(self) -> None:
        """End the vehicle's process."""
        if self.ended() is None:
            self._tell(b"\n")
            if self.ended(STOP_S) is None:
                self.close()

    def _tell(self, order: bytes) -> None:
        assert self._process.stdin is not None
        with suppress(BrokenPipeError):  # it is gone, which `ended` will say
            self._process.stdin.write(order)

    def _explained(self, code: int) -> Ending:
        errors = os.pread(self._errors.fileno(), ERRORS_BYTES, self._said_before)
        words = errors.decode(errors="replace").strip().splitlines()
        if code == USAGE:
            return Ending(words[-1] if words else "the bundled simulator was refused", True)
        how = f"signal {-code}" if code < 0 else f"exit code {code}"
        said = f": {words[-1]}" if words else ""
        return Ending(f"the bundled simulator ended ({how}){said}", False)

    def close(self) -> None:
        """End everything."""
        if self._errors.closed:
            return
        with suppress(ProcessLookupError, PermissionError):  # nobody is left
            os.killpg(self._process.pid, signal.SIGKILL)  # itself and what it flies
        self._process.wait()
        for pipe in (self._process.stdin, self._process.stdout, self._errors):
            assert pipe is not None
            pipe.close()

    def __exit__(
        self,
        kind: type[BaseException] | None,
        value: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()
