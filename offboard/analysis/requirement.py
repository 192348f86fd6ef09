"""Requirements on a score: 'rmse_position_m<0.05' -> met or not. Pure text and numbers."""

from __future__ import annotations

import math
import operator
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass

_OPERATORS: dict[str, Callable[[float, float], bool]] = {
    "<=": operator.le,
    ">=": operator.ge,
    "==": operator.eq,
    "<": operator.lt,
    ">": operator.gt,
}
_PATTERN = re.compile(r"^\s*(\w+)\s*(<=|>=|==|<|>)\s*(\S+)\s*$")


class RequirementError(Exception):
    """A requirement that cannot be understood: one sentence with what would be right."""


@dataclass(frozen=True, slots=True)
class Requirement:
    """One figure of the score compared with a number."""

    figure: str
    comparison: str
    limit: float

    @classmethod
    def parse(cls, text: str, known: Mapping[str, object]) -> Requirement:
        """Read 'FIGURE<NUMBER'; raises RequirementError that lists the right names."""
        match = _PATTERN.match(text)
        if match is None:
            raise RequirementError(
                f"--require {text!r} is not understood; write FIGURE<NUMBER, "
                "for example 'rmse_position_m<0.05' (also <=, >, >=, ==)"
            )
        figure, comparison, number = match.groups()
        if figure not in known:
            raise RequirementError(
                f"--require: there is no figure {figure!r}; there are {', '.join(known)}"
            )
        try:
            limit = float(number)
        except ValueError:
            limit = math.nan
        if math.isnan(limit):
            raise RequirementError(f"--require {text!r}: {number!r} is not a number")
        return cls(figure, comparison, limit)

    def verdict(self, figures: Mapping[str, float]) -> str | None:
        """None when met, otherwise a sentence. A figure that the log lacks (NaN) is not met."""
        value = figures[self.figure]
        if _OPERATORS[self.comparison](value, self.limit):
            return None
        if math.isnan(value):
            return f"{self.figure} is not in this log (required {self.comparison} {self.limit:g})"
        return f"{self.figure} is {value:.4g} (required {self.comparison} {self.limit:g})"
