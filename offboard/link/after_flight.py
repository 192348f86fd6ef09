"""Processes of low priority that score a flight, or write its report, after its end.

The service starts this module as one process, which reads flight directories from its standard
input and works on one after the other. When the service has ended or was killed, the process
finishes the queued flights and ends.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from contextlib import suppress
from pathlib import Path

_NICENESS = 10  # the next flight may begin meanwhile


def begin(command: str, directory: Path) -> subprocess.Popen[bytes]:
    """Start `offboard COMMAND` on a flight directory, as a process that outlives this one. Raises
    OSError."""
    return _start("offboard", command, str(directory.absolute()))


def begin_report(directory: Path) -> None:
    """Start `offboard report` on a flight directory. If that fails, there is no report."""
    with suppress(OSError):
        begin("report", directory).returncode = 0  # not waited for: Popen would warn at the exit


class OneByOne:
    """Runs `offboard COMMAND` on flights, one at a time, in a process that `add` starts."""

    def __init__(self, command: str) -> None:
        self._command = command
        self._process: subprocess.Popen[bytes] | None = None

    def add(self, directory: Path) -> None:
        """Queue a flight. Raises OSError."""
        if self._process is None or self._process.poll() is not None:
            self._process = _start(__name__, self._command, stdin=subprocess.PIPE)
        assert self._process.stdin is not None
        self._process.stdin.write(json.dumps(str(directory.absolute())).encode() + b"\n")

    def close(self) -> None:
        """End the queue. Does not wait for the flights in it."""
        if self._process is not None and self._process.stdin is not None:
            self._process.stdin.close()
            self._process.returncode = 0  # not waited for: Popen would warn at the exit


def _start(
    module: str, *arguments: str, stdin: int = subprocess.DEVNULL
) -> subprocess.Popen[bytes]:
    process = subprocess.Popen(
        [sys.executable, "-P", "-m", module, *arguments],
        bufsize=0,
        stdin=stdin,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    )
    with suppress(OSError):
        os.setpriority(os.PRIO_PROCESS, process.pid, _NICENESS)
    return process


if __name__ == "__main__":
    for line in sys.stdin:
        with suppress(OSError):
            begin(sys.argv[1], Path(json.loads(line))).wait()
