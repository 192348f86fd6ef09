"""A comparison: controllers with the same references, scenarios and seeds, and their medians.

Its flights are cases of a campaign; each keeps its log. The best are marked. An interrupted
comparison keeps the flights that have ended and names those that are missing.
"""

from __future__ import annotations

import itertools
import json
import math
from collections.abc import Sequence
from contextlib import AbstractContextManager, suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from rich.console import Console

from offboard.campaign.campaign import check_request
from offboard.campaign.cases import Case, expand
from offboard.campaign.code import code_hash
from offboard.campaign.compare_table import numbered_seeds, show
from offboard.campaign.document import CampaignFile
from offboard.campaign.execution import ConnectedVehicle, Flyer
from offboard.campaign.flight import Job
from offboard.campaign.page import COMPARISON, page
from offboard.campaign.progress import Counter
from offboard.campaign.results import Record
from offboard.campaign.statistics import ERROR, Group, digits, groups, marked
from offboard.campaign.table import as_csv as csv_of
from offboard.campaign.table import row_of
from offboard.documents.errors import DocumentError, UserError
from offboard.documents.plain import plain
from offboard.link.log import LogError
from offboard.link.stop import StopRequests

CONNECTED = "connected"  # the scenario of a connected vehicle
WHOLE_RANGE = (0.0, 100.0)
STATISTICS = ("lowest", "median", "highest")


def plan(
    file: CampaignFile,
    directory: Path,
    settings: Sequence[str] = (),
    vehicle: ConnectedVehicle | None = None,
) -> list[Job]:
    """A flight for every combination, each with a directory of its own in `directory`.

    `settings` are `key.path=value` of --set; `vehicle` flies instead of the simulator. Raises
    DocumentError where one cannot be flown, or two would share a directory.
    """
    changes: dict[str, Any] = {"settings": tuple(settings)}
    if vehicle:
        changes["scenario"] = CONNECTED
    first: dict[Path, Case] = {}
    for case in (replace(case, **changes) for case in expand(file)):
        stems = [Path(name).stem for name in _names(case)]
        folder = directory / "-".join((*stems, str(case.seed)))
        other = first.setdefault(folder, case)
        if other is not case:
            raise DocumentError(
                f"{_described(other)} and {_described(case)} would both be recorded in {folder}; "
                "give files different names"
            )
    checked: set[object] = set()
    for folder, case in first.items():
        parts = {(case.controller, case.reference), case.scenario}
        if not parts <= checked:
            check_request(
                vehicle.request(case, folder) if vehicle else case.request(folder, case.scenario)
            )
            checked |= parts
    return [Job(case, file.promises, code_hash(), folder) for folder, case in first.items()]


def compare(
    jobs: Sequence[Job],
    open_flyer: AbstractContextManager[Flyer],
    directory: Path,
    console: Console,
) -> str:
    """Fly the jobs of a plan, print and write the table: compare.csv, .json and .html in
    `directory`.

    Returns a sentence on what failed or is missing, empty if nothing is. Raises LogError, before
    the first flight, where `directory` cannot be written or is not empty.
    """
    _claim(directory)
    ended, stopped = _flown(jobs, open_flyer, console)
    rows = [row_of(job.case, ended[job.case], ()) for job in jobs if job.case in ended]
    flown = marked(groups(rows, ends=WHOLE_RANGE))
    if flown:
        console.print()
        show(console, flown)
    missing = _missing([job.case for job in jobs if job.case not in ended])
    if missing and stopped:
        missing.insert(0, f"{stopped}; nothing more was flown")
    for line in missing:
        console.print(line, style="yellow", markup=False)
    failed = sum(bool(row.failed) for row in rows)
    problems = [f"{failed} of {len(rows)} flights failed; the table says why"] if failed else []
    if missing:
        count = f"{len(jobs) - len(rows)} of {len(jobs)} flights missing"
        problems.append(f"{stopped or 'interrupted'}: {count}")
    unwritten = _write(directory, flown, missing)
    if not unwritten:
        console.print(f"written: {directory / 'compare.html'}", markup=False, soft_wrap=True)
    return "; ".join([*problems, *unwritten])


