"""All checks by name: the built-in ones, and those of installed packages.

A package adds a check with an entry point in the group `pso_offboard.checks`: its name is that of
the check, its object a function of an `Observation` that returns findings. See the README.
"""

from __future__ import annotations

import inspect
from collections.abc import Iterable, Sequence
from importlib.metadata import EntryPoint, entry_points

from offboard.doctor import flight_checks, link_checks, vehicle_checks
from offboard.doctor.findings import Check, Finding, Run
from offboard.doctor.observation import Observation
from offboard.documents.errors import UserError, shown

GROUP = "pso_offboard.checks"


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
        flight_checks.configuration,
        flight_checks.disk,
        flight_checks.compiled,
        flight_checks.computer,
    )
)


class CheckError(UserError):
    """A check that does not exist."""


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
