"""Where flights are flown: in worker processes of this computer, on a dask cluster, or by one
vehicle at a link.

The first two are executors of `concurrent.futures`. A worker loads its code once, for all flights.
"""

from __future__ import annotations

import logging
import multiprocessing
import os
import re
import signal
import threading
from collections import deque
from collections.abc import Callable, Iterator, Sequence
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
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from offboard.campaign.flight import NOT_FLOWN, Job, fly_job, recorded
from offboard.campaign.results import Record
from offboard.documents.errors import UserError, install, shown
from offboard.flight.phases import OPERATOR_STOP, ExitCode
from offboard.link.log import free_name
from offboard.run.flight import Connection, fly

CONNECT_S = 5.0  # time for a dask scheduler to answer
POLL_S = 0.2  # longest time until a stop request is noticed
QUEUED = 2  # flights submitted per thread of a cluster, so that no thread waits for the next one
ORPHANED = 1  # exit code of a worker whose parent has ended
# Record of a flight whose worker died, and so could not return one
DIED = Record(
    ExitCode.ABORTED, "the worker process died twice during this flight", NOT_FLOWN, "crash"
)


class Flyer(Protocol):
    """Flies jobs, and yields each with its record when its flight ends. Once `ending` returns True,
    no further flight begins. After a UserError the flights that have not ended are lost."""

    def fly(
        self, jobs: Sequence[Job], ending: Callable[[], bool]
    ) -> Iterator[tuple[Job, Record]]: ...


OpenFlyer = Callable[[], AbstractContextManager[Flyer]]


class Workers:
    """Executor that flies up to `width` jobs at a time.

    `open_pool` creates the pool of workers, and a new one after a worker has died. `lost` is the
    error text if the cluster is lost.
    """

    def __init__(self, width: int, open_pool: Callable[[], Executor], lost: str = "") -> None:
        self._width = width
        self._open_pool = open_pool
        self._lost = lost
        self._pool = open_pool()

    def fly(self, jobs: Sequence[Job], ending: Callable[[], bool]) -> Iterator[tuple[Job, Record]]:
        """Fly jobs as described by `Flyer`, in any order.

        If a worker dies, the flights of all workers are lost. Each of them is flown again, alone;
        if its worker dies again, its record is `DIED`.
        """
        again: list[Job] = []
        for job, record in self._run(jobs, ending):
            if record is None:
                again.append(job)
            else:
                yield job, record
        for job in again:
            for _, record in self._run([job], ending):
                yield job, record or DIED

    def _run(
        self, jobs: Sequence[Job], ending: Callable[[], bool]
    ) -> Iterator[tuple[Job, Record | None]]:
        """Fly jobs in parallel. The record is None if a worker died."""
        waiting = deque(jobs)
        busy: dict[Future[Record], Job] = {}
        while busy or waiting:
            if ending():
                waiting.clear()
            while waiting and len(busy) < self._width:
                job = waiting.popleft()
                busy[self._submit(job)] = job
            for done in wait(busy, POLL_S, FIRST_COMPLETED).done:
                yield busy.pop(done), self._record(done)

    def _submit(self, job: Job) -> Future[Record]:
        try:
            return _masked(self._pool, job)
        except BrokenExecutor:
            self._pool = self._open_pool()
            return _masked(self._pool, job)

    def _record(self, done: Future[Record]) -> Record | None:
        try:
            return done.result()
        except CancelledError:
            raise UserError(self._lost) from None
        except Exception as error:
            died = isinstance(error, BrokenExecutor) or type(error).__name__ == "KilledWorker"
            if died:  # KilledWorker is an exception of dask
                return None
            raise


def _masked(pool: Executor, job: Job) -> Future[Record]:
    """Submit a job while SIGINT is blocked. A process that starts for it inherits the signal mask,
    so that Ctrl-C reaches only the main process. The pool must be created without the mask, because
    multiprocessing's resource tracker, which starts then, unblocks SIGINT."""
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        return pool.submit(fly_job, job)
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)


