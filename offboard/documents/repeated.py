"""Sentences on what happens again and again: each at most once a second, summed up."""

from __future__ import annotations

import math

EVERY_S = 1.0


class Repeated:
    """One sentence for the user. `add` what happened, with a figure, and ask `news` for it.

    `text` is a format of `most` (the greatest figure since the last sentence), `total` (their sum)
    and `times` (" (the longest of 4)", empty for a single one). Times are seconds of any clock.
    """

    def __init__(self, text: str) -> None:
        self._text = text
        self._said_s = -math.inf
        self._figures: list[float] = []

    def add(self, figure: float) -> None:
        self._figures.append(figure)

    def news(self, now_s: float) -> str:
        """What to say now; empty if nothing happened, or within a second of the last time."""
        figures = self._figures
        if not figures or now_s - self._said_s < EVERY_S:
            return ""
        self._said_s, self._figures = now_s, []
        times = f" (the longest of {len(figures)})" if len(figures) > 1 else ""
        return self._text.format(most=max(figures), total=sum(figures), times=times)
