"""The options of the `simulator` command, and the signals that stop it."""

from __future__ import annotations

import os
import signal
from dataclasses import dataclass
from pathlib import Path

COMPANION_PORT = 14540
NO_LINK = "none"


@dataclass(frozen=True, slots=True)
class Options:
    """The options of one run; `numbers` are the numbers of its instances, from `--instance` on."""

    connect: str | None
    gcs: str
    firmware: str
    speed: float
    lockstep: bool
    seed: int
    scenario: str | None
    vehicle: str | None
    parameters: tuple[str, ...]  # NAME=VALUE
    duration_s: float
    numbers: range
    signing_key: Path | None
    log: Path | None


class Stop:
    """Whether SIGTERM or SIGINT was received. Until `running` is set, they end the process."""

    def __init__(self) -> None:
        self.running = False
        self._noted = False
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, self._note)

    def _note(self, number: int, frame: object) -> None:
        self._noted = True
        if not self.running:
            os._exit(0)  # nothing was flown or recorded yet

    def __call__(self) -> bool:
        return self._noted
