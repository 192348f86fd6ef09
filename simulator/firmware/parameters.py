"""Parameters, and what the core needs them for.

Their values are `simulator.autopilot.parameters`'.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Role = str | float | tuple[str, float]
"""What fills a role: a parameter, a constant, or a parameter and the factor to SI."""


@dataclass(frozen=True, slots=True)
class ParameterSpec:
    """One parameter. Any value is taken by the wire; the vehicle obeys [minimum, maximum]."""

    name: str
    kind: Literal["int8", "int16", "int32", "real32"]
    default: float
    minimum: float
    maximum: float
    meaning: str
