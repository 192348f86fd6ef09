"""Runs `offboard doctor`: opens the link, listens, runs the checks, and makes the report.

A finding comes from the preflight list, by which `fly` and `daemon` refuse a flight, or from a
check of this or another package, which reports what else is worth knowing.
"""

from __future__ import annotations

import inspect
import json
import threading
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import Future
from contextlib import ExitStack
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import TypeVar

from offboard.doctor.checks import OF_FLIGHT, OF_LINK, OF_VEHICLE, Check, wait
from offboard.doctor.computer import OF_COMPUTER, holders
from offboard.doctor.listening import LONGEST_S, Observation
from offboard.documents.errors import Unavailable, UserError, located, shown
from offboard.flight import preflight
from offboard.flight.preflight import Finding, Level
from offboard.link import clock
from offboard.link.connection import open_link
from offboard.link.interface import Link
from offboard.mavlink.session import SessionSettings
from offboard.run.configuration import FlightConfig
from offboard.run.flight import Connection

Result = TypeVar("Result")
Rows = dict[str, list[Finding]]  # the findings of each check, the worst first
POLL_S = 0.02
# The command ends within 15 s: a check that takes longer is left out, and its row says so
OPEN_S = 2.0  # to open the link, before listening
LOOK_S = 12.5  # from the beginning of the command to the end of the checks
LEAST_S = 0.1  # each check gets at least this time

CHECKS = {each.__name__: each for each in (*OF_LINK, *OF_VEHICLE, *OF_FLIGHT, *OF_COMPUTER)}

GROUP = "pso_offboard.checks"  # entry points with checks of other packages
AUTHOR = "report this to whoever wrote the check"


def checks() -> dict[str, Check]:
    """All checks by name. Those of other packages are last, and cannot replace one of ours."""
    others = sorted(entry_points(group=GROUP), key=lambda point: point.name)
    return CHECKS | {each.name: _installed(each) for each in others if each.name not in CHECKS}


def _installed(point: EntryPoint) -> Check:
    """Load a check of another package. One that cannot be imported raises when it is called."""

    try:
        loaded: Check = point.load()
    except (Exception, SystemExit) as error:  # the import runs code of the other package
        failure = error

        def loaded(_: Observation) -> Iterable[Finding]:
            raise failure

        loaded.__doc__ = f"cannot be imported from {point.value}"
    return loaded


def chosen(names: Sequence[str] = ()) -> dict[str, Check]:
    """The checks with these names, in the order of the table; without names all checks. Raises
    UserError."""
    known = checks()
    for name in names:
        if name not in known:
            listed = ", ".join(known)
            raise UserError(f"there is no check named {shown(name)}; known are {listed}")
    return {name: check for name, check in known.items() if not names or name in names}


def summary(check: Check) -> str:
    """What a check examines: the first paragraph of its docstring, as one line."""
    text = (inspect.getdoc(check) or "").partition("\n\n")[0]
    return " ".join(text.split())


# --- observing ---


def observe(
    vehicle: Connection,
    config: FlightConfig,
    directory: Path,
    *,
    tell: Callable[[str], None] = lambda sentence: None,
) -> Observation:
    """Observe `vehicle` and the link to it, for a flight of `config` that is recorded in
    `directory`. Changes nothing on the vehicle except telemetry rates (and signing time). `tell` is
    called with sentences about the progress.

    Raises UserError for an address that is not understood or a signing key that cannot be used.
    """
    began_s, others = clock.monotonic_s(), holders(vehicle.address)
    link, settings, error = None, SessionSettings(), ""
    with ExitStack() as stack:
        signing = vehicle.signing(stack)
        try:
            link = _within(OPEN_S, lambda: open_link(vehicle.address))
        except TimeoutError:
            error = f"connection {shown(vehicle.address)} cannot be opened in {OPEN_S:g} s"
        except Unavailable as failure:
            error = str(failure)
        else:
            stack.callback(link.close)
            settings = vehicle.settings(link)
        now_s = clock.monotonic_s()
        seen = Observation(config, vehicle.address, directory, now_s, settings, signing)
        seen.began_s, seen.link_error, seen.holders = began_s, error, others
        if link:
            _listen(seen, link, tell)
    return seen


