"""The requests to stop that a process receives: SIGTERM and SIGINT."""

from __future__ import annotations

import os
import signal


class Stop:
    """Whether SIGTERM or SIGINT was received. While the simulator starts, they end the process."""

    def __init__(self) -> None:
        self.running = False
        self._noted = False
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, self._note)

    def _note(self, number: int, frame: object) -> None:
        self._noted = True
        if not self.running:
            os._exit(0)  # no file or flight has begun

    def __call__(self) -> bool:
        return self._noted
