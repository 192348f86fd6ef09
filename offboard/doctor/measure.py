"""One look at this computer: disk, compiled functions, time of a decision, late waking up."""

from __future__ import annotations

import shutil
import threading
from contextlib import suppress
from pathlib import Path

from offboard import compiled
from offboard.doctor.observation import Computer
from offboard.documents.errors import DocumentError
from offboard.link import clock
from offboard.run.configuration import FlightConfig
from offboard.run.one_flight import rehearse
from offboard.run.request import build_parts

SLEEPS, SLEEP_S = 40, 0.01


def measure(config: FlightConfig, directory: Path, *, clock_step_s: float) -> Computer:
    """Measure this computer for a flight of `config` that is recorded in `directory`."""
    decision_s, rehearsal = None, ""
    parts = None
    with suppress(DocumentError):  # a reference that cannot be flown is another check
        parts = build_parts(config)
    missing = sum(not each.is_compiled for each in compiled.defined)
    if parts and not missing:  # compiling takes longer than the whole check
        try:
            decision_s = rehearse(parts, keeps_deadline=True)
        except DocumentError as error:
            rehearsal = str(error)
    return Computer(
        directory=str(directory),
        free_bytes=_free_bytes(directory),
        overshoot_s=overshoot_s(),
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


def overshoot_s() -> float:
    """By how much the longest of some short sleeps was too long."""
    longest_s = 0.0
    for _ in range(SLEEPS):
        began_s = clock.monotonic_s()
        threading.Event().wait(SLEEP_S)
        longest_s = max(longest_s, clock.monotonic_s() - began_s - SLEEP_S)
    return longest_s