def _flown(
    jobs: Sequence[Job], open_flyer: AbstractContextManager[Flyer], console: Console
) -> tuple[dict[Case, Record], str]:
    """The flights that have ended; and why the others were not flown, empty if by request."""
    ended: dict[Case, Record] = {}
    stopped = ""
    try:
        with (
            suppress(KeyboardInterrupt),
            StopRequests() as stops,
            Counter(console) as counter,
            open_flyer as flyer,
        ):
            counter.count(0, len(jobs))
            for job, record in flyer.fly(jobs, partial(counter.ending, stops)):
                ended[job.case] = record
                counter.count(len(ended), len(jobs), _line(job, record))
    except UserError as error:
        stopped = str(error)
    return ended, stopped


def _names(case: Case) -> tuple[str, str, str]:
    return case.controller or "", case.reference or "", case.scenario


def _described(case: Case) -> str:
    return "{} on {} in {}".format(*_names(case))


def _line(job: Job, record: Record) -> str:
    error_m = record.figures.get(ERROR, math.nan)
    end = f"{digits(error_m)} m" if record.completed else record.sentence
    return f"{job.kept.name if job.kept else ''}: {end}"


def _claim(directory: Path) -> None:
    try:
        directory.mkdir(parents=True, exist_ok=True)
        if any(directory.iterdir()):
            raise LogError(f"{directory} is not empty; choose another directory with --out")
        (directory / "compare.csv").touch()
    except OSError as error:
        raise LogError(
            f"the comparison cannot be recorded in {directory}: {error.strerror}; "
            "choose a directory that can be written with --out"
        ) from None


def _missing(cases: Sequence[Case]) -> list[str]:
    """A line for each reference and scenario with flights that were not flown."""
    blocks: dict[tuple[str, str], dict[str, list[int]]] = {}
    for case in cases:
        law, reference, scenario = _names(case)
        blocks.setdefault((reference, scenario), {}).setdefault(law, []).append(case.seed)
    return [
        f"not flown: {reference}, {scenario}: "
        + "; ".join(f"{law} {numbered_seeds(seeds)}" for law, seeds in laws.items())
        for (reference, scenario), laws in blocks.items()
    ]


def _write(directory: Path, flown: Sequence[Group], missing: Sequence[str]) -> list[str]:
    """Write the table and the page; a sentence about the first file that cannot be written."""
    documents = {
        "csv": as_csv(flown),
        "json": as_json(flown),
        "html": page(flown, COMPARISON, missing),
    }
    for suffix, text in documents.items():
        path = directory / f"compare.{suffix}"
        try:
            path.write_text(text, encoding="utf-8")
        except OSError as error:
            return [f"{path} cannot be written ({error.strerror})"]
    return []


def as_csv(flown: Sequence[Group]) -> str:
    """The table as CSV, one column for each figure and statistic."""
    entries = plain([_entry(group) for group in flown])
    names = ("controller", "reference", "scenario", "flights", "best")
    table = {name: [entry[name] for entry in entries] for name in names}
    table["failed"] = [group.failed for group in flown]
    table["why"] = ["; ".join(group.reasons) for group in flown]
    for figure, which in itertools.product(COMPARISON.figures, STATISTICS):
        table[f"{figure}_{which}"] = [entry[which][figure] for entry in entries]
    return csv_of(table)


def as_json(flown: Sequence[Group]) -> str:
    """The table as JSON; what no flight gave is null."""
    entries = plain([_entry(group) for group in flown])
    return json.dumps(entries, indent=2, allow_nan=False) + "\n"


def _entry(group: Group) -> dict[str, Any]:
    controller, reference, scenario = _names(group.case)
    spreads = {figure: group.spread(figure) for figure in COMPARISON.figures}
    return {
        "controller": controller,
        "reference": reference,
        "scenario": scenario,
        "flights": group.flights,
        "failures": [
            {"seed": row.case.seed, "sentence": row.failed} for row in group.rows if row.failed
        ],
        **{
            which: {figure: spread[at] for figure, spread in spreads.items()}
            for at, which in enumerate(STATISTICS)
        },
        "best": group.best,
    }
