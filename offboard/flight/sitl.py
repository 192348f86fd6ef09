"""The bundled simulator as a process of its own: started, watched and always stopped.

`offboard` never imports `simulator`; they meet on the wire.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from types import TracebackType

OWN_VEHICLES = {"ardupilot": "arducopter"}  # flown by the simulator, so believed of it as well
STOP_S = 2.0
USAGE = 2  # the simulator's exit code for options and files that it cannot use


@dataclass(frozen=True, slots=True)
class Ending:
    """Why a simulator is gone: one sentence, and whether its options or files are to blame."""

    sentence: str
    unusable: bool


class SimulatorProcess:
    """`python -m simulator` sending to a port of ours, in lockstep. A context manager."""

    def __init__(
        self,
        *,
        port: int,
        seed: int,
        firmware: str,
        scenario: str | None,
        vehicle: str | None,
        parameters: Mapping[str, float],
    ) -> None:
        self._command = [
            sys.executable,
            "-m",
            "simulator",
            "--connect",
            f"udpout:127.0.0.1:{port}",
            "--gcs",
            "none",
            "--lockstep",
            "--seed",
            str(seed),
            "--firmware",
            firmware,
            *(("--scenario", scenario) if scenario else ()),
            *(("--vehicle", vehicle) if vehicle else ()),
            *(f"--param={name}={value:g}" for name, value in parameters.items()),
        ]

    def __enter__(self) -> SimulatorProcess:
        self._errors = tempfile.TemporaryFile()
        self._process = subprocess.Popen(
            self._command,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=self._errors,
            # Ctrl-C in the terminal must land the vehicle, not kill it
            start_new_session=True,
        )
        return self

    def ended(self) -> Ending | None:
        """How the process ended, or None while it runs."""
        code = self._process.poll()
        if code is None:
            return None
        self._errors.seek(0)
        words = self._errors.read().decode(errors="replace").strip().splitlines()
        if code == USAGE:
            return Ending(words[-1] if words else "the bundled simulator was refused", True)
        how = f"signal {-code}" if code < 0 else f"exit code {code}"
        said = f": {words[-1]}" if words else ""
        return Ending(f"the bundled simulator ended ({how}){said}", False)

    def __exit__(
        self,
        kind: type[BaseException] | None,
        value: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._process.terminate()
        try:
            self._process.wait(STOP_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._errors.close()
