"""The controller named `paper`: the paper's law, one step ahead on [f_t, tau], over MAVLink.

The swarm searches the inputs of Eq. 6 on the hover model (Eqs. 14, 21, 26); the attitude that the
model predicts for k+1 is sent, and the autopilot's attitude loop realises it in the place of the
torques. Knows no autopilot and reads no clock.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from offboard.control.base import Command, Decision, PredictedState, Situation
from offboard.control.certificate import ExactMinimum, certify
from offboard.control.cost import BoxQuadratic
from offboard.control.one_step import OneStep
from offboard.control.swarm import QuadraticSwarm, RandomLanes, SwarmResult, SwarmSettings
from offboard.model.frames import wrap_pi
from offboard.model.linear import sampled_matrices
from offboard.model.state import PHI, PSI, THETA, THRUST, P, R, U, W, X, Z
from offboard.model.vehicle import Parameters, Vehicle
from offboard.reference.base import FlatSample

Array = NDArray[np.float64]

PAPER_STEP_S = 0.1  # what Eq. 16 is sampled with, though it says 0.05
PAPER_MASS_KG = 0.4  # Table 1
PAPER_INERTIA_KGM2 = (0.0196, 0.0196, 0.0264)  # Table 1
PAPER_ARM_M = 0.225  # not in Table 1, but Eq. 16 is only reproduced with it

Weight = Annotated[float, Field(ge=0)]
Four = tuple[float, float, float, float]
FourWeights = tuple[Weight, Weight, Weight, Weight]
TwelveWeights = tuple[
    Weight, Weight, Weight, Weight, Weight, Weight, Weight, Weight, Weight, Weight, Weight, Weight
]


class PaperSettings(Parameters):
    """Weights, box and swarm of the paper, by default the final ones (section 4.3).

    States in the order of Eq. 5 in SI (psi in radians). Inputs are those of the paper's vehicle:
    another vehicle's are scaled so that the same numbers accelerate it alike, and box and weights
    keep their meaning. They are relative to hover; f_t is cut further where the total thrust
    would be negative or above the vehicle's maximum.

    The attitude sent is the one predicted for k+1. `attitude_lead` sends instead what the
    autopilot's loop must be asked for so that it follows that prediction: without it a slow or
    well damped loop realises a fraction of the torques only.
    """

    fitness: TwelveWeights = (1, 1, 25, 1, 1, 1, 20, 20, 5, 20, 20, 5)  # diag Q, Eq. 33
    energy: FourWeights = (0.00057, 0.125, 0.125, 0.5)  # diag R, Eq. 34
    rate: FourWeights = (1, 1, 1, 1)  # diag R_du, Eqs. 25 and 35
    lower: Four = (-4.0, -0.2, -0.2, -0.1)  # N, N, N, N m, Eq. 26
    upper: Four = (3.942, 0.2, 0.2, 0.1)  # Eq. 26
    attitude_lead: bool = False
    keep_constant: bool = True  # of J; epsilon of Eq. 29 rests on its rounding
    swarm: SwarmSettings = SwarmSettings()
    seed: int = Field(default=0, ge=0, lt=2**64)

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
    """What the law chose: inputs u(k) (4,), the state (12,) they lead to, and how it was found."""

    inputs: Array
    following: Array
    problem: BoxQuadratic
    result: SwarmResult


class PaperLaw:
    """The law on any plant of Eq. 14: dynamics (12, 12), inputs (12, 4), box (4,), (4,).

    Remembers the last input (for R_du) and the random stream; `reset` forgets both. `terminal`
    (12, 12) takes the place of diag(Q), for instance `cost_to_go` of the same weights.
    """

    def __init__(
        self,
        dynamics: Array,
        inputs: Array,
        settings: PaperSettings,
        lower: Array | None = None,
        upper: Array | None = None,
        terminal: Array | None = None,
    ) -> None:
        weight = np.diag(settings.fitness) if terminal is None else terminal
        self._step = OneStep(
            dynamics, inputs, weight, np.diag(settings.energy), np.diag(settings.rate)
        )
        self._lower = np.array(settings.lower if lower is None else lower, np.float64)
        self._upper = np.array(settings.upper if upper is None else upper, np.float64)
        self._keep_constant = settings.keep_constant
        self._swarm = QuadraticSwarm(settings.swarm, len(self._lower))
        self._lanes = RandomLanes(settings.seed)
        self._nominal = np.zeros(len(self._lower))
        self._previous = self._nominal

    def move(
        self,
        state: Array,
        reference_next: Array,
        remaining_s: Callable[[], float] | None = None,
    ) -> Move:
        """u(k) for the state x(k) (12,) towards x_ref(k+1) (12,), Eq. 27."""
        problem = self._step.problem(
            state, reference_next, self._nominal, self._previous, self._lower, self._upper,
            keep_constant=self._keep_constant,
        )  # fmt: skip
        result = self._swarm.minimise(problem, self._lanes, remaining_s=remaining_s)
        self._previous = result.best
        return Move(result.best, self._step.predict(state, result.best), problem, result)

    def reset(self) -> None:
        self._previous = self._nominal
        self._lanes.reset()


class PaperController:
    """`PaperLaw` between a predicted state and a command; `stopwatch` () -> s lets it keep a
    deadline and report its time. Without one it takes the iterations it is allowed."""

    def __init__(
        self,
        vehicle: Vehicle,
        settings: PaperSettings | None = None,
        step_s: float = PAPER_STEP_S,
        stopwatch: Callable[[], float] | None = None,
    ) -> None:
        settings = settings or PaperSettings()
        dynamics, inputs = sampled_matrices(vehicle, step_s)
        lower, upper = flyable_box(vehicle, settings)
        self._vehicle = vehicle
        self._settings = settings
        self._step_s = step_s
        self._stopwatch = stopwatch
        self._law = PaperLaw(dynamics, inputs * input_scale(vehicle), settings, lower, upper)
        self._exact = ExactMinimum(len(lower))

    def decide(self, situation: Situation) -> Decision:
        """The command for one tick; the one in force again where the state has no finite cost."""
        started = self._stopwatch() if self._stopwatch else math.nan
        target = situation.reference.sample(situation.state.time_s + self._step_s)
        if not _usable(situation.state):
            return Decision(situation.previous)
        state, reference = heading_frame(situation.state, target)
        move = self._law.move(state, reference, self._remaining(situation.deadline_s, started))
        if not math.isfinite(move.result.cost):
            return Decision(situation.previous)
        certificate = certify(move.problem, move.result, self._exact)
        if self._stopwatch:
            certificate = replace(certificate, solve_time_s=self._stopwatch() - started)
        return Decision(self._command(move, state, float(target.course_rad)), certificate)

    def reset(self) -> None:
        """Forget everything of the previous flight, the random stream included."""
        self._law.reset()

    def warm_up(self) -> None:
        """Call every code path once, compiled and daqp's, and forget it again."""
        move = self._law.move(np.zeros(12), np.zeros(12), lambda: math.inf)
        certify(move.problem, move.result, self._exact)
        self.reset()

    def _remaining(self, deadline_s: float | None, started: float) -> Callable[[], float] | None:
        stopwatch = self._stopwatch
        if stopwatch is None or deadline_s is None:
            return None
        return lambda: deadline_s - (stopwatch() - started)

    def _command(self, move: Move, state: Array, target_course_rad: float) -> Command:
        gravity, limit = self._vehicle.gravity_mps2, self._vehicle.thrust_max_mps2
        thrust = gravity + float(move.inputs[THRUST]) / PAPER_MASS_KG
        phi, theta, psi = (float(angle) for angle in self._attitude(state, move.following))
        course = target_course_rad + psi
        return Command(
            min(max(thrust, 0.0), limit), _thrust_direction(phi, theta, course), wrap_pi(course)
        )

    def _attitude(self, state: Array, following: Array) -> Array:
        """[phi, theta, psi] to send, from x(k) and x(k+1) (12,)."""
        predicted = following[PHI : PSI + 1]
        if not self._settings.attitude_lead:
            return predicted
        rates = following[P : R + 1]
        accelerations = (rates - state[P : R + 1]) / self._step_s
        loops = (self._vehicle.tilt, self._vehicle.tilt, self._vehicle.yaw)
        frequency = np.array([loop.natural_frequency_radps for loop in loops])
        damping = np.array([loop.damping for loop in loops])
        # s_c from s'' = wn^2 (s_c - s) - 2 z wn s'; its delay is in the state predicted already
        lead: Array = 2.0 * damping / frequency * rates + accelerations / frequency**2
        asked: Array = predicted + lead
        return asked


