"""The processes that work on a flight after its end: of low priority, without output.

The service has one process of this module, which works on one flight after the other as it reads
their directories, and ends with the last of them after the service has ended or was killed.
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
    """Start `offboard COMMAND` on a flight directory. It outlives this process. Raises OSError."""
    return _start("offboard", command, str(directory.absolute()))


def begin_report(directory: Path) -> None:
    """Start the report of a flight. Where it cannot be started there is none."""
    with suppress(OSError):
        begin("report", directory).returncode = 0  # nobody waits for it: no warning at the exit


class OneByOne:
    """`offboard COMMAND` on flights, one at a time. Its process is started with the first one."""

    def __init__(self, command: str) -> None:
        self._command = command
        self._process: subprocess.Popen[bytes] | None = None

    def add(self, directory: Path) -> None:
        """Work on a flight when those before it are done. Raises OSError."""
        if self._process is None or self._process.poll() is not None:
            self._process = _start(__name__, self._command, stdin=subprocess.PIPE)
        assert self._process.stdin is not None
        self._process.stdin.write(json.dumps(str(directory.absolute())).encode() + b"\n")

    def close(self) -> None:
        """No flight follows. Does not wait for those that were added."""
        if self._process is not None and self._process.stdin is not None:
            self._process.stdin.close()
            self._process.returncode = 0  # nobody waits for it: no warning at the exit


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