@dataclass(frozen=True, slots=True)
class ConnectedVehicle:
    """The vehicle at the link of its cases, which may be a real one. This process flies the cases
    one after the other. If a flight is refused, aborted or ended by a change of mode, no further
    one is flown.
    """

    system_id: int | None = None
    signing_key: Path | None = None

    def fly(self, jobs: Sequence[Job], ending: Callable[[], bool]) -> Iterator[tuple[Job, Record]]:
        """Fly jobs as described by `Flyer`. A flight that the operator stops or that is refused has
        no record, and the next run flies it again. Raises UserError after a flight that was refused
        or aborted."""
        for job in jobs:
            if ending():
                return
            record = self._record(job)
            if record.sentence.startswith(OPERATOR_STOP):
                return  # the flight received the interrupt
            if record.exit_code != ExitCode.REFUSED:
                yield job, record
            if record.exit_code in (ExitCode.REFUSED, ExitCode.ABORTED):
                case = job.case
                raise UserError(
                    f"ended with {case.controller} on {case.reference}, seed {case.seed} "
                    f"({record.sentence}); nothing more was flown"
                )

    def _record(self, job: Job) -> Record:
        assert job.kept is not None
        if job.kept.exists():  # log of a flight without a record: keep it under another name
            job.kept.rename(free_name(job.kept))
        assert job.case.link is not None
        vehicle = Connection(job.case.link, self.system_id, self.signing_key)
        return recorded(job, job.kept, lambda config, place: fly(config, place, vehicle))


@contextmanager
def local_workers(count: int | None) -> Iterator[Workers]:
    """Open worker processes on this computer. Each is started when it is first needed."""
    width = count or processors()
    with ExitStack() as stack:
        yield Workers(width, lambda: stack.enter_context(_processes(width)))


def processors() -> int:
    """Return the number of processors that this process may use (Linux), or else of all."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


@contextmanager
def _processes(width: int) -> Iterator[Executor]:
    """Open an executor of processes. An exception in the block kills them; otherwise they end when
    their work is done."""
    # spawn, because a forked child would share compiled code and threads in unknown states
    context = multiprocessing.get_context("spawn")
    os.environ["PYTHONSAFEPATH"] = "1"  # for the workers, as `python -P`
    # The resource tracker deletes the semaphores of a killed process and would warn about it
    os.environ.setdefault("PYTHONWARNINGS", "ignore::UserWarning:multiprocessing.resource_tracker")
    pool = ProcessPoolExecutor(width, mp_context=context, initializer=_start)
    try:
        yield pool
    except BaseException:
        for child in multiprocessing.active_children():
            child.kill()
        raise
    finally:
        pool.shutdown(cancel_futures=True)


def _start() -> None:
    """Initialise a worker: leave the terminal's process group, and end when the parent ends."""
    os.setpgrp()
    parent = multiprocessing.parent_process()
    assert parent is not None

    def follow() -> None:
        parent.join()
        os._exit(ORPHANED)

    threading.Thread(target=follow, daemon=True).start()


@contextmanager
def cluster_workers(address: str) -> Iterator[Workers]:
    """Open the workers of a dask scheduler, for example at "tcp://127.0.0.1:8786".

    Raises UserError if no scheduler answers, if it has no workers, or if dask is not installed.
    """
    try:
        from distributed import Client
    except ImportError:
        raise UserError(f"--scheduler needs dask: {install('cluster')}") from None
    for logger in ("distributed", "distributed.client"):  # we report a lost scheduler ourselves
        logging.getLogger(logger).setLevel(logging.CRITICAL)
    if not re.fullmatch(r"(tcp|tls)://\S+:[0-9]{1,5}", address):
        raise UserError(f"--scheduler {shown(address)}: give tcp://HOST:PORT, or tls://HOST:PORT")
    try:
        client = Client(address, timeout=CONNECT_S, set_as_default=False)
    except OSError as error:
        reason = " ".join(str(error).split())
        raise UserError(f"no dask scheduler at {shown(address)}: {reason}") from None
    try:
        threads = sum(client.nthreads().values())
        if not threads:
            raise UserError(f"the dask scheduler at {address} has no worker: start one")
        lost = f"the dask scheduler at {address} was lost"
        yield Workers(QUEUED * threads, lambda: client.get_executor(pure=False), lost)
    finally:
        client.close(timeout=1.0)
