"""The contract of every controller: a situation in, a decision out. Values only, all frozen."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from offboard.model.command import Command, PositionCommand
from offboard.model.predicted_state import PredictedState
from offboard.model.vehicle import Vehicle
from offboard.reference.base import Reference

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Situation:
    """All a controller may know. `time_s` is the vehicle time of the tick; the reference's time
    axis is vehicle time too. `previous` is the command in force; `deadline_s` is the time budget
    of this decision in seconds (None: unbounded, as in lockstep). `origin_ned_m` is the take-off
    point, which references and keep-out volumes are given relative to; `track_time_s` the time on
    the reference's own axis, NaN before it is joined."""

    time_s: float
    state: PredictedState
    reference: Reference
    previous: Command
    deadline_s: float | None = None
    origin_ned_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    track_time_s: float = float("nan")


@dataclass(frozen=True, slots=True)
class Certificate:
    """How good a decision is, and what it cost to find.

    `cost` is J of the chosen input, `optimal_cost` J of the exact minimiser in the same box
    (daqp), `gap` their relative difference (J - J*) / max(|J*|, tiny), `spread` epsilon of
    Eq. 29, `seed_cost` J of the best plan that the search started from. NaN where a controller
    has no such figure.
    """

    cost: float = float("nan")
    optimal_cost: float = float("nan")
    gap: float = float("nan")
    spread: float = float("nan")
    iterations: int = 0
    cut_short: bool = False
    solve_time_s: float = float("nan")
    at_bound: bool = False
    seed_cost: float = float("nan")


@dataclass(frozen=True, slots=True)
class Decision:
    """What is commanded, and how good that is."""

    command: Command | PositionCommand
    certificate: Certificate = field(default_factory=Certificate)


class DecisionError(ArithmeticError):
    """There is no decision: the situation, or what follows from it, is not finite. The flight
    bridges it, and lands when it lasts; the command in force again would hide a dead law."""


class Controller(Protocol):
    """`decide` is called once per tick; `warm_up` calls every code path once before engaging."""

    def decide(self, situation: Situation) -> Decision:
        """The command for one tick. Raises DecisionError."""
        ...

    def reset(self) -> None:
        """Forget everything of the previous flight, the random stream included."""
        ...


@runtime_checkable
class Adopting(Protocol):
    """A controller that can go on with constants identified in flight."""

    @property
    def bandwidth_radps(self) -> float:
        """The bandwidth that was asked for."""
        ...

    def adopt(
        self, vehicle: Vehicle, bandwidth_limit_radps: float = ..., *, gains: bool = ...
    ) -> None:
        """Plan with `vehicle` from the next decision on, at no more than this bandwidth. Without
        `gains` only what costs nothing changes: one step of a blend that has not ended."""
        ...
