"""Requirements on a score, such as 'rmse_position_m<0.05'."""

from __future__ import annotations

import math
import operator
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from offboard.analysis.score import FIGURES
from offboard.documents.errors import UserError

_OPERATORS: dict[str, Callable[[float, float], bool]] = {
    "<=": operator.le,
    ">=": operator.ge,
    "==": operator.eq,
    "<": operator.lt,
    ">": operator.gt,
}
_NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
_PATTERN = re.compile(rf"\s*(\w+)\s*(<=|>=|==|<|>)\s*({_NUMBER})\s*")


@dataclass(frozen=True, slots=True)
class Requirement:
    """One figure of the score compared with a number.

    Example: `Requirement.parse("rmse_position_m<0.05").met(score.figures())`.
    """

    figure: str
    comparison: str
    limit: float

    @classmethod
    def parse(cls, text: str) -> Requirement:
        """Read 'FIGURE<NUMBER'. Raises UserError."""
        match = _PATTERN.fullmatch(text)
        if match is None:
            raise UserError(
                f"{text!r} is not understood; write FIGURE<NUMBER, "
                "for example 'rmse_position_m<0.05' (also <=, >, >=, ==)"
            )
        figure, comparison, number = match.groups()
        if figure not in FIGURES:
            raise UserError(f"there is no figure {figure!r}; there are {', '.join(FIGURES)}")
        return cls(figure, comparison, float(number))

    def met(self, figures: Mapping[str, float]) -> bool:
        """Whether the figure is as required. One that the log does not hold (NaN) is not."""
        return _OPERATORS[self.comparison](figures[self.figure], self.limit)

    def sentence(self, figures: Mapping[str, float]) -> str:
        """The figure beside what is required: `rmse_position_m is 0.031 (required < 0.05)`."""
        value = figures[self.figure]
        found = "not in this log" if math.isnan(value) else f"{value:.4g}"
        return f"{self.figure} is {found} (required {self.comparison} {self.limit:g})"
