"""The report that follows a flight: a process of its own, which nothing waits for."""

from __future__ import annotations

import os
import subprocess
import sys
from contextlib import suppress
from pathlib import Path

_NICENESS = 10  # the next flight may begin meanwhile


def begin_report(directory: Path) -> None:
    """Start `offboard report` on a flight directory, with low priority and without output.

    It outlives this process. Where it cannot be started there is no report.
    """
    command = [sys.executable, "-m", "offboard", "report", str(directory.absolute())]
    silent = subprocess.DEVNULL
    with suppress(OSError):
        process = subprocess.Popen(
            command, stdin=silent, stdout=silent, stderr=silent, start_new_session=True
        )
        os.setpriority(os.PRIO_PROCESS, process.pid, _NICENESS)
        process.returncode = 0  # nobody waits for it: no warning that it still runs
