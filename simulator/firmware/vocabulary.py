"""What everything about a firmware is said in: vectors, parameters, results and texts.

Knows no firmware and no message.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum

Triple = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]  # w, x, y, z; FRD -> NED
ReadParameter = Callable[[str], float]
NAN3: Triple = (math.nan, math.nan, math.nan)


class Result(IntEnum):
    """MAV_RESULT."""

    ACCEPTED = 0
    TEMPORARILY_REJECTED = 1
    DENIED = 2
    UNSUPPORTED = 3
    FAILED = 4
    CANCELLED = 6


class Severity(IntEnum):
    """MAV_SEVERITY, those in use."""

    EMERGENCY = 0
    CRITICAL = 2
    WARNING = 4
    INFO = 6
    DEBUG = 7


@dataclass(frozen=True, slots=True)
class Say:
    """A STATUSTEXT."""

    severity: Severity
    text: str
