"""The process that works on a flight after its end: of low priority, without output, and one after
the other in the directory of the flights."""

from __future__ import annotations

import os
import subprocess
import sys
from contextlib import suppress
from pathlib import Path

_NICENESS = 10  # the next flight may begin meanwhile
_LONGEST_S = 3600  # one that hangs delays no other for longer
# The lock and the alarm, which ends the process, stay when it becomes another program
_IN_TURN = f"""
import fcntl, os, signal, sys
try:
    turn = os.open(sys.argv[1], os.O_RDONLY)
    os.set_inheritable(turn, True)
    fcntl.flock(turn, fcntl.LOCK_EX)
except OSError:
    pass  # cannot be read, or has no locks
signal.alarm({_LONGEST_S})
os.execv(sys.executable, [sys.executable, "-P", "-m", "offboard", *sys.argv[2:]])
"""


def begin(command: str, directory: Path) -> subprocess.Popen[bytes]:
    """Start `offboard COMMAND` on a flight directory. It outlives this process. Raises OSError."""
    directory = directory.absolute()
    process = subprocess.Popen(
        [sys.executable, "-P", "-c", _IN_TURN, str(directory.parent), command, str(directory)],
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
