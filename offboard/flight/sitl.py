"""The bundled simulator as a process of its own: started, watched and always stopped.

`offboard` never imports `simulator`; they meet on the wire.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from types import TracebackType

STOP_S = 2.0


class SimulatorProcess:
    """`python -m simulator` sending to a port of ours, in lockstep. A context manager."""

    def __init__(self, *, port: int, seed: int, scenario: str, vehicle: str | None) -> None:
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
            "--scenario",
            scenario,
            *(("--vehicle", vehicle) if vehicle else ()),
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

    def ended(self) -> str | None:
        """One sentence if the process is gone, with its own last words."""
        code = self._process.poll()
        if code is None:
            return None
        self._errors.seek(0)
        words = self._errors.read().decode(errors="replace").strip().splitlines()
        return (
            f"the bundled simulator ended (exit code {code}): {words[-1] if words else 'silently'}"
        )

    @property
    def exit_code(self) -> int | None:
        return self._process.poll()

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
