"""The paper's law on any plant of Eq. 14, and as the controller `paper`, with attitude setpoints.

J(u) = e'Qe + u'Ru + (u - u(k-1))'R_du(u - u(k-1)),  e = x_ref(k+1) - A x - B u

is Eq. 21, a quadratic in the inputs u of Eq. 6, [f_t, tau]; the swarm searches its minimum within
the bounds of Eq. 22, one step ahead on the hover model (Eqs. 14, 26). Over MAVLink the attitude
that the model predicts for k+1 is sent instead of the torques; the autopilot's attitude loop
realises it.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from offboard.control.base import ControllerSettings, Decision, DecisionError, Situation
from offboard.control.quadratic import BoxQuadratic, ExactMinimum
from offboard.control.swarm import SwarmResult, SwarmSettings, certify, minimise
from offboard.documents.parameters import Parameters
from offboard.model.command import Command, PredictedState
from offboard.model.frames import (
    quaternion_from_euler,
    thrust_direction_from_quaternion,
    wrap_pi,
)
from offboard.model.rigid_body import PHI, PSI, THETA, THRUST, P, R, U, W, X, Z, sampled_matrices
from offboard.model.vehicle import Vehicle
from offboard.reference.base import FlatSample

Array = NDArray[np.float64]
Weight = Annotated[float, Field(ge=0)]
Four = tuple[float, float, float, float]
FourWeights = tuple[Weight, Weight, Weight, Weight]
TwelveWeights = tuple[
    Weight, Weight, Weight, Weight, Weight, Weight, Weight, Weight, Weight, Weight, Weight, Weight
]

PAPER_STEP_S = 0.1  # with which Eq. 16 is reproduced; the paper prints 0.05
PAPER_MASS_KG = 0.4  # Table 1
PAPER_INERTIA_KGM2 = (0.0196, 0.0196, 0.0264)  # Table 1
PAPER_ARM_M = 0.225  # not in Table 1; Eq. 16 is reproduced only with it


class PaperSettings(Parameters):
    """Weights, bounds and swarm of the paper, by default the final ones (section 4.3).

    States are in the order of Eq. 5, SI (psi in radians). Inputs are those of the paper's vehicle,
    relative to hover. For another vehicle they are scaled so that the same numbers cause the same
    accelerations, and bounds and weights keep their meaning; f_t is limited further where the total
    thrust would be negative or above the vehicle's maximum.
    """

    fitness: TwelveWeights = (1, 1, 25, 1, 1, 1, 20, 20, 5, 20, 20, 5)  # diag Q, Eq. 33
    energy: FourWeights = (0.00057, 0.125, 0.125, 0.5)  # diag R, Eq. 34
    rate: FourWeights = (1, 1, 1, 1)  # diag R_du, Eqs. 25 and 35
    lower: Four = (-4.0, -0.2, -0.2, -0.1)  # N, N, N, N m, Eq. 26
    upper: Four = (3.942, 0.2, 0.2, 0.1)  # Eq. 26
    keep_constant: bool = True  # the constant of J: its rounding makes epsilon of Eq. 29
    swarm: SwarmSettings = SwarmSettings()

    @classmethod
    def first_configuration(cls) -> PaperSettings:
        """Section 4.1: Q = I (Eq. 23 is lost; I gives the paper's magnitudes), R of Eq. 24, no
        damping, and no rebound, which gives the paper's epsilon."""
        return cls(
            fitness=(1,) * 12,
            energy=(0.0057, 1.25, 1.25, 5.0),
            swarm=SwarmSettings(damping=1.0, rebound=0.0),
        )


@dataclass(frozen=True, slots=True)
class Move:
    """The inputs u(k) (4,), the state (12,) they lead to, and how they were found."""

    inputs: Array
    following: Array
    problem: BoxQuadratic
    result: SwarmResult


class PaperLaw:
    """The law on any plant of Eq. 14: dynamics (12, 12), inputs (12, 4), lower and upper (4,).

    Remembers the last input (for R_du) and the random stream; `reset` forgets them. `terminal`
    (12, 12) replaces diag(Q): with the Riccati solution of the same weights the minimum is optimal
    over an infinite horizon.
    """

    def __init__(
        self,
        dynamics: Array,
        inputs: Array,
        settings: PaperSettings,
        lower: Array | None = None,
        upper: Array | None = None,
        terminal: Array | None = None,
        seed: int = 0,
    ) -> None:
        self._settings, self._seed = settings, seed
        self._lower = np.array(settings.lower if lower is None else lower, np.float64)
        self._upper = np.array(settings.upper if upper is None else upper, np.float64)
        weight = np.diag(settings.fitness) if terminal is None else terminal
        self._dynamics, self._inputs, self._weight = dynamics, inputs, weight
        self._rate = np.diag(settings.rate)
        curvature = inputs.T @ weight @ inputs + np.diag(settings.energy) + self._rate
        self._hessian = curvature + curvature.T
        self.reset()

    def reset(self) -> None:
        """Forget the last input, and start the random stream anew."""
        self._previous = np.zeros(len(self._lower))
        self._rng = np.random.default_rng(self._seed)

    def move(
        self,
        state: Array,
        reference_next: Array,
        remaining_s: Callable[[], float] | None = None,
    ) -> Move:
        """u(k) for the state x(k) (12,) towards x_ref(k+1) (12,), Eq. 27; `remaining_s` as in
        `swarm.minimise`."""
        slope = self._slope(state, reference_next)
        problem = BoxQuadratic(self._hessian, *slope, self._lower, self._upper)
        result = minimise(self._settings.swarm, problem, self._rng, remaining_s=remaining_s)
        self._previous = result.best
        following = state @ self._dynamics.T + result.best @ self._inputs.T
        return Move(result.best, following, problem, result)

    def _slope(self, state: Array, reference_next: Array) -> tuple[Array, float]:
        """Gradient (4,) and constant of Eq. 21 at u = 0. The constant does not move the minimum,
        but its rounding limits epsilon of Eq. 29: only with it is epsilon the paper's."""
        error = self._dynamics @ state - reference_next
        weighed, pull = self._weight @ error, self._rate @ self._previous
        gradient = 2.0 * (self._inputs.T @ weighed - pull)
        if not self._settings.keep_constant:
            return gradient, 0.0
        return gradient, float(error @ weighed + self._previous @ pull)


# ---------------------------------------------------------------------- over attitude setpoints


class PaperControllerSettings(PaperSettings, ControllerSettings):
    """Settings of the law `paper`; registered as an entry point like that of any other package."""

    law: Literal["paper"] = "paper"

    def build(self, vehicle: Vehicle, *, period_s: float, seed: int) -> PaperController:
        return PaperController(vehicle, self, period_s, seed)


class PaperController:
    """`PaperLaw` between a predicted state and a command."""

    def __init__(
        self,
        vehicle: Vehicle,
        settings: PaperSettings | None = None,
        step_s: float = PAPER_STEP_S,
        seed: int = 0,
    ) -> None:
        settings = settings or PaperSettings()
        dynamics, inputs = sampled_matrices(vehicle, step_s)
        lower, upper = flyable_box(vehicle, settings)
        self._vehicle = vehicle
        self._step_s = step_s
        scaled = inputs * input_scale(vehicle)
        self._law = PaperLaw(dynamics, scaled, settings, lower, upper, seed=seed)
        self._exact = ExactMinimum(len(lower))

    def decide(self, situation: Situation) -> Decision:
        target = situation.reference.sample(situation.state.time_s + self._step_s)
        if not _usable(situation.state):
            raise DecisionError("the predicted state is not finite")
        state, reference = heading_frame(situation.state, target)
        move = self._law.move(state, reference, situation.remaining_s)
        if not math.isfinite(move.result.cost):
            raise DecisionError("the cost of this decision is not finite")
        certificate = certify(move.problem, move.result, self._exact)
        return Decision(self._command(move, float(target.heading_rad)), certificate)

    def reset(self) -> None:
        self._law.reset()

    def _command(self, move: Move, target_heading_rad: float) -> Command:
        gravity, limit = self._vehicle.gravity_mps2, self._vehicle.thrust_max_mps2
        thrust = gravity + float(move.inputs[THRUST]) / PAPER_MASS_KG
        phi, theta, psi = move.following[PHI : PSI + 1].tolist()
        heading = target_heading_rad + psi
        attitude = quaternion_from_euler(phi, theta, heading)
        north, east, down = thrust_direction_from_quaternion(attitude).tolist()
        return Command(min(max(thrust, 0.0), limit), (north, east, down), wrap_pi(heading))


def input_scale(vehicle: Vehicle) -> Array:
    """Factor (4,) from inputs of the paper's vehicle (Eq. 6) to those of `vehicle` that cause the
    same accelerations, in translation and in rotation."""
    arms = np.array([vehicle.arm_m / PAPER_ARM_M, vehicle.arm_m / PAPER_ARM_M, 1.0])
    inertia = np.array(vehicle.inertia_kgm2) / np.array(PAPER_INERTIA_KGM2)
    return np.concatenate([[vehicle.mass_kg / PAPER_MASS_KG], inertia / arms])


def flyable_box(vehicle: Vehicle, settings: PaperSettings) -> tuple[Array, Array]:
    """Lower and upper (4,) of the settings, with f_t limited to a total thrust between 0 and the
    vehicle's maximum (cf. Eq. 26)."""
    lower, upper = np.array(settings.lower), np.array(settings.upper)
    hover = vehicle.gravity_mps2
    lower[THRUST] = max(lower[THRUST], -PAPER_MASS_KG * hover)
    upper[THRUST] = min(upper[THRUST], PAPER_MASS_KG * (vehicle.thrust_max_mps2 - hover))
    return lower, upper


def heading_frame(state: PredictedState, target: FlatSample) -> tuple[Array, Array]:
    """State and reference (12,) of Eqs. 5 and 27, rotated by -psi and relative to the target.

    The hover model is valid for a heading of north only; in axes along and across the nose it is
    valid for every heading. Positions and heading are relative to the target; velocities stay
    absolute because drag acts on them.
    """
    cosine, sine = math.cos(state.heading_rad), math.sin(state.heading_rad)
    to_heading = np.array([[cosine, sine, 0.0], [-sine, cosine, 0.0], [0.0, 0.0, 1.0]])
    direction = to_heading @ state.thrust_direction_ned
    vector = np.zeros(12)
    vector[PHI] = math.asin(min(max(-direction[1], -1.0), 1.0))
    vector[THETA] = math.atan2(direction[0], direction[2])
    vector[PSI] = wrap_pi(state.heading_rad - float(target.heading_rad))
    vector[P : R + 1] = state.rates_frd_radps
    vector[U : W + 1] = to_heading @ state.velocity_ned_mps
    vector[X : Z + 1] = to_heading @ (state.position_ned_m - target.position_ned_m)
    reference = np.zeros(12)
    reference[U : W + 1] = to_heading @ target.velocity_ned_mps
    return vector, reference


def _usable(state: PredictedState) -> bool:
    vectors = state.position_ned_m, state.velocity_ned_mps, state.thrust_direction_ned
    numbers = np.concatenate([*vectors, state.rates_frd_radps, [state.heading_rad]])
    return bool(np.isfinite(numbers).all())
