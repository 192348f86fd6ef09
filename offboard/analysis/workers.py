"""Worker processes: how many, and an executor that leaves Ctrl-C to the main process.

A terminal sends Ctrl-C to every process in it. Workers must not act on it: the main process decides
what is still flown.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager

ORPHANED = 1  # exit code of a worker whose parent has ended


def processors() -> int:
    """The number of processors that this process may use (Linux), or that there are."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


@contextmanager
def interrupts_deferred() -> Iterator[None]:
    """Defer SIGINT to the end of the block. For the main thread.

    A process that is started in the block inherits the mask and never receives SIGINT. Without
    signal masks (Windows) nothing changes.
    """
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    received: list[int] = []
    # the mask is that of this thread; another thread of this process may receive the signal
    handler = signal.signal(signal.SIGINT, lambda number, frame: received.append(number))
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        signal.signal(signal.SIGINT, handler)
        if received:
            signal.raise_signal(signal.SIGINT)


@contextmanager
def open_worker() -> Iterator[ProcessPoolExecutor]:
    """An executor of one process. An exception in the block kills the process; otherwise it ends
    when its work is done."""
    # spawn: a forked child would share compiled code and threads in unknown states
    context = multiprocessing.get_context("spawn")
    pool = ProcessPoolExecutor(1, mp_context=context, initializer=_start)
    with interrupts_deferred():
        pool.submit(os.getpid)  # starts the process
    try:
        yield pool
    except BaseException:
        for child in multiprocessing.active_children():
            child.kill()
        raise
    finally:
        pool.shutdown(cancel_futures=True)


def _start() -> None:
    """In the worker: leave the terminal's process group, and end when the parent ends."""
    os.setpgrp()
    parent = multiprocessing.parent_process()
    assert parent is not None

    def follow() -> None:
        parent.join()
        os._exit(ORPHANED)

    threading.Thread(target=follow, daemon=True).start()
