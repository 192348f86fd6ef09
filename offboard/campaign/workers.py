"""Where flights are flown: worker processes of this computer, a dask cluster by its address, or one
vehicle at a link.

The first two are executors of `concurrent.futures`. A worker loads its code once and stays.
"""

from __future__ import annotations

import itertools
import logging
import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import BrokenExecutor, CancelledError, Executor
from contextlib import AbstractContextManager, ExitStack, contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

from offboard.campaign.flight import Job, fly_job, recorded
from offboard.campaign.margin import NOT_FLOWN
from offboard.campaign.processes import open_worker, processors, run_all
from offboard.campaign.results import Record
from offboard.documents.arguments import join_address, split_address
from offboard.documents.errors import UserError, shown
from offboard.documents.extras import install
from offboard.flight.flight import STOPPED
from offboard.flight.phases import ExitCode
from offboard.link.stream_sources import connect
from offboard.run.flight import Connection, fly

CONNECT_S = 5.0
SCHEMES = ("tcp", "tls")
QUEUED = 2  # flights per thread of a cluster, so that none waits for us
DIED = Record(
    ExitCode.ABORTED, "the process that flew it ended, twice", NOT_FLOWN, "crash"
)  # as its worker cannot tell


class Flyer(Protocol):
    """Flies jobs and yields each with its record when it ends; when `ending` is true, no further
    flight begins. Raises UserError; what has not ended is then lost."""

    def fly(
        self, jobs: Sequence[Job], ending: Callable[[], bool]
    ) -> Iterator[tuple[Job, Record]]: ...


OpenFlyer = Callable[[], AbstractContextManager[Flyer]]


@dataclass(frozen=True, slots=True)
class Workers:
    """An open set of workers. `check` raises UserError when they are lost."""

    width: int
    open_one: Callable[[], AbstractContextManager[Executor]]
    check: Callable[[], None] = lambda: None

    def fly(self, jobs: Sequence[Job], ending: Callable[[], bool]) -> Iterator[tuple[Job, Record]]:
        """Fly jobs, as a `Flyer` does, in any order. A flight whose worker dies is flown a second
        time; if that worker dies too, `DIED` is its record."""
        again: list[Job] = []
        for job, result in self._run(jobs, ending):
            if isinstance(result, BrokenExecutor):
                again.append(job)
            else:
                yield job, _record_of(result)
        for job, result in self._run(again, ending):
            yield job, DIED if isinstance(result, BrokenExecutor) else _record_of(result)

    def _run(
        self, jobs: Sequence[Job], ending: Callable[[], bool]
    ) -> Iterator[tuple[Job, Record | BaseException]]:
        def watched() -> bool:
            self.check()
            return ending()

        for job, result in run_all(jobs, fly_job, self.open_one, self.width, watched):
            if isinstance(result, CancelledError):  # of a cluster that is lost
                self.check()
            yield job, _killed(result)


def _killed(result: Record | BaseException) -> Record | BaseException:
    """dask's own error for a worker that died, as that of an executor."""
    if type(result).__name__ == "KilledWorker":
        return BrokenExecutor(str(result))
    return result


def _record_of(result: Record | BaseException) -> Record:
    if isinstance(result, CancelledError):
        raise UserError("the dask scheduler was lost")
    if isinstance(result, BaseException):
        raise result
    return result


@dataclass(frozen=True, slots=True)
class ConnectedVehicle:
    """The vehicle at the link of its cases, a real one perhaps. Its flights follow each other in
    this process; after one that was refused, aborted or ended by the pilot, nothing more is flown.
    """

    system_id: int | None = None
    signing_key: Path | None = None

    def fly(self, jobs: Sequence[Job], ending: Callable[[], bool]) -> Iterator[tuple[Job, Record]]:
        """Fly jobs, as a `Flyer` does. A flight that the operator stops, or the vehicle refuses,
        has no record, and is flown by the next run. Raises UserError after one that was refused or
        aborted."""
        for job in jobs:
            if ending():
                return
            record = self._record(job)
            if record.sentence.startswith(STOPPED):
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
        _move_aside(job.kept)
        assert job.case.link is not None
        vehicle = Connection(job.case.link, self.system_id, self.signing_key)
        return recorded(
            job.case.load, job.kept, job.promises, lambda config, place: fly(config, place, vehicle)
        )


def _move_aside(directory: Path) -> None:
    """Rename the log of a flight that has no record, so that it can be flown again."""
    numbers = itertools.count(1)
    aside = (directory.with_name(f"{directory.name}-before-{number}") for number in numbers)
    if directory.exists():
        directory.rename(next(path for path in aside if not path.exists()))


@contextmanager
def local_workers(count: int | None) -> Iterator[Workers]:
    """Worker processes of this computer, each opened when it is first needed. They stay, with
    their code loaded, from one `Workers.fly` to the next."""
    idle: list[Executor] = []
    with ExitStack() as stack:

        @contextmanager
        def open_one() -> Iterator[Executor]:
            idle[:] = [worker for worker in idle if _lives(worker)]
            worker = idle.pop() if idle else stack.enter_context(open_worker())
            yield worker
            idle.append(worker)

        yield Workers(count or processors(), open_one)


def _lives(worker: Executor) -> bool:
    try:
        worker.submit(os.getpid).result()
    except BrokenExecutor:
        return False
    return True


@contextmanager
def cluster_workers(address: str) -> Iterator[Workers]:
    """The workers of a dask scheduler, for example at "tcp://127.0.0.1:8786".

    Raises UserError where none answers, or dask is not installed.
    """
    try:
        from distributed import Client
    except ImportError:
        raise UserError(f"--scheduler needs dask: {install('cluster')}") from None
    for logger in ("distributed", "distributed.client"):  # a scheduler that is lost is our sentence
        logging.getLogger(logger).setLevel(logging.CRITICAL)
    kind, host, port = _split(address)
    try:
        connect(host, port).close()  # at once, where dask tries for the whole of its timeout
        client = Client(
            f"{kind}://{join_address(host, port)}", timeout=CONNECT_S, set_as_default=False
        )
    except (OSError, UnicodeError) as error:
        reason = " ".join((getattr(error, "strerror", None) or str(error)).split())
        raise UserError(f"no dask scheduler at {address}: {reason}") from None
    try:
        threads = sum(client.nthreads().values())
        if not threads:
            raise UserError(f"the dask scheduler at {address} has no worker: start one")
        executor = client.get_executor(pure=False)
        yield Workers(
            QUEUED * threads, lambda: nullcontext(executor), lambda: _check(client, address)
        )
    finally:
        client.close(timeout=1.0)


def _split(address: str) -> tuple[str, str, int]:
    """Scheme, host and port. Raises UserError."""
    kind, separator, place = address.rpartition("://")
    if separator and kind not in SCHEMES:
        raise UserError(f"--scheduler {shown(address)}: give tcp://HOST:PORT, or tls://HOST:PORT")
    return kind or SCHEMES[0], *split_address("--scheduler", place)


def _check(client: Any, address: str) -> None:
    if client.status != "running":
        raise UserError(f"the dask scheduler at {address} was lost")
