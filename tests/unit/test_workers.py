"""Ctrl-C while other processes are started: it comes when they are."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time

from offboard.analysis.workers import interrupts_deferred

MASK = "import signal; print(signal.SIGINT in signal.pthread_sigmask(signal.SIG_BLOCK, ()))"


def interrupted_meanwhile() -> list[str]:
    """What a process says of its own mask that was started after the interrupt."""
    said = []
    try:
        with interrupts_deferred():
            os.kill(os.getpid(), signal.SIGINT)
            time.sleep(0.05)
            command = (sys.executable, "-c", MASK)
            said.append(subprocess.run(command, capture_output=True, text=True).stdout)
    except KeyboardInterrupt:
        said.append("interrupted")
    return said


def test_an_interrupt_of_meanwhile_comes_afterwards() -> None:
    """Though another thread of ours, with no mask, takes the signal."""
    over = threading.Event()
    threading.Thread(target=over.wait).start()
    try:
        assert interrupted_meanwhile() == ["True\n", "interrupted"]
    finally:
        over.set()
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
