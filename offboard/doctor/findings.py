"""Findings: what a check says of an observation, and rows of a report. The worst finding wins."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from enum import IntEnum
from functools import partial

from offboard.doctor.bounded import within
from offboard.doctor.observation import Observation
from offboard.link import clock

CHECKS_S, LEAST_S = 1.0, 0.05  # for all checks; for one, when the others have used it up
AUTHOR = "report this to whoever wrote the check"


class Level(IntEnum):
    """From harmless to severe. `WAIT` may clear by itself; `BLOCKS`: `offboard fly` refuses it."""

    OK = 0
    WARN = 1
    WAIT = 2
    BLOCKS = 3


@dataclass(frozen=True, slots=True)
class Finding:
    """`found` is what was observed, `hint` what to do about it: apart, so that a program can use
    either. `about`: a parameter, where it is not only the check."""

    level: Level
    found: str
    hint: str = ""
    about: str = ""


def ok(found: str) -> Finding:
    return Finding(Level.OK, found)


def warn(found: str, hint: str = "", about: str = "") -> Finding:
    return Finding(Level.WARN, found, hint, about)


def wait(found: str, hint: str = "") -> Finding:
    return Finding(Level.WAIT, found, hint)


def blocks(found: str, hint: str = "", about: str = "") -> Finding:
    return Finding(Level.BLOCKS, found, hint, about)


Run = Callable[[Observation], Iterable[Finding]]


@dataclass(frozen=True, slots=True)
class Check:
    """`run` returns no finding where there was nothing to check."""

    name: str
    summary: str
    run: Run


@dataclass(frozen=True, slots=True)
class Row:
    """The findings of one check, the worst first."""

    check: str
    findings: tuple[Finding, ...]

    @property
    def level(self) -> Level:
        return self.findings[0].level


def examine(
    checks: Sequence[Check], observation: Observation, seconds: float = CHECKS_S
) -> list[Row]:
    """One row for each check that found something to say. A check that fails is a row, too, or one
    that has not ended when all of them have taken `seconds`."""
    rows, until_s = [], clock.monotonic_s() + seconds
    for check in checks:
        left_s = max(LEAST_S, until_s - clock.monotonic_s())
        try:
            findings = within(left_s, partial(_findings, check.run, observation))
        except TimeoutError:
            findings = (warn(f"the check did not end in {left_s:.1f} s", AUTHOR),)
        except Exception as error:  # whatever a check of another package raises
            sentence = f"the check itself failed: {type(error).__name__}: {error}"
            findings = (warn(sentence, AUTHOR),)
        if findings:
            rows.append(Row(check.name, findings))
    return rows


def _findings(run: Run, observation: Observation) -> tuple[Finding, ...]:
    """The worst first."""
    return tuple(sorted(run(observation), key=lambda each: -each.level))


def worst(rows: Iterable[Row]) -> Level:
    return max((row.level for row in rows), default=Level.OK)


def verdict(rows: Iterable[Row], *, complete: bool) -> str:
    """One sentence: whether this vehicle can be flown now. `complete`: all checks were made."""
    found = [(each.level, each.about or row.check) for row in rows for each in row.findings]

    def named(level: Level) -> list[str]:
        return list(dict.fromkeys(name for at, name in found if at is level))

    blocking, waiting, warning = map(named, (Level.BLOCKS, Level.WAIT, Level.WARN))
    if blocking:
        return f"{len(blocking)} block{'s' * (len(blocking) == 1)}: {', '.join(blocking)}"
    if waiting:
        return f"not ready yet: {', '.join(waiting)}"
    ready = "ready to fly" if complete else "nothing blocks in these checks"
    return f"{ready}; warnings: {', '.join(warning)}" if warning else ready
