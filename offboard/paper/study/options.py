"""The options of one run of the study, the names of its tables and figures, and their check."""

from __future__ import annotations

import math
import tempfile
from dataclasses import dataclass
from pathlib import Path

from offboard.documents.errors import UserError
from offboard.paper.law import PaperSettings

# Section of the page -> tables and figures, in reading order
SECTIONS: dict[str, tuple[str, ...]] = {
    "Tables of the paper": ("table 2", "figure gap", "table 3", "table 4"),
    "Figures of the paper": tuple(f"figure {number}" for number in range(4, 18)),
    "Errata, with computed evidence": ("table errata", "table bd"),
    "One step compared with longer horizons": (
        "table horizon", "figure horizon", "figure laws", "table weights",
    ),
    "Extensions that the conclusions propose": (
        "table integral", "figure integral", "table limits", "figure limits",
    ),
}  # fmt: skip
LABELS = tuple(label for labels in SECTIONS.values() for label in labels)
TABLES, FIGURES = (
    tuple(label.split()[1] for label in LABELS if label.startswith(kind))
    for kind in ("table", "figure")
)
SEEDS, QUICK_SEEDS, MOST_SEEDS = 20, 2, 10_000


@dataclass(frozen=True, slots=True)
class PaperOptions:
    """Options of `offboard paper`.

    Args:
        out: output directory; created if absent, else empty.
        quick: fewer seeds.
        seeds: flights per row of a table; None: 20, or 2 if quick.
        initial_q: diag(Q) of the first configuration (Eq. 23, whose values are not printed):
            twelve weights, or one for all; None: the identity.
        figures, tables: names from FIGURES and TABLES; both empty: everything.
        workers: processes; None: one per processor; 1: no other process.
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
    def first_settings(self) -> PaperSettings:
        """The first configuration (section 4.1), at lambda = 1."""
        first = PaperSettings.first_configuration()
        if self.initial_q is None:
            return first
        diagonal = self.initial_q * 12 if len(self.initial_q) == 1 else self.initial_q
        return first.model_copy(update={"fitness": diagonal})

    @property
    def labels(self) -> tuple[str, ...]:
        """The tables and figures to make ("table 2", "figure gap"), tables first."""
        chosen = [f"table {name}" for name in self.tables]
        chosen += [f"figure {name}" for name in self.figures]
        return tuple(dict.fromkeys(chosen)) or tuple(sorted(LABELS, key=_is_figure))


def check(options: PaperOptions) -> None:
    """Create the output directory. Raises UserError for the first option that is not valid."""
    chosen = (("figure", options.figures, FIGURES), ("table", options.tables, TABLES))
    for kind, names, known in chosen:
        for name in names:
            if name not in known:
                raise UserError(f"there is no {kind} {name!r}; known are {', '.join(known)}")
    if not 1 <= options.seed_count <= MOST_SEEDS:
        raise UserError(f"seeds must be 1 .. {MOST_SEEDS}, not {options.seed_count}")
    if options.workers is not None and options.workers < 1:
        raise UserError(f"workers must be 1 or more, not {options.workers}")
    if options.initial_q is not None:
        _check_weights(options.initial_q)
    _check_output(options.out)


def _is_figure(label: str) -> bool:
    return label.startswith("figure")


def _check_weights(diagonal: tuple[float, ...]) -> None:
    if len(diagonal) not in (1, 12):
        raise UserError(f"the initial Q takes 1 or 12 weights, not {len(diagonal)}")
    for weight in diagonal:
        if not (math.isfinite(weight) and weight >= 0):
            raise UserError(f"the weights of the initial Q must be 0 or more, not {weight:g}")


def _check_output(out: Path) -> None:
    try:
        out.mkdir(parents=True, exist_ok=True)
        if any(out.iterdir()):
            raise UserError(f"{out} is not empty; choose another directory with --out")
        with tempfile.TemporaryFile(dir=out):
            pass
    except OSError as error:
        raise UserError(f"{out} cannot be written: {error.strerror or error}") from None
