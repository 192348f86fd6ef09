"""All checks by name: what the preflight list and the checks of this package say of an observation,
and the checks of installed packages. The worst finding wins.

A package adds a check with an entry point in the group `pso_offboard.checks`: its name is that of
the check, its object a function of an `Observation` that returns findings. See the README.
"""

from __future__ import annotations

import inspect
import json
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from importlib.metadata import EntryPoint, entry_points

from offboard.doctor import link_checks, vehicle_checks
from offboard.doctor.observation import Observation
from offboard.documents.errors import UserError, shown
from offboard.flight import preflight
from offboard.flight.preflight import Finding, Level

GROUP = "pso_offboard.checks"
AUTHOR = "report this to whoever wrote the check"
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


class CheckError(UserError):
    """A check that does not exist."""


def _check(name: str, run: Run) -> Check:
    text = (inspect.getdoc(run) or "").partition("\n\n")[0]
    return Check(name, " ".join(text.split()), run)


# In the order of a signal: link, vehicle, flight, computer
BUILT_IN = tuple(
    _check(run.__name__, run)
    for run in (
        link_checks.port,
        link_checks.vehicle,
        link_checks.senders,
        link_checks.uplink,
        link_checks.delay,
        link_checks.loss,
        link_checks.bandwidth,
        link_checks.rates,
        link_checks.clock,
        vehicle_checks.firmware,
        vehicle_checks.state,
        vehicle_checks.estimator,
        vehicle_checks.gps,
        vehicle_checks.prearm,
        vehicle_checks.battery,
        vehicle_checks.parameters,
        vehicle_checks.configuration,
        vehicle_checks.disk,
        vehicle_checks.compiled,
        vehicle_checks.computer,
    )
)


def checks(names: Sequence[str] = ()) -> list[Check]:
    """The checks with these names, in the order of the table; all without names. A built-in check
    cannot be replaced. Raises CheckError."""
    built_in = {check.name: check for check in BUILT_IN}
    others = sorted(entry_points(group=GROUP), key=lambda point: point.name)
    known = built_in | {p.name: _installed(p) for p in others if p.name not in built_in}
    unknown = [name for name in names if name not in known]
    if unknown:
        listed = ", ".join(known)
        raise CheckError(f"there is no check named {shown(unknown[0])}; known are {listed}")
    return [check for name, check in known.items() if not names or name in names]


def _installed(point: EntryPoint) -> Check:
    """A check of another package; one that cannot be imported fails when it is run."""
    try:
        loaded = point.load()
    except Exception as error:  # whatever another package raises while it is imported
        failed = error

        def run(seen: Observation) -> Iterable[Finding]:
            raise failed

        return Check(point.name, f"cannot be imported from {point.value}", run)
    return _check(point.name, loaded)


def examine(chosen: Sequence[Check], seen: Observation) -> list[Row]:
    """One row for each check that found something to say. A check that fails is a row, too."""
    judged: dict[str, list[Finding]] = {}
    if seen.dialect is not None:
        for name, _, finding in preflight.findings(seen.ground):
            judged.setdefault(name, []).append(finding)
    rows = []
    for check in chosen:
        found = judged.get(check.name, [])
        try:
            found = [*found, *check.run(seen)]
        except Exception as error:  # whatever a check of another package raises
            sentence = f"the check itself failed: {type(error).__name__}: {error}"
            found = [*found, Finding(Level.WARN, sentence, AUTHOR)]
        if found:
            rows.append(Row(check.name, tuple(sorted(found, key=lambda each: -each.level))))
    return rows


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


def as_json(rows: Sequence[Row], seen: Observation, sentence: str) -> str:
    """One object with the worst level, the verdict, what was observed where, and a list of rows."""
    found, version = seen.vehicle.found, seen.vehicle.version
    document = {
        "level": worst(rows).name.lower(),
        "verdict": sentence,
        "connection": seen.connection,
        "listened_s": round(seen.listened_s, 2),
        "vehicle": found and {"autopilot": found.autopilot, "system_id": found.system_id},
        "version": version and [version.major, version.minor, version.patch],
        "rows": [
            {
                "check": row.check,
                "level": row.level.name.lower(),
                "findings": [
                    {"level": each.level.name.lower(), "found": each.found, "hint": each.hint}
                    for each in row.findings
                ],
            }
            for row in rows
        ],
    }
    return json.dumps(document, indent=2, ensure_ascii=False) + "\n"
