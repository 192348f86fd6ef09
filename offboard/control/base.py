"""The contract of every controller: a situation in, a decision out. Values only, all frozen."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from offboard.model.vehicle import Vehicle
from offboard.reference.base import Reference

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Command:
    """One setpoint. `thrust_mps2` is the collective thrust per unit of mass (0 .. thrust_max);
    `thrust_direction_ned` the commanded third body axis (unit, (0, 0, 1) when level);
    `course_rad` the commanded heading of the nose.

    Thrust is per unit of mass because only its ratio to the hover thrust crosses the wire, and
    the mass of a real vehicle is not observable from telemetry.
    """

    thrust_mps2: float
    thrust_direction_ned: tuple[float, float, float]
    course_rad: float


@dataclass(frozen=True, slots=True)
class PositionCommand:
    """A setpoint for the autopilot's own position loop, NED, SI; `course_rad` of the nose."""

    position_ned_m: tuple[float, float, float]
    velocity_ned_mps: tuple[float, float, float]
    acceleration_ned_mps2: tuple[float, float, float]
    course_rad: float
    course_rate_radps: float


@dataclass(frozen=True, slots=True)
class PredictedHeave:
    """The vertical motion at `time_s`, vehicle time, when the *thrust* of a command sent now takes
    effect: down is positive; `thrust_down_mps2` is T b_z."""

    time_s: float
    position_down_m: float
    velocity_down_mps: float
    thrust_down_mps2: float


@dataclass(frozen=True, slots=True)
class PredictedState:
    """The observer's state at `time_s`, vehicle time, when a command sent now takes effect.

    Shapes (3,), NED, SI. `thrust_direction_ned` is the third body axis b and
    `thrust_direction_rate_ned_ps` its derivative; acceleration = g e3 - T b - c v + d with
    `disturbance_ned_mps2` d and `thrust_mps2` T (after the thrust's lag).

    Thrust acts sooner than tilt. A vertical loop closed on `time_s` would wait for the tilt and,
    from a difference of about 0.1 s on, cycle; `heave` is the vertical motion at its own time.
    """

    time_s: float
    position_ned_m: Array
    velocity_ned_mps: Array
    thrust_direction_ned: Array
    thrust_direction_rate_ned_ps: Array
    course_rad: float
    course_rate_radps: float
    thrust_mps2: float
    disturbance_ned_mps2: Array
    rates_frd_radps: Array
    heave: PredictedHeave | None = None


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
