"""A program on a pseudo-terminal: type a line, wait for what it prints."""

from __future__ import annotations

import os
import pty
import re
import select
import subprocess
import time
from collections.abc import Sequence


class Terminal:
    """One program until the block ends. `shown` is everything it printed."""

    def __init__(self, command: Sequence[str], directory: str) -> None:
        self._master, slave = pty.openpty()
        self._process = subprocess.Popen(
            command,
            stdin=slave,
            stdout=slave,
            stderr=slave,
            cwd=directory,
            env={**os.environ, "HOME": directory, "TERM": "dumb", "COLUMNS": "200"},
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
        """The first match in what it prints behind the last match."""
        deadline_s = time.monotonic() + timeout_s
        while (found := re.compile(pattern).search(self.shown, self._seen)) is None:
            remaining_s = deadline_s - time.monotonic()
            if remaining_s <= 0 or not self._read(remaining_s):
                raise AssertionError(f"no {pattern!r} in:\n{self.shown[self._seen :]}")
        self._seen = found.end()
        return found

    def _read(self, timeout_s: float) -> bool:
        """Whether it is still there."""
        if select.select([self._master], [], [], timeout_s)[0]:
            try:
                self.shown += os.read(self._master, 65536).decode("utf-8", "replace")
            except OSError:
                return False
        return True
