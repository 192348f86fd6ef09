"""SIGINT while worker processes start: deferred until they have started."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time

import pytest

from offboard.campaign.processes import interrupts_deferred, processors

MASK = "import signal; print(signal.SIGINT in signal.pthread_sigmask(signal.SIG_BLOCK, ()))"


def interrupted_meanwhile() -> list[str]:
    """Whether SIGINT is masked in a process that is started after an interrupt, and that one."""
    outputs = []
    try:
        with interrupts_deferred():
            os.kill(os.getpid(), signal.SIGINT)
            time.sleep(0.05)
            command = (sys.executable, "-c", MASK)
            outputs.append(subprocess.run(command, capture_output=True, text=True).stdout)
    except KeyboardInterrupt:
        outputs.append("interrupted")
    return outputs


def test_an_interrupt_is_deferred_to_the_end_of_the_block() -> None:
    """Also when another thread, without the mask, receives the signal."""
    over = threading.Event()
    threading.Thread(target=over.wait).start()
    # a command that was run in this process may have left its own handler
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        assert interrupted_meanwhile() == ["True\n", "interrupted"]
        assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    finally:
        over.set()
        signal.signal(signal.SIGINT, before)


def test_without_cpu_affinity_all_processors_are_used(monkeypatch: pytest.MonkeyPatch) -> None:
    assert processors() == len(os.sched_getaffinity(0))
    monkeypatch.delattr(os, "sched_getaffinity")
    assert processors() == os.cpu_count()
