"""This computer: which other processes have a port or a serial device, where this one runs; disk,
compiled functions, time of a decision, late waking up.

Without /proc (macOS) nothing is known of ports, and nothing is said.
"""

from __future__ import annotations

import os
import shutil
import threading
from collections.abc import Iterable, Iterator
from contextlib import suppress
from pathlib import Path

from offboard import compiled
from offboard.doctor.observation import Computer
from offboard.documents.errors import DocumentError
from offboard.link import clock
from offboard.run.configuration import FlightConfig
from offboard.run.flight import build, rehearse

PROC = Path("/proc")
TABLES = {"udpin": ("udp", "udp6"), "tcpin": ("tcp", "tcp6")}
# States of a socket that has a port: UDP bound or connected, TCP listening
STATES = {"udp": ("07", "01"), "tcp": ("0A",)}
CONTAINER_MARKS = ("/.dockerenv", "/run/.containerenv")
SLEEPS, SLEEP_S = 40, 0.01


def holders(connection: str) -> tuple[str, ...]:
    """The other processes that listen on the port of `connection`, or have its serial device open,
    as "program (pid 1234)". Those of other users are found as "a program of user 1000"."""
    kind, _, rest = connection.partition(":")
    with suppress(OSError, ValueError):
        if kind == "serial":
            device = os.path.realpath(rest.rpartition(":")[0])
            return tuple(_names(pid for pid, target in _descriptors() if target == device))
        if kind in TABLES:
            return tuple(_of_port(kind, int(rest.rpartition(":")[2])))
    return ()


def surroundings() -> str:
    """ "WSL", "container", or empty on a machine of its own."""
    with suppress(OSError):
        if "microsoft" in (PROC / "version").read_text().lower():
            return "WSL"
    return "container" if any(os.path.exists(mark) for mark in CONTAINER_MARKS) else ""


def _of_port(kind: str, port: int) -> Iterator[str]:
    owners = dict(_sockets(kind, port))
    links = {f"socket:[{inode}]": inode for inode in owners}
    seen = [(pid, links[target]) for pid, target in _descriptors() if target in links]
    yield from _names(pid for pid, _ in seen)
    for inode in owners.keys() - {inode for _, inode in seen}:
        yield f"a program of user {owners[inode]}"


def _sockets(kind: str, port: int) -> Iterator[tuple[str, str]]:
    """Inode and user of each socket that listens on a port."""
    for table in TABLES[kind]:
        with suppress(OSError):
            for line in (PROC / "net" / table).read_text().splitlines()[1:]:
                fields = line.split()
                local = int(fields[1].rpartition(":")[2], 16)
                if local == port and fields[3] in STATES[table[:3]]:
                    yield fields[9], fields[7]


def _descriptors() -> Iterator[tuple[int, str]]:
    """Process id and target of each open descriptor that may be read, but those of this process."""
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


def measure(config: FlightConfig, directory: Path, *, clock_step_s: float) -> Computer:
    """Measure this computer for a flight of `config` that is recorded in `directory`."""
    decision_s, rehearsal = None, ""
    missing = sum(not each.is_compiled for each in compiled.defined)
    if not missing:  # compiling takes longer than the whole check
        prepared = None
        with suppress(DocumentError):  # a reference that cannot be flown is another check
            prepared = build(config)
        try:
            decision_s = rehearse(prepared, keeps_deadline=True) if prepared else None
        except DocumentError as error:
            rehearsal = str(error)
    return Computer(
        directory=str(directory),
        free_bytes=_free_bytes(directory),
        overshoot_s=_overshoot_s(),
        not_compiled=missing,
        decision_s=decision_s,
        deadline_s=config.deadline_s,
        rehearsal=rehearsal,
        clock_step_s=clock_step_s,
    )


def _free_bytes(directory: Path) -> int | None:
    with suppress(OSError):
        places = (directory.absolute(), *directory.absolute().parents)
        return shutil.disk_usage(next(each for each in places if each.exists())).free
    return None


def _overshoot_s() -> float:
    """By how much the longest of some short sleeps was too long."""
    longest_s = 0.0
    for _ in range(SLEEPS):
        began_s = clock.monotonic_s()
        threading.Event().wait(SLEEP_S)
        longest_s = max(longest_s, clock.monotonic_s() - began_s - SLEEP_S)
    return longest_s