def _listen(seen: Observation, link: Link, tell: Callable[[str], None]) -> None:
    while not seen.complete(clock.monotonic_s()):
        link.wait(POLL_S)
        for chunk in link.receive():
            seen.take(chunk)
        for frame in seen.due(clock.monotonic_s()):
            link.send(frame, seen.session.peer)
        found = seen.found.autopilot if seen.found else "no vehicle yet"
        tell(f"listening, {seen.listened_s:.0f} s of at most {LONGEST_S:.0f} s: {found}")


def _within(seconds: float, call: Callable[[], Result]) -> Result:
    """Call `call` in a new thread and return or raise what it does. Raises TimeoutError after
    `seconds`; the thread then goes on, but the process does not wait for it when it exits."""
    future: Future[Result] = Future()

    def run() -> None:
        try:
            future.set_result(call())
        except BaseException as error:
            future.set_exception(error)

    threading.Thread(target=run, daemon=True).start()
    return future.result(seconds)


# --- judging ---


def examine(asked: Mapping[str, Check], seen: Observation) -> Rows:
    """Run the checks. Returns a row for each check that has findings, those of the preflight list
    included. Without a vehicle of a fit type those of a vehicle are left out."""
    blocking = list(preflight.findings(seen)) if seen.found else []
    fit = seen.found is not None and not preflight.unfit_type(seen)
    rows: Rows = {}
    for name, check in asked.items():
        findings = [each for about, _, each in blocking if about == name]
        if fit or check not in OF_VEHICLE:
            findings += _judged(check, seen, seen.began_s + LOOK_S - clock.monotonic_s())
        if findings:
            rows[name] = sorted(findings, key=lambda each: -each.level)
    return rows


def _judged(check: Check, seen: Observation, most_s: float) -> list[Finding]:
    try:
        return _within(max(most_s, LEAST_S), lambda: list(check(seen)))
    except TimeoutError:
        hint = "close other programs and check again, or `offboard check` the configuration"
        return [wait("this was not examined in time", hint)]
    except (Exception, SystemExit) as error:  # a check of another package may raise anything
        sentence = f"the check itself failed: {located(error)}"
        return [Finding(Level.WARN, sentence, AUTHOR)]


def worst(rows: Rows) -> Level:
    """The worst level in all rows."""
    return max((found[0].level for found in rows.values()), default=Level.OK)


def verdict(rows: Rows, *, complete: bool) -> str:
    """A sentence that says whether the vehicle can be flown now. `complete`: whether all checks
    were run."""
    found = [(each.level, each.about or name) for name, row in rows.items() for each in row]

    def named(level: Level) -> list[str]:
        return list(dict.fromkeys(name for at, name in found if at is level))

    blocking, waiting, warning = map(named, (Level.BLOCKS, Level.WAIT, Level.WARN))
    if blocking:
        return f"not ready to fly, blocked by: {', '.join(blocking)}"
    if waiting:
        return f"not ready yet: {', '.join(waiting)}"
    ready = "ready to fly" if complete else "nothing blocks in these checks"
    return f"{ready}; warnings: {', '.join(warning)}" if warning else ready


def as_json(rows: Rows, seen: Observation, sentence: str) -> str:
    """The report as a JSON object: worst level, verdict, connection, vehicle and list of rows."""
    found, version = seen.found, seen.vehicle.version
    document = {
        "level": worst(rows).name.lower(),
        "verdict": sentence,
        "connection": seen.connection,
        "listened_s": round(seen.listened_s, 2),
        "vehicle": found and {"autopilot": found.autopilot, "system_id": found.system_id},
        "version": version and [version.major, version.minor, version.patch],
        "rows": [
            {
                "check": name,
                "level": row[0].level.name.lower(),
                "findings": [
                    {"level": each.level.name.lower(), "found": each.found, "hint": each.hint}
                    for each in row
                ],
            }
            for name, row in rows.items()
        ],
    }
    return json.dumps(document, indent=2, ensure_ascii=False) + "\n"
