"""Checks of this computer: its disk, compiled functions, decision time and wake-up latency; and
which other processes use a port or a serial device.

Without /proc (macOS) the users of a port are not known, and none are reported.
"""

from __future__ import annotations

import os
import shutil
import threading
from collections.abc import Iterable, Iterator
from contextlib import suppress
from pathlib import Path

from offboard import compiled as compilation
from offboard.doctor.checks import Check, blocks, ok, warn
from offboard.doctor.listening import Observation
from offboard.documents.errors import DocumentError
from offboard.flight.preflight import Finding
from offboard.link import clock
from offboard.run.configuration import FlightConfig
from offboard.run.flight import build, rehearse

PROC = Path("/proc")
TABLES = {"udpin": ("udp", "udp6"), "tcpin": ("tcp", "tcp6")}
# States in /proc/net of a socket that receives on a port: UDP bound or connected, TCP listening
STATES = {"udp": ("07", "01"), "tcp": ("0A",)}
SLEEPS, SLEEP_S = 40, 0.01  # number and length of the sleeps that measure the wake-up latency
LEAST_FREE_BYTES = 500_000_000  # three hours of log
OVERSHOOT_S = 0.02  # wake-up latency above which there is a warning
MARGIN = 0.5  # share of the deadline that a decision may take without a warning


def holders(connection: str) -> tuple[str, ...]:
    """The other processes that listen on the port of `connection` or have its serial device open,
    each as "program (pid 1234)". Those of other users are "a program of user 1000" (ports only)."""
    kind, _, rest = connection.partition(":")
    with suppress(OSError, ValueError):
        if kind == "serial":
            device = os.path.realpath(rest.rpartition(":")[0])
            return tuple(_names(pid for pid, target in _descriptors() if target == device))
        if kind in TABLES:
            return tuple(_of_port(kind, int(rest.rpartition(":")[2])))
    return ()


def _of_port(kind: str, port: int) -> Iterator[str]:
    owners = dict(_sockets(kind, port))
    links = {f"socket:[{inode}]": inode for inode in owners}
    seen = [(pid, links[target]) for pid, target in _descriptors() if target in links]
    yield from _names(pid for pid, _ in seen)
    for inode in owners.keys() - {inode for _, inode in seen}:
        yield f"a program of user {owners[inode]}"


def _sockets(kind: str, port: int) -> Iterator[tuple[str, str]]:
    """Inode and user id of each socket that listens on `port`."""
    for table in TABLES[kind]:
        with suppress(OSError):
            for line in (PROC / "net" / table).read_text().splitlines()[1:]:
                fields = line.split()
                local = int(fields[1].rpartition(":")[2], 16)
                if local == port and fields[3] in STATES[table[:3]]:
                    yield fields[9], fields[7]


def _descriptors() -> Iterator[tuple[int, str]]:
    """Process id and target of each open descriptor of other processes that this user may read."""
    for process in PROC.iterdir():
        if process.name.isdigit() and int(process.name) != os.getpid():
            with suppress(OSError):
                for descriptor in (process / "fd").iterdir():
                    with suppress(OSError):
                        yield int(process.name), os.readlink(descriptor)


def _names(pids: Iterable[int]) -> Iterator[str]:
    for pid in dict.fromkeys(pids):
        name = "a program"
        with suppress(OSError):
            name = (PROC / str(pid) / "comm").read_text().strip()
        yield f"{name} (pid {pid})"


def disk(seen: Observation) -> Iterable[Finding]:
    """Whether the log of a flight can be written, and free space for it."""
    place = seen.directory.absolute()
    place = next(each for each in (place, *place.parents) if os.access(each, os.F_OK))
    free = shutil.disk_usage(place).free
    figures = f"{free / 1e9:.1f} GB free in {seen.directory}"
    if not (place.is_dir() and os.access(place, os.W_OK)):
        yield blocks(f"{place} cannot be written", "choose another directory with --out")
    elif free < LEAST_FREE_BYTES:
        yield warn(f"{figures}; a flight lands when its log cannot be written", "free some space")
    else:
        yield ok(figures)


def compiled(seen: Observation) -> Iterable[Finding]:
    """Whether the compiled functions are ready."""
    missing = _not_compiled()
    if missing:
        found = f"{missing} functions are not compiled yet: the first flight begins late"
        yield warn(found, "run `offboard fly --sitl` once")
    else:
        yield ok("all functions are compiled")


def computer(seen: Observation) -> Iterable[Finding]:
    """Whether this computer decides and wakes up in time."""
    if not _not_compiled():  # compiling takes longer than the whole check
        yield from _decision(seen.config)
    overshoot_s = max(_sleep() for _ in range(SLEEPS))
    figures = f"this computer wakes up at most {1e3 * overshoot_s:.1f} ms late"
    hint = "close other programs; use the performance governor of the processor"
    yield warn(figures, hint) if overshoot_s > OVERSHOOT_S else ok(figures)


def _not_compiled() -> int:
    return sum(not each.is_compiled for each in compilation.defined)


def _decision(config: FlightConfig) -> Iterable[Finding]:
    """Whether the controller works on this computer and decides in time."""
    try:
        prepared = build(config)
    except DocumentError:  # the check `configuration` reports it
        return
    try:
        took_s = rehearse(prepared, keeps_deadline=True)
    except DocumentError as error:
        yield blocks(str(error), "choose another controller, or a longer deadline_s or period_s")
        return
    figures = f"a decision takes {1e3 * took_s:.1f} ms of {1e3 * config.budget_s:.0f} ms"
    hint = "close other programs, or allow more time (deadline_s, period_s)"
    yield warn(figures, hint) if took_s > MARGIN * config.budget_s else ok(figures)


def _sleep() -> float:
    """Wake-up latency: the time in seconds by which a sleep of SLEEP_S was too long."""
    began_s = clock.monotonic_s()
    threading.Event().wait(SLEEP_S)
    return clock.monotonic_s() - began_s - SLEEP_S


OF_COMPUTER: tuple[Check, ...] = (disk, compiled, computer)
