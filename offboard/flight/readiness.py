"""Parameters of the vehicle before the flight: requested, awaited, checked by the dialect.

Sans-I/O: replies and times are arguments, requests are returned. The dialect holds what must be
true of each parameter.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

from offboard.mavlink.dialects.base import Dialect
from offboard.mavlink.outgoing import ParamRead

REPEAT_S = 0.5
REPLY_TIMEOUT_S = 2.0  # for parameters that need not be answered


class Readiness:
    """Progress of reading one vehicle's watched parameters. Times are seconds of any one clock.

    `advice`: also those that are only for advice."""

    def __init__(self, *, advice: bool = False) -> None:
        self._advice = advice
        self._began_s = math.nan
        self._requested_s = -math.inf

    def due(self, dialect: Dialect, known: Mapping[str, float], now_s: float) -> list[ParamRead]:
        """Requests to send now, for every watched parameter without a reply."""
        if math.isnan(self._began_s):
            self._began_s = now_s
        if now_s - self._requested_s < REPEAT_S - 1e-6:
            return []
        self._requested_s = now_s
        return [ParamRead(name) for name in self._names(dialect) if name not in known]

    def complete(self, dialect: Dialect, known: Mapping[str, float], now_s: float) -> bool:
        """Every parameter has a reply; those that need none may also have timed out."""
        if self.unanswered(dialect, known):
            return False
        all_known = all(name in known for name in self._names(dialect))
        return all_known or now_s - self._began_s >= REPLY_TIMEOUT_S

    def _names(self, dialect: Dialect) -> list[str]:
        watched = dialect.watched_parameters
        return [p.name for p in watched if self._advice or not p.advice_only]

    @staticmethod
    def unanswered(dialect: Dialect, known: Mapping[str, float]) -> list[str]:
        """Names of the parameters without reply that this autopilot must not be flown without."""
        watched = dialect.watched_parameters
        return [p.name for p in watched if p.must_answer and p.name not in known]

    @staticmethod
    def problems(dialect: Dialect, known: Mapping[str, float]) -> list[str]:
        """One sentence for each parameter with an invalid value."""
        checked = (p.problem(known[p.name]) for p in dialect.watched_parameters if p.name in known)
        return [problem for problem in checked if problem]
