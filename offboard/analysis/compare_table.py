"""The table of a comparison for a terminal: a block per scenario, as wide as the window allows.

Only presentation. Lines, no drawing: nothing is ever cut, and what does not fit goes below.
"""

from __future__ import annotations

import itertools
import math
import textwrap
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import TypeVar

from rich.text import Text

from offboard.analysis.compare import EQUAL_SHARE, Row

T = TypeVar("T", str, int)
GAP = "  "
LEGEND = (
    f"* lowest median error of its block, and its equals: all whose median lies within the "
    f"range of that one's flights, or within {EQUAL_SHARE:.0%} of its median",
    "tilt, rates: motion that the reference does not ask for, RMS; decision: 99th percentile of "
    "the time it takes",
)


@dataclass(frozen=True, slots=True)
class Column:
    """A figure of the score, and what stands above it."""

    figure: str
    title: str
    unit: str


COLUMNS = (
    Column("rmse_position_m", "RMSE", "m"),
    Column("max_position_m", "largest", "m"),
    Column("tilt_agitation_deg", "tilt", "deg"),
    Column("rate_agitation_radps", "rates", "rad/s"),
    Column("solve_time_p99_ms", "decision", "ms"),
)


def lines(rows: Sequence[Row], width: int) -> Iterator[Text]:
    """Title, blocks, legend, and whatever failed; no line but a long name is wider than `width`."""
    constant = [_only(row.reference for row in rows), _only(row.scenario for row in rows)]
    flights = _only(row.flights for row in rows)
    many = "" if flights is None else f" of {flights} flight" + ("s" if flights > 1 else "")
    what = "position error against the vehicle's estimate and what it took, median"
    spread = " [lowest\N{EN DASH}highest]" if flights != 1 else ""
    title = ", ".join([*filter(None, constant), what + spread + many])
    yield from _wrapped(title, width, "bold")
    layout = _fitting(rows, width)
    yield from layout.heads()
    blocks = itertools.groupby(rows, key=lambda row: (row.reference, row.scenario))
    for names, block in blocks:
        varying = [name for name, same in zip(names, constant, strict=True) if same is None]
        if varying:
            yield Text(", ".join(reversed(varying)), "bold")
        for row in block:
            yield from layout.row(row)
    for words in LEGEND:
        yield from _wrapped(words, width, "dim")
    for row in rows:
        yield from _failures(row, width)


@dataclass(frozen=True, slots=True)
class Layout:
    """Where things stand: the widest name, and of each column the median and the range.

    `beside`: a range stands at the right of its median, else on a line below. A width of 0: the
    ranges of that column are not shown.
    """

    name: int
    medians: tuple[int, ...]
    ranges: tuple[int, ...]
    beside: bool

    @property
    def widths(self) -> list[int]:
        pairs = zip(self.medians, self.ranges, strict=True)
        if self.beside:
            return [median + (1 + spread if spread else 0) for median, spread in pairs]
        return [max(pair) for pair in pairs]

    @property
    def total(self) -> int:
        return 2 + self.name + sum(len(GAP) + width for width in self.widths)

    def heads(self) -> Iterator[Text]:
        for texts in ([c.title for c in COLUMNS], [f"[{c.unit}]" for c in COLUMNS]):
            yield Text(self._line("", "", [self._placed(i, t, "") for i, t in enumerate(texts)]))

    def row(self, row: Row) -> Iterator[Text]:
        """One line or two; a name that is too long has a line of its own."""
        mark, style = ("*", "bold") if row.best else ("", "")
        name = _name(row)
        if not row.flown:
            yield Text(f"  {name}", "red")
            return
        if len(name) > self.name:
            yield Text(f"{mark:2}{name}", style)
            mark = name = ""
        spreads = [_range(row, column) if self.ranges[i] else "" for i, column in _numbered()]
        medians = [digits(row.median[column.figure]) for column in COLUMNS]
        beside = spreads if self.beside else [""] * len(COLUMNS)
        cells = [self._placed(i, medians[i], beside[i]) for i, _ in _numbered()]
        yield Text(self._line(mark, name, cells), style)
        if not self.beside and any(spreads):
            below = [self._placed(i, spread, "") for i, spread in enumerate(spreads)]
            yield Text(self._line("", "", below), "dim")

    def _placed(self, index: int, text: str, beside: str) -> str:
        if not self.beside or not self.ranges[index]:
            return f"{text:>{self.widths[index]}}"
        return f"{text:>{self.medians[index]}} {beside:<{self.ranges[index]}}"

    def _line(self, mark: str, name: str, cells: Sequence[str]) -> str:
        return f"{mark:2}{name:<{self.name}}{GAP}{GAP.join(cells)}".rstrip()


def _fitting(rows: Sequence[Row], width: int) -> Layout:
    """The fullest layout that fits: ranges beside, below, below the error only, names apart."""
    names = max((len(_name(row)) for row in rows if row.flown), default=0)
    medians = tuple(
        max([len(c.title), len(c.unit) + 2, *(len(digits(row.median[c.figure])) for row in rows)])
        for c in COLUMNS
    )
    ranges = tuple(max(len(_range(row, c)) for row in rows) for c in COLUMNS)
    error_only = (ranges[0], *(0 for _ in COLUMNS[1:]))
    shortest = min((len(_name(row)) for row in rows if row.flown), default=0)
    layouts = [
        Layout(names, medians, ranges, beside=True),
        Layout(names, medians, ranges, beside=False),
        Layout(names, medians, error_only, beside=False),
        Layout(shortest, medians, error_only, beside=False),
    ]
    return next((layout for layout in layouts if layout.total <= width), layouts[-1])


def _numbered() -> Iterable[tuple[int, Column]]:
    return enumerate(COLUMNS)


def _name(row: Row) -> str:
    part = f" ({row.flown} of {row.flights})" if row.failed else ""
    return row.controller + part


def digits(value: float) -> str:
    """Three significant digits."""
    if not math.isfinite(value):
        return ""
    value = float(f"{value:.3g}")
    size = math.floor(math.log10(abs(value))) if value else 0
    return f"{value:.2e}" if size < -4 else f"{value:.{max(0, 2 - size)}f}"


def _range(row: Row, column: Column) -> str:
    low, high = (digits(ends[column.figure]) for ends in (row.lowest, row.highest))
    return "" if low == high else f"[{low}\N{EN DASH}{high}]"


def _failures(row: Row, width: int) -> Iterator[Text]:
    for sentence in dict.fromkeys(failure.sentence for failure in row.failures):
        seeds = [failure.seed for failure in row.failures if failure.sentence == sentence]
        where = f"{row.controller}, {row.reference}, {row.scenario}, {numbered_seeds(seeds)}"
        yield from _wrapped(f"failed: {where}: {sentence}", width, "red")


def numbered_seeds(seeds: Sequence[int]) -> str:
    """`seed 3`, `seeds 1-3, 5`."""
    runs: list[list[int]] = []
    for seed in sorted(seeds):
        if runs and seed == runs[-1][-1] + 1:
            runs[-1].append(seed)
        else:
            runs.append([seed])
    told = ", ".join(f"{run[0]}-{run[-1]}" if len(run) > 1 else str(run[0]) for run in runs)
    return f"seed{'s' if len(seeds) > 1 else ''} {told}"


def _wrapped(words: str, width: int, style: str) -> Iterator[Text]:
    for line in textwrap.wrap(words, width, subsequent_indent=GAP, break_long_words=False):
        yield Text(line, style)


def _only(values: Iterable[T]) -> T | None:
    different = set(values)
    return different.pop() if len(different) == 1 else None
