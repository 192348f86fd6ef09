"""One flight of the paper's loop: law, plant and reference, with a certificate for every step.

A `FlightTask` contains everything that determines a flight and is small enough to send to another
process; `fly` depends on nothing else.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from offboard.control.gains import riccati
from offboard.control.quadratic import ExactMinimum
from offboard.control.swarm import certify
from offboard.link.clock import monotonic_s
from offboard.model.frames import quaternion_from_euler, rotation_from_quaternion
from offboard.model.predicted_state import PredictedState
from offboard.model.state import EULER, PHI, PSI, P, R, U, W, X, Z
from offboard.paper.controller import flyable_box, heading_frame
from offboard.paper.integral import INTEGRATED, ErrorIntegral
from offboard.paper.law import PAPER_STEP_S, PaperLaw, PaperSettings
from offboard.paper.plant import PLANTS, PlantKind, paper_model, paper_vehicle
from offboard.paper.trajectory import (
    PathName,
    SampledPath,
    heading_states,
    linear_states,
    nominal_inputs,
    sampled_path,
)
from offboard.reference.base import FlatSample

Array = NDArray[np.float64]

TRACKED = (*range(U, Z + 1), PSI)  # Eq. 31, in the order of Tables 3 and 4: u v w x y z psi


class LawName(StrEnum):
    """The laws compared."""

    ONE_STEP = "one step"  # Eq. 21
    COST_TO_GO = "cost-to-go"  # the Riccati solution replaces Q; the reference is consistent


@dataclass(frozen=True, slots=True)
class FlightTask:
    """`start_offset_m` is the start relative to the reference's start, NED; `thrust_loss` the
    missing fraction of the total thrust."""

    settings: PaperSettings
    plant: PlantKind = PlantKind.LINEAR
    path: PathName = PathName.TOUR
    law: LawName = LawName.ONE_STEP
    steps: int = 1000
    wind_ned_mps: tuple[float, float, float] = (0.0, 0.0, 0.0)
    thrust_loss: float = 0.0
    start_offset_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    seed: int = 0


@dataclass(frozen=True, slots=True)
class Flight:
    """K steps. `states` and the reference `tracked` (K + 1, 12) with velocities u, v, w in NED;
    `inputs` (K, 4) relative to hover. Per step (K,): `costs` J and their part weighed by R and
    R_du, `spreads` epsilon, `gaps` to the exact optimum, `solve_s`.
    """

    states: Array
    tracked: Array
    inputs: Array
    costs: Array
    signal_costs: Array
    spreads: Array
    gaps: Array
    solve_s: Array

    @property
    def times_s(self) -> Array:
        """(K + 1,) from 0."""
        times: Array = PAPER_STEP_S * np.arange(len(self.states), dtype=np.float64)
        return times

    @property
    def errors(self) -> Array:
        """e_u ... e_psi and mu_e (8,), Eqs. 31-32; psi in degrees, as in Tables 3 and 4."""
        off = (self.states - self.tracked)[1:, list(TRACKED)]
        off[:, -1] = np.degrees(off[:, -1])
        squares = np.sum(off**2, axis=0)
        return np.append(squares, squares.sum())

    @property
    def position_errors_m(self) -> Array:
        """Distance from the reference (K + 1,)."""
        distances: Array = np.linalg.norm((self.states - self.tracked)[:, X : Z + 1], axis=1)
        return distances


def fly(task: FlightTask) -> Flight:
    """Fly `task`; the same task gives the same flight, except for the solve times."""
    plant = PLANTS[task.plant](np.array(task.wind_ned_mps), task.thrust_loss)
    path = sampled_path(task.path, task.steps)
    controller = _Controller(task, path)
    state = path.tracked[0].copy()
    state[X : Z + 1] += task.start_offset_m
    if task.law is LawName.COST_TO_GO:
        state[:PSI] = controller.consistent[0][:PSI]
    states, inputs = [state], []
    for k in range(task.steps):
        inputs.append(controller.inputs(k, state))
        state = plant.next_state(state, inputs[-1])
        states.append(state)
    flown = np.array(states)
    if task.plant is PlantKind.NONLINEAR:
        flown[:, U : W + 1] = _velocity_ned(flown)
    applied = np.array(inputs)
    changes = np.diff(applied, axis=0, prepend=0.0)
    signal_costs = applied**2 @ task.settings.energy + changes**2 @ task.settings.rate
    costs, *figures = np.array(controller.figures).T
    return Flight(flown, path.tracked, applied, costs, signal_costs, *figures)


class _Controller:
    """The law of a task. `consistent` (K + 1, 12) are the states that the plant's model has when
    it follows the reference; `figures` cost, spread, gap and solve time of every step."""

    def __init__(self, task: FlightTask, path: SampledPath) -> None:
        vehicle, settings = paper_vehicle(), task.settings
        self._dynamics, self._inputs = paper_model()
        self._path = path
        self._nonlinear = task.plant is PlantKind.NONLINEAR
        lower, upper = flyable_box(vehicle, settings) if self._nonlinear else (None, None)
        self._terminal = None
        if task.law is LawName.COST_TO_GO:
            weights = np.diag(settings.fitness), np.diag(settings.energy)
            self._terminal = riccati(self._dynamics, self._inputs, *weights)
        self._law = PaperLaw(
            self._dynamics, self._inputs, settings, lower, upper, self._terminal, seed=task.seed
        )
        integral = settings.integral
        self._integral = ErrorIntegral(integral, PAPER_STEP_S) if integral else None
        self._at_bound = False
        self._exact = ExactMinimum(4)
        complete = heading_states if self._nonlinear else linear_states
        self.consistent = complete(path.samples, vehicle)
        self._nominal = nominal_inputs(self.consistent, path.samples, vehicle, self._nonlinear)
        self.figures: list[tuple[float, float, float, float]] = []

    def inputs(self, k: int, state: Array) -> Array:
        """u(k) (4,) for the plant's state x(k) (12,)."""
        integral = self._summed_error(k, state)
        nominal = None
        seen, target = self._in_axes_of_the_law(state, k + 1)
        if self._terminal is not None:  # needs a reference that the model itself can follow
            seen, _ = self._in_axes_of_the_law(state, k)
            nominal = self._nominal[k]
            target = self._dynamics @ self.consistent[k] + self._inputs @ nominal
        started = monotonic_s()
        move = self._law.move(seen, target, integral=integral, nominal=nominal)
        elapsed_s = monotonic_s() - started
        certificate = certify(move.problem, move.result, self._exact)
        self._at_bound = certificate.at_bound
        self.figures.append((certificate.cost, certificate.spread, certificate.gap, elapsed_s))
        return move.inputs

    def _in_axes_of_the_law(self, state: Array, k: int) -> tuple[Array, Array]:
        """State and reference k (12,): unchanged on the linear plant; in the heading frame and
        relative to sample k on the nonlinear one."""
        if not self._nonlinear:
            return state, self._path.tracked[k]
        samples = self._path.samples
        sample = FlatSample(*(getattr(samples, field.name)[k] for field in fields(samples)))
        return heading_frame(_predicted(state), sample)

    def _summed_error(self, k: int, state: Array) -> Array | None:
        if not self._integral:
            return None
        off = (state - self._path.tracked[k])[list(INTEGRATED)]
        summed = self._integral.add(off, self._at_bound).copy()
        if self._nonlinear:
            cosine, sine = np.cos(state[PSI]), np.sin(state[PSI])
            north, east = summed[0], summed[1]
            summed[:2] = cosine * north + sine * east, cosine * east - sine * north
        return summed


def _predicted(state: Array) -> PredictedState:
    """The plant's state (12,) in the form that a controller gets."""
    rotation = rotation_from_quaternion(quaternion_from_euler(*state[PHI : PSI + 1]))
    still = np.zeros(3)
    return PredictedState(
        0.0, state[X : Z + 1], rotation @ state[U : W + 1], rotation[:, 2], still,
        float(state[PSI]), 0.0, 0.0, still, state[P : R + 1],
    )  # fmt: skip


def _velocity_ned(states: Array) -> Array:
    """NED velocity (..., 3) of states (..., 12) whose velocity is in body axes."""
    angles = np.moveaxis(states[..., EULER.attitude], -1, 0)
    rotation = rotation_from_quaternion(quaternion_from_euler(*angles))
    velocity: Array = np.einsum("...ij,...j->...i", rotation, states[..., EULER.velocity])
    return velocity
