"""The simulator as a process of its own on a free port, for clients that are processes too."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager

from simulator.link.sockets import free_ports

LIMIT_S = 160.0


@contextmanager
def vehicle(*options: str) -> Iterator[int]:
    """Yield the port that it sends to; the process is gone when the block ends."""
    (port,) = free_ports(1)
    command = (sys.executable, "-m", "simulator", "--connect", f"udpout:127.0.0.1:{port}")
    process = subprocess.Popen(
        (*command, "--gcs", "none", *options),
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    try:
        assert process.stdout is not None
        ready = process.stdout.readline()
        while ready.startswith("simulator: "):  # compiling, the first time
            ready = process.stdout.readline()
        assert f"127.0.0.1:{port}" in ready, ready
        yield port
        assert process.poll() is None, "the simulator ended by itself"
    finally:
        process.terminate()
        try:
            process.communicate(timeout=5.0)
        except subprocess.TimeoutExpired:
            process.kill()
            process.communicate()
