"""`offboard tune`: parameters that fly better, judged on flights that they were not tuned on."""

from __future__ import annotations

from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from offboard.cli.campaign import ENDED, resumable
from offboard.cli.shared import CommandError, Workers, check_new, option, out, say, write_new

EXIT_CODES = (
    "Exit codes: 0 a better configuration is written; 1 none is better; 2 usage or configuration "
    "error; 4 interrupted: the same command goes on."
)
NAME = typer.Argument(metavar="NAME|FILE", help="Tuning: a shipped name or a file.")


def tune(
    file: Annotated[str, NAME],
    profile: Annotated[
        Path, option("FILE", "Flight configuration to write; a new file.", "-o", "--out")
    ] = Path("profile.yaml"),
    workers: Workers = None,
) -> None:
    """Tune parameters, and write a configuration that flies better.

    Minimises a figure over training flights, then flies the validation flights with and without
    the result. It is written only if it is better with 95 % confidence. Study and results are in a
    folder beside it: the same command goes on. The shipped tuning shows all keys of the file.
    """
    check_new(profile, "--out")
    with out.status("planning"):
        from offboard.campaign.code import code_hash
        from offboard.campaign.evaluate import Evaluator, Interrupted
        from offboard.campaign.execution import local_workers
        from offboard.campaign.margin import Promises
        from offboard.campaign.progress import Counter
        from offboard.campaign.results import Results
        from offboard.campaign.tune import Tuning, read_tune
        from offboard.campaign.tune import profile as text_of
        from offboard.link.stop import StopRequests

        tuning = Tuning(*read_tune(file))
        results = Results(profile.with_suffix(".tune"), code_hash())
    tuned = None
    with (
        suppress(KeyboardInterrupt, Interrupted),
        StopRequests() as stops,
        local_workers(workers) as flyers,
        resumable(),
    ):
        evaluator = Evaluator(results, Promises(), flyers, partial(Counter(out).ending, stops))
        tuned = tuning.run(
            results.directory,
            evaluator,
            lambda number, cost: say(f"{number} of {tuning.file.trials} trials, best {cost:.4g}"),
        )
    if tuned is None:
        raise CommandError(ENDED, 4)
    for key, value in tuned.values:
        say(f"  {key}: {value:g}")
    say(f"validation: {tuned.verdict}")
    if not tuned.verdict.better:
        raise CommandError("not better with 95 % confidence: nothing is written", 1)
    write_new(profile, text_of(tuning.file, tuned))
    say(f"written: {profile}")
