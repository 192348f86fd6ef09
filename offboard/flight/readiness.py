"""The vehicle's own parameters before the flight: asked for, waited for, judged by the dialect.

Sans-I/O: answers and times in, requests out. What must hold of a parameter stands in the dialect.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

from offboard.mavlink.dialects.base import Dialect
from offboard.mavlink.outgoing import ParamRead

ASK_AGAIN_S = 0.5
PATIENCE_S = 2.0  # an autopilot need not answer, unless the dialect insists


class Readiness:
    """What is known of one vehicle's watched parameters. Times are seconds on any one clock."""

    def __init__(self) -> None:
        self._began_s = math.nan
        self._asked_s = -math.inf

    def due(self, dialect: Dialect, known: Mapping[str, float], now_s: float) -> list[ParamRead]:
        """Requests to send now: every watched parameter that has not been answered."""
        if math.isnan(self._began_s):
            self._began_s = now_s
        if now_s - self._asked_s < ASK_AGAIN_S - 1e-6:
            return []
        self._asked_s = now_s
        watched = dialect.watched_parameters
        return [ParamRead(parameter.name) for parameter in watched if parameter.name not in known]

    def settled(self, dialect: Dialect, known: Mapping[str, float], now_s: float) -> bool:
        """Every parameter has answered, or had its time to."""
        if self.unanswered(dialect, known):
            return False
        everything = all(parameter.name in known for parameter in dialect.watched_parameters)
        return everything or now_s - self._began_s >= PATIENCE_S

    @staticmethod
    def unanswered(dialect: Dialect, known: Mapping[str, float]) -> list[str]:
        """Names of the parameters without which this autopilot must not be flown."""
        watched = dialect.watched_parameters
        return [p.name for p in watched if p.must_answer and p.name not in known]

    @staticmethod
    def complaints(dialect: Dialect, known: Mapping[str, float]) -> list[str]:
        """A sentence for each parameter that is wrong, with the line that mends it."""
        judged = (
            parameter.complaint(known[parameter.name])
            for parameter in dialect.watched_parameters
            if parameter.name in known
        )
        return [complaint for complaint in judged if complaint is not None]
