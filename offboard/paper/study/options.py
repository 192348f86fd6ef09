"""What one run of the paper is asked for, checked before anything is computed."""

from __future__ import annotations

import math
import tempfile
from dataclasses import dataclass
from pathlib import Path

from offboard.documents.errors import UserError
from offboard.paper.law import PaperSettings

PAPER_FIGURES = tuple(str(number) for number in range(4, 18))
FIGURES = (*PAPER_FIGURES, "gap", "horizon", "laws", "integral", "limits", "peers")
TABLES = (
    "2", "3", "4", "bd", "errata", "horizon", "weights", "integral", "limits", "peers",
)  # fmt: skip
SEEDS, QUICK_SEEDS = 20, 2
MOST_SEEDS = 10_000


class PaperError(UserError):
    """A run that cannot be: one sentence for a human."""


@dataclass(frozen=True, slots=True)
class PaperOptions:
    """`figures` and `tables` pick by name from FIGURES and TABLES; both empty is everything.

    `initial_q` is diag(Q) of the first configuration (Eq. 23, which is lost): twelve numbers, or
    one for all; None is the identity. `seeds` flights per row (None: 20, quick: 2). `workers`
    processes (None: one per processor; 1: in this process).
    """

    out: Path
    quick: bool = False
    seeds: int | None = None
    initial_q: tuple[float, ...] | None = None
    figures: tuple[str, ...] = ()
    tables: tuple[str, ...] = ()
    workers: int | None = None

    @property
    def seed_count(self) -> int:
        return self.seeds if self.seeds is not None else QUICK_SEEDS if self.quick else SEEDS

    @property
    def peer_problems(self) -> int:
        return 3 if self.quick else 30

    @property
    def first_settings(self) -> PaperSettings:
        """The first configuration (section 4.1), at lambda = 1."""
        first = PaperSettings.first_configuration()
        if self.initial_q is None:
            return first
        diagonal = self.initial_q * 12 if len(self.initial_q) == 1 else self.initial_q
        return first.model_copy(update={"fitness": diagonal})

    @property
    def wanted_figures(self) -> tuple[str, ...]:
        return self.figures if self.figures or self.tables else FIGURES

    @property
    def wanted_tables(self) -> tuple[str, ...]:
        return self.tables if self.figures or self.tables else TABLES


def check(options: PaperOptions) -> None:
    """Raises PaperError with one sentence on the first thing wrong; makes the output directory."""
    for kind, chosen, known in (
        ("figure", options.figures, FIGURES),
        ("table", options.tables, TABLES),
    ):
        for name in chosen:
            if name not in known:
                raise PaperError(f"there is no {kind} {name!r}; known are {', '.join(known)}")
    if not 1 <= options.seed_count <= MOST_SEEDS:
        raise PaperError(f"seeds must be 1 .. {MOST_SEEDS}, not {options.seed_count}")
    if options.workers is not None and options.workers < 1:
        raise PaperError(f"workers must be 1 or more, not {options.workers}")
    if options.initial_q is not None:
        _check_weights(options.initial_q)
    _check_output(options.out)


def _check_weights(diagonal: tuple[float, ...]) -> None:
    if len(diagonal) not in (1, 12):
        raise PaperError(f"the initial Q takes 1 or 12 weights, not {len(diagonal)}")
    for weight in diagonal:
        if not (math.isfinite(weight) and weight >= 0):
            raise PaperError(f"the weights of the initial Q must be 0 or more, not {weight:g}")


def _check_output(out: Path) -> None:
    try:
        out.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=out):
            pass
    except OSError as error:
        raise PaperError(f"{out} cannot be written: {error.strerror or error}") from None
