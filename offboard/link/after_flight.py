"""The process that works on a flight after its end: of low priority, without output."""

from __future__ import annotations

import os
import subprocess
import sys
from contextlib import suppress
from pathlib import Path

_NICENESS = 10  # the next flight may begin meanwhile


def begin(command: str, directory: Path) -> subprocess.Popen[bytes]:
    """Start `offboard COMMAND` on a flight directory. It outlives this process. Raises OSError."""
    process = subprocess.Popen(
        [sys.executable, "-P", "-m", "offboard", command, str(directory.absolute())],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    )
    with suppress(OSError):
        os.setpriority(os.PRIO_PROCESS, process.pid, _NICENESS)
    return process


def begin_report(directory: Path) -> None:
    """Start the report of a flight. Where it cannot be started there is none."""
    with suppress(OSError):
        begin("report", directory).returncode = 0  # nobody waits for it: no warning at the exit
