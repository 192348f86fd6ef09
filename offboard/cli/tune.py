"""`offboard tune`: parameters that fly better, judged on flights that they were not tuned on."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from offboard.cli.campaign import resumable
from offboard.cli.shared import Workers, check_new, option, out, say, write_new
from offboard.documents.errors import UserError

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
    the result. It is written only if it is better with 95 % confidence. The flights are in a
    folder beside it: the same command goes on. The shipped tuning shows all keys of the file.
    """
    check_new(profile, "--out")
    with out.status("planning"):
        from offboard.campaign.document import Promises
        from offboard.campaign.progress import Counter
        from offboard.campaign.results import Results, code_hash
        from offboard.campaign.run import Runner
        from offboard.campaign.tune import Tuning, read_tune
        from offboard.campaign.tune import profile as text_of
        from offboard.campaign.workers import local_workers

        tuning = Tuning(*read_tune(file))
        results = Results(profile.with_suffix(".tune"), code_hash())
    counter = Counter(out, tuning.flights)
    with (
        resumable(),
        Runner(results, Promises(), partial(local_workers, workers), counter) as runner,
    ):
        tuned = tuning.run(
            runner.fly,
            lambda number, cost: say(f"{number} of {tuning.file.trials} trials, best {cost:.4g}"),
        )
    for key, value in tuned.values:
        say(f"  {key}: {value:g}")
    say(f"validation: {tuned.verdict}")
    if not tuned.verdict.better:
        raise UserError("not better with 95 % confidence: nothing is written", 1)
    write_new(profile, text_of(tuning.file, tuned))
    say(f"written: {profile}")
