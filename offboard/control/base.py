"""The contract between a flight and its controller: `Situation` in, `Decision` out.

Frames and units throughout: NED (north, east, down), metres, seconds, radians; the body is FRD
(forward, right, down). `offboard.control` shows how to write a controller.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import astuple, dataclass, field
from typing import NamedTuple, Protocol, runtime_checkable

from offboard.documents.errors import shown, wrong_result
from offboard.documents.parameters import Parameters
from offboard.model.command import Command, PositionCommand, PredictedState
from offboard.model.vehicle import DelayUncertainty, Vehicle
from offboard.reference.base import Reference


@dataclass(frozen=True, slots=True)
class Situation:
    """Everything a controller knows at one control tick.

    Attributes:
        time_s: Vehicle time of the tick (`time_boot_ms` of the newest telemetry) plus the increase
            of the link delay since takeoff, s.
        state: The state predicted for the time at which a command sent now takes effect,
            `state.time_s`. Its arrays cannot be changed.
        reference: The trajectory to follow. Its time axis is vehicle time, its positions are in
            the same local NED frame as `state`.
        previous: The last attitude command sent, which is still in force.
        remaining_s: Returns how many seconds of the time budget of this decision are left,
            negative once it is exceeded. None in lockstep, where the vehicle waits.
        origin_ned_m: The point to which configured references and keep-out volumes are relative:
            the takeoff point, unless a service placed the reference where the vehicle stopped.
        track_time_s: Time since the start of the configured reference, s; NaN during the climb.
    """

    time_s: float
    state: PredictedState
    reference: Reference
    previous: Command
    remaining_s: Callable[[], float] | None = None
    origin_ned_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    track_time_s: float = math.nan


@dataclass(frozen=True, slots=True)
class Certificate:
    """Quality of a decision, logged with it; NaN for a value that the controller does not have.

    Attributes:
        cost: Cost J of the chosen input or plan.
        optimal_cost: Cost J* of the exact minimiser within the same bounds (by daqp).
        gap: Relative difference (J - J*) / max(|J*|, floor); see `swarm.certify`.
        spread: Mean distance of the particles from the best one, epsilon of Eq. 29.
        iterations: Iterations of the search.
        cut_short: Whether the search stopped because no time was left.
        at_bound: Whether any input is at one of its bounds.
        seed_cost: Cost J of the best plan that the search started from.
    """

    cost: float = math.nan
    optimal_cost: float = math.nan
    gap: float = math.nan
    spread: float = math.nan
    iterations: int = 0
    cut_short: bool = False
    at_bound: bool = False
    seed_cost: float = math.nan


@dataclass(frozen=True, slots=True)
class Decision:
    """The result of `Controller.decide`: the command, and optionally its certificate.

    A `Command` is sent as SET_ATTITUDE_TARGET, after its thrust and tilt are limited to those of
    the vehicle; a `PositionCommand` as SET_POSITION_TARGET_LOCAL_NED.
    """

    command: Command | PositionCommand
    certificate: Certificate = field(default_factory=Certificate)

    def __post_init__(self) -> None:
        """Raise the error of a wrong type here, where the law makes its decision."""
        if not isinstance(self.command, Command | PositionCommand):
            raise TypeError(f"{shown(self.command)} is no Command and no PositionCommand")
        [float(figure) for figure in astuple(self.certificate)]  # the log needs numbers


class DecisionError(ArithmeticError):
    """`Controller.decide` found no command, for example because the state is not finite.

    The flight sends a level attitude instead, and lands after `limits.missed_decisions` in a row.
    """


@runtime_checkable
class Controller(Protocol):
    """A control law. The flight calls these two methods, and those of `Adaptive` if it has them.

    Before takeoff `decide` is called a few times for a vehicle at rest, so that everything is
    compiled and loaded, and `reset` once after that; an exception in one of these calls ends the
    program before anything is sent. In flight `decide` is called at every control tick from the
    climb to the landing.
    """

    def decide(self, situation: Situation) -> Decision:
        """Return the command for this tick.

        Raises DecisionError if there is none. Any other exception, and a command that is not finite
        or whose thrust direction is not a unit vector, counts as a missing decision too.
        """
        ...

    def reset(self) -> None:
        """Return to the state after construction: no memory, and the random stream at its seed."""
        ...


def decision_of(controller: Controller, situation: Situation) -> Decision:
    """Let the controller decide. Raises DocumentError if it returns no Decision."""
    decision: object = controller.decide(situation)
    if not isinstance(decision, Decision):
        raise wrong_result(controller.decide, decision, "a Decision")
    return decision


class ControllerSettings(Parameters, ABC):
    """Base class of a controller's settings: the keys that a file in `config/controllers` or
    `--set controller.KEY=VALUE` may set, and `build`, which makes the controller from them.

    A subclass declares `law: Literal["name"] = "name"` and its fields with defaults and ranges.
    Unknown keys and values out of range are refused with a sentence that names them.
    """

    law: str

    @abstractmethod
    def build(self, vehicle: Vehicle, *, period_s: float, seed: int) -> Controller:
        """Make the controller.

        Args:
            vehicle: The constants of the vehicle that are known before the flight.
            period_s: Time between two decisions, s of vehicle time.
            seed: Seed of the controller's random numbers; the same seed must give the same
                decisions.
        """

    def refusal(self, reference: Reference) -> str | None:
        """Return why these settings cannot fly `reference`, or None if they can. `reference` is
        relative to the takeoff point. Called before anything is sent."""
        return None


class Bandwidth(NamedTuple):
    """Bandwidth of the lateral axes, limited by the delay of the tilt, and bandwidth of the
    height, limited by the delay of the thrust."""

    lateral_radps: float
    vertical_radps: float

    def __str__(self) -> str:
        lateral, vertical = (f"{each:.1f} rad/s" for each in self)
        return lateral if lateral == vertical else f"{lateral} laterally, {vertical} in height"


@runtime_checkable
class Adaptive(Protocol):
    """Optional methods of a controller that can use the constants identified in flight."""

    @property
    def configured_radps(self) -> float:
        """The configured bandwidth, rad/s."""
        ...

    @property
    def bandwidth(self) -> Bandwidth:
        """The bandwidth in use: at most the configured one."""
        ...

    def set_vehicle(self, vehicle: Vehicle, uncertainty: DelayUncertainty) -> None:
        """Use `vehicle` from the next decision on, at no more than the bandwidth that its delays
        and their `uncertainty` support (`control.bandwidth`). Called before the first decision,
        and in flight after a setpoint was sent."""
        ...
