"""Worker processes: how many, an executor that leaves Ctrl-C to the main process, and its jobs.

A terminal sends Ctrl-C to every process in it. Workers must not act on it: the main process decides
what is still flown.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections import deque
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import (
    FIRST_COMPLETED,
    BrokenExecutor,
    CancelledError,
    Executor,
    Future,
    ProcessPoolExecutor,
    wait,
)
from contextlib import AbstractContextManager, ExitStack, contextmanager
from typing import TypeVar

Job = TypeVar("Job")
Result = TypeVar("Result")
POLL_S = 0.2
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
    os.environ["PYTHONSAFEPATH"] = "1"  # of the child: as `python -P`
    # of multiprocessing's tracker: it deletes the semaphores of a killed process, and warns of it
    os.environ.setdefault("PYTHONWARNINGS", "ignore::UserWarning:multiprocessing.resource_tracker")
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


def run_all(
    jobs: Sequence[Job],
    work: Callable[[Job], Result],
    open_worker: Callable[[], AbstractContextManager[Executor]],
    width: int,
    ending: Callable[[], bool],
) -> Generator[tuple[Job, Result | BaseException]]:
    """Do all jobs in `width` workers; yield each with its result, or its exception, when it ends.

    `work` is called in a worker, so it must be picklable. `ending` is called every POLL_S; when it
    is true, no further job begins. Every worker is an executor of its own: if it dies, its job
    yields BrokenExecutor and a new worker replaces it.
    """
    waiting = deque(jobs)
    with ExitStack() as stack:
        idle = [stack.enter_context(open_worker()) for _ in range(min(width, len(jobs)))]
        busy: dict[Future[Result], tuple[Job, Executor]] = {}
        while busy or waiting:
            if ending():
                waiting.clear()
            while idle and waiting:
                job, worker = waiting.popleft(), idle.pop()
                busy[worker.submit(work, job)] = job, worker
            for done in wait(busy, POLL_S, FIRST_COMPLETED).done:
                job, worker = busy.pop(done)
                error = CancelledError() if done.cancelled() else done.exception()
                if not isinstance(error, BrokenExecutor):
                    idle.append(worker)
                elif waiting:
                    idle.append(stack.enter_context(open_worker()))
                yield job, done.result() if error is None else error


def _start() -> None:
    """In the worker: leave the terminal's process group, and end when the parent ends."""
    os.setpgrp()
    parent = multiprocessing.parent_process()
    assert parent is not None

    def follow() -> None:
        parent.join()
        os._exit(ORPHANED)

    threading.Thread(target=follow, daemon=True).start()
