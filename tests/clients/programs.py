"""The simulator as a process of its own, and MAVProxy on a pseudo-terminal."""

from __future__ import annotations

import os
import pty
import re
import select
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from processes import free_port
from sim_peer import simulator

LIMIT_S = 160.0
MAVPROXY = Path(sys.executable).with_name("mavproxy.py")


@contextmanager
def vehicle(*options: str) -> Iterator[int]:
    """Run a simulator and yield the port to which it sends; it is killed when the block ends."""
    port = free_port()
    with simulator("--connect", f"udpout:127.0.0.1:{port}", "--gcs", "none", *options) as process:
        assert process.stdout is not None
        ready = process.stdout.readline()
        while ready.startswith("simulator: "):  # the first time it compiles
            ready = process.stdout.readline()
        assert f"127.0.0.1:{port}" in ready, ready
        yield port
        assert process.poll() is None, "the simulator ended by itself"


class Terminal:
    """MAVProxy until the block ends. `shown`: all that it has printed."""

    def __init__(self, directory: Path, port: int, *options: str) -> None:
        self._master, slave = pty.openpty()
        master = f"--master=udpin:127.0.0.1:{port}"
        self._process = subprocess.Popen(
            (sys.executable, str(MAVPROXY), master, "--no-state", *options),
            stdin=slave,
            stdout=slave,
            stderr=slave,
            cwd=directory,
            env={**os.environ, "HOME": str(directory), "TERM": "dumb", "COLUMNS": "200"},
            start_new_session=True,
        )
        os.close(slave)
        self.shown = ""
        self._seen = 0

    def __enter__(self) -> Terminal:
        return self

    def __exit__(self, *_: object) -> None:
        self._process.kill()
        self._process.wait()
        os.close(self._master)

    def type(self, line: str) -> None:
        os.write(self._master, line.encode() + b"\n")

    def expect(self, pattern: str, timeout_s: float = 15.0) -> re.Match[str]:
        """Wait for the first match in what it prints after the previous match, and return it."""
        deadline_s = time.monotonic() + timeout_s
        while (found := re.compile(pattern).search(self.shown, self._seen)) is None:
            remaining_s = deadline_s - time.monotonic()
            if remaining_s <= 0 or not self.read(remaining_s):
                raise AssertionError(f"no {pattern!r} in:\n{self.shown[self._seen :]}")
        self._seen = found.end()
        return found

    def talk(self, *lines: tuple[str, str]) -> None:
        """Type each line, unless it is empty, and wait for what MAVProxy must print."""
        for typed, shown in lines:
            if typed:
                self.type(typed)
            self.expect(shown, 20.0)

    def read(self, timeout_s: float) -> bool:
        """Read what is printed within `timeout_s`; return whether MAVProxy still runs."""
        if select.select([self._master], [], [], timeout_s)[0]:
            try:
                self.shown += os.read(self._master, 65536).decode("utf-8", "replace")
            except OSError:
                return False
        return True