def input_scale(vehicle: Vehicle) -> Array:
    """Newtons (metres) of the vehicle per newton (metre) of the paper's, (4,), Eq. 6.

    The same input accelerates both alike, in translation and in rotation.
    """
    arms = np.array([vehicle.arm_m / PAPER_ARM_M, vehicle.arm_m / PAPER_ARM_M, 1.0])
    inertia = np.array(vehicle.inertia_kgm2) / np.array(PAPER_INERTIA_KGM2)
    return np.concatenate([[vehicle.mass_kg / PAPER_MASS_KG], inertia / arms])


def flyable_box(vehicle: Vehicle, settings: PaperSettings) -> tuple[Array, Array]:
    """The settings' box (4,), (4,) with f_t cut to a total thrust of 0 .. maximum (cf. Eq. 26)."""
    lower, upper = np.array(settings.lower), np.array(settings.upper)
    hover = vehicle.gravity_mps2
    lower[THRUST] = max(lower[THRUST], -PAPER_MASS_KG * hover)
    upper[THRUST] = min(upper[THRUST], PAPER_MASS_KG * (vehicle.thrust_max_mps2 - hover))
    return lower, upper


def heading_frame(state: PredictedState, target: FlatSample) -> tuple[Array, Array]:
    """State and reference (12,) of Eqs. 5 and 27, turned by -psi and shifted to the target.

    The hover model holds at course north only; in axes along and across the nose it holds at any.
    Positions and course count from the target, velocities stay absolute because drag acts on them.
    """
    to_heading = _turn(-state.course_rad)
    direction = to_heading @ state.thrust_direction_ned
    vector = np.zeros(12)
    vector[PHI] = math.asin(min(max(-direction[1], -1.0), 1.0))
    vector[THETA] = math.atan2(direction[0], direction[2])
    vector[PSI] = wrap_pi(state.course_rad - float(target.course_rad))
    vector[P : R + 1] = state.rates_frd_radps
    vector[U : W + 1] = to_heading @ state.velocity_ned_mps
    vector[X : Z + 1] = to_heading @ (state.position_ned_m - target.position_ned_m)
    reference = np.zeros(12)
    reference[U : W + 1] = to_heading @ target.velocity_ned_mps
    return vector, reference


def _usable(state: PredictedState) -> bool:
    return math.isfinite(state.course_rad) and all(
        np.isfinite(part).all()
        for part in (
            state.position_ned_m,
            state.velocity_ned_mps,
            state.thrust_direction_ned,
            state.rates_frd_radps,
        )
    )


def _turn(angle_rad: float) -> Array:
    """Rotation (3, 3) about the vertical."""
    cosine, sine = math.cos(angle_rad), math.sin(angle_rad)
    return np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])


def _thrust_direction(phi: float, theta: float, psi: float) -> tuple[float, float, float]:
    """Third body axis in NED of the Z-Y-X angles in rad."""
    along, across = math.sin(theta) * math.cos(phi), -math.sin(phi)
    cosine, sine = math.cos(psi), math.sin(psi)
    return (
        cosine * along - sine * across,
        sine * along + cosine * across,
        math.cos(theta) * math.cos(phi),
    )
