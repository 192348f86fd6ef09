"""Findings: what a check says of an observation, and rows of a report. The worst finding wins."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from enum import IntEnum

from offboard.doctor.observation import Observation


class Level(IntEnum):
    """From harmless to severe. `WAIT` may clear by itself; `BLOCKS`: `offboard fly` refuses it."""

    OK = 0
    WARN = 1
    WAIT = 2
    BLOCKS = 3


@dataclass(frozen=True, slots=True)
class Finding:
    """`found` is what was observed, `hint` what to do about it: apart, so that a program can use
    either."""

    level: Level
    found: str
    hint: str = ""


def ok(found: str) -> Finding:
    return Finding(Level.OK, found)


def warn(found: str, hint: str = "") -> Finding:
    return Finding(Level.WARN, found, hint)


def wait(found: str, hint: str = "") -> Finding:
    return Finding(Level.WAIT, found, hint)


def blocks(found: str, hint: str = "") -> Finding:
    return Finding(Level.BLOCKS, found, hint)


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


def examine(checks: Sequence[Check], observation: Observation) -> list[Row]:
    """One row for each check that found something to say. A check that fails is a row, too."""
    rows = []
    for check in checks:
        try:
            found = tuple(check.run(observation))
            findings = tuple(sorted(found, key=lambda each: -each.level))
        except Exception as error:  # whatever a check of another package raises
            sentence = f"the check itself failed: {type(error).__name__}: {error}"
            findings = (warn(sentence, "report this to whoever wrote the check"),)
        if findings:
            rows.append(Row(check.name, findings))
    return rows


def worst(rows: Iterable[Row]) -> Level:
    return max((row.level for row in rows), default=Level.OK)
