"""Which other processes have a port or a serial device, and where this one runs. Reads /proc.

Without /proc (macOS) nothing is known, and nothing is said.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

PROC = Path("/proc")
TABLES = {"udpin": ("udp", "udp6"), "tcpin": ("tcp", "tcp6")}
# States of a socket that has a port: UDP bound or connected, TCP listening
STATES = {"udp": ("07", "01"), "tcp": ("0A",)}
CONTAINER_MARKS = ("/.dockerenv", "/run/.containerenv")


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


def _names(pids: Iterator[int]) -> Iterator[str]:
    for pid in dict.fromkeys(pids):
        name = "a program"
        with suppress(OSError):
            name = (PROC / str(pid) / "comm").read_text().strip()
        yield f"{name} (pid {pid})"
