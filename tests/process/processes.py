"""Ports, options, processes, a full disk and signing, for tests of our commands."""

from __future__ import annotations

import itertools
import os
import resource
import socket
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

SHORT = ("--reference", "hover", "--set", "reference.duration_s=1", "--set", "reference.height_m=1",
         "--set", "identify.excite=false")  # fmt: skip
RECORDING = Path(__file__).parents[1] / "wire" / "recordings" / "px4-1.16.1-offboard.tlog"
CONFIG = Path(__file__).parents[2] / "config"
SIGNING_EPOCH_S = 1_420_070_400  # 2015-01-01
NO_VEHICLE = "offboard fly --connect udpin:127.0.0.1:PORT --set limits.connect_s=0.3 --out x"
TIMEOUT_S = 60.0  # timeout of what takes a moment on an idle machine
HOVERS = """name: hovers
description: A vehicle that hovers when its links open, and is healthy a second later.
conditions: {boot_scale: 0.1}
start: {height_m: %g}
"""
Spawn = Callable[..., subprocess.Popen[str]]
Called = Callable[..., tuple[int, str, str]]


_PORTS = itertools.count(20_000 + 200 * int(os.environ.get("PYTEST_XDIST_WORKER", "gw0")[2:]))


def free_port() -> int:
    """A free UDP and TCP port, which is returned only once. Each pytest worker has its own range,
    below the ports that the system assigns."""
    for port in _PORTS:
        with (
            socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as datagrams,
            socket.socket(socket.AF_INET, socket.SOCK_STREAM) as stream,
            suppress(OSError),
        ):
            datagrams.bind(("127.0.0.1", port))
            stream.bind(("127.0.0.1", port))
            return port
    raise AssertionError("unreachable")


def register(site: Path, package: str, group: str, **points: str) -> None:
    """Write the metadata of an installed package with these entry points."""
    metadata = site / f"{package}-1.0.dist-info"
    metadata.mkdir()
    (metadata / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {package}\nVersion: 1.0\n")
    lines = "".join(f"{name} = {where}\n" for name, where in points.items())
    (metadata / "entry_points.txt").write_text(f"[{group}]\n{lines}")


def hovering(directory: Path, height_m: float) -> tuple[str, ...]:
    """Return options of a simulator whose vehicle hovers at `height_m` when its links open."""
    path = directory / "hovers.yaml"
    path.write_text(HOVERS % height_m)
    return ("--scenario", str(path))


def children(pid: int) -> list[int]:
    """Return the process ids of the children of `pid`."""
    try:
        listing = Path(f"/proc/{pid}/task/{pid}/children").read_text()
    except OSError:
        return []
    return [int(child) for child in listing.split()]


def ended(pid: int) -> bool:
    """Whether a process has ended; a zombie counts as ended."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] == "Z"
    except OSError:
        return True


def eventually(holds: Callable[[], object]) -> None:
    deadline_s = time.monotonic() + TIMEOUT_S
    while not holds():
        assert time.monotonic() < deadline_s
        time.sleep(0.02)


@contextmanager
def full_disk(holds_bytes: int) -> Iterator[None]:
    """Simulate a full disk by RLIMIT_FSIZE: no file can be longer than `holds_bytes`."""
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (holds_bytes, limits[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)


def signing(system: int, component: int, key: bytes) -> Any:
    """Return a codec that signs with time stamps from this computer's clock."""
    codec = mavlink.MAVLink(None, srcSystem=system, srcComponent=component)
    codec.signing.secret_key, codec.signing.sign_outgoing = key, True
    codec.signing.timestamp = int((time.time() - SIGNING_EPOCH_S) * 1e5)
    return codec
