"""One flight of the paper's loop: law, plant and reference, step by step, every step certified.

A `FlightTask` is everything that decides a flight, and small enough to be sent to another process;
`fly` is a function of it alone. Knows neither which flights a table needs nor how they are shown.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from offboard.control.certificate import ExactMinimum, certify
from offboard.control.riccati import cost_to_go
from offboard.flight.clock import monotonic_s
from offboard.model.frames import quaternion_from_euler, rotation_from_quaternion
from offboard.model.predicted_state import PredictedState
from offboard.model.state import EULER, PHI, PSI, P, R, U, W, X, Z
from offboard.paper.controller import flyable_box, heading_frame
from offboard.paper.integral import INTEGRATED, ErrorIntegral
from offboard.paper.law import PAPER_STEP_S, PaperLaw, PaperSettings
from offboard.paper.plant import PLANTS, PlantKind, paper_model, paper_vehicle
from offboard.paper.trajectory import (
    PathName,
    Reach,
    linear_states,
    nominal_inputs,
    reach,
    turned_states,
)
from offboard.reference.base import FlatSample

Array = NDArray[np.float64]

# Eq. 31, in the order of Tables 3 and 4: u v w x y z psi
TRACKED = (6, 7, 8, 9, 10, 11, PSI)
_STILL = np.zeros(3)


class LawName(StrEnum):
    """The laws compared."""

    ONE_STEP = "one step"  # Eq. 21
    COST_TO_GO = "cost-to-go"  # the Riccati solution in the place of Q, a consistent reference


@dataclass(frozen=True, slots=True)
class FlightTask:
    """`start_offset_m` is where the flight starts from the reference's start, NED; `thrust_loss`
    the fraction of thrust that rotors fall short of."""

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
    """K steps. `states` (K + 1, 12) with velocities u, v, w in NED (on the nonlinear plant turned
    from the body), `tracked` (K + 1, 12) the reference likewise, `inputs` (K, 4) from hover.
    (K,): `costs` J, `spreads` epsilon, `gaps` (certificate), `solve_s`.
    """

    states: Array
    tracked: Array
    inputs: Array
    costs: Array
    spreads: Array
    gaps: Array
    solve_s: Array

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


@dataclass(frozen=True, slots=True)
class Summary:
    """What a table needs of a flight: `errors` (8,), `cost` J summed over the path, `signal_cost`
    the part of it that R and R_du weigh; `spreads`, `gaps`, `solve_s` (K,)."""

    errors: Array
    cost: float
    signal_cost: float
    spreads: Array
    gaps: Array
    solve_s: Array


def summarised(task: FlightTask) -> Summary:
    """Fly `task` and keep only what a table needs."""
    flight = fly(task)
    steps = np.diff(np.vstack([np.zeros(4), flight.inputs]), axis=0)
    signal = np.sum(flight.inputs**2 @ task.settings.energy) + np.sum(steps**2 @ task.settings.rate)
    return Summary(
        flight.errors, float(flight.costs.sum()), float(signal),
        flight.spreads, flight.gaps, flight.solve_s,
    )  # fmt: skip


def fly(task: FlightTask) -> Flight:
    """Fly `task`; the same task gives the same flight, solve times apart."""
    plant = PLANTS[task.plant](np.array(task.wind_ned_mps), task.thrust_loss)
    way = reach(task.path, task.steps)
    pilot = _Pilot(task, way)
    state = way.tracked[0].copy()
    state[X : Z + 1] += task.start_offset_m
    if task.law is LawName.COST_TO_GO:
        state[:PSI] = pilot.consistent[0][:PSI]
    states, inputs = [state], []
    for k in range(task.steps):
        inputs.append(pilot.inputs(k, state))
        state = plant.following(state, inputs[-1])
        states.append(state)
    shown = np.array(states)
    if task.plant is PlantKind.NONLINEAR:
        shown[:, U : W + 1] = _velocity_ned(shown)
    return Flight(shown, way.tracked, np.array(inputs), *np.array(pilot.figures).T)


class _Pilot:
    """The law, what it is shown of the state, and the figures of every decision."""

    def __init__(self, task: FlightTask, way: Reach) -> None:
        vehicle = paper_vehicle()
        self._dynamics, self._inputs = paper_model()
        self._way = way
        self._nonlinear = task.plant is PlantKind.NONLINEAR
        lower, upper = flyable_box(vehicle, task.settings) if self._nonlinear else (None, None)
        terminal = None
        if task.law is LawName.COST_TO_GO:
            terminal = cost_to_go(
                self._dynamics,
                self._inputs,
                np.diag(task.settings.fitness),
                np.diag(task.settings.energy),
            )
        self._terminal = terminal
        self._law = PaperLaw(
            self._dynamics, self._inputs, task.settings, lower, upper, terminal, seed=task.seed
        )
        self._integral = (
            ErrorIntegral(task.settings.integral, PAPER_STEP_S) if task.settings.integral else None
        )
        self._held = False
        self._exact = ExactMinimum(4)
        complete = turned_states if self._nonlinear else linear_states
        self.consistent = complete(way.samples, vehicle)
        self._nominal = nominal_inputs(self.consistent, way.samples, vehicle, self._nonlinear)
        self.figures: list[tuple[float, float, float, float]] = []

    def inputs(self, k: int, state: Array) -> Array:
        """u(k) (4,) for the plant's state x(k) (12,)."""
        reference_next, nominal = self._target(k, state)
        seen = self._seen(state, k if self._terminal is not None else k + 1)[0]
        summed = self._summed(k, state)
        started = monotonic_s()
        move = self._law.move(seen, reference_next, integral=summed, nominal=nominal)
        elapsed_s = monotonic_s() - started
        certificate = certify(move.problem, move.result, self._exact)
        self._held = certificate.at_bound
        self.figures.append((certificate.cost, certificate.spread, certificate.gap, elapsed_s))
        return move.inputs

    def _target(self, k: int, state: Array) -> tuple[Array, Array | None]:
        """x_ref(k+1) (12,), and u_nom (4,) where it is not hover.

        The cost-to-go wants a reference that the model itself follows: x_ref(k) one step on.
        """
        if self._terminal is None:
            return self._seen(state, k + 1)[1], None
        ahead = self._dynamics @ self.consistent[k] + self._inputs @ self._nominal[k]
        return ahead, self._nominal[k]

    def _seen(self, state: Array, k: int) -> tuple[Array, Array]:
        """State and reference (12,) as the law is shown them: as they are on the linear plant,
        in the heading frame and counted from sample k on the nonlinear one."""
        if not self._nonlinear:
            return state, self._way.tracked[k]
        return heading_frame(_predicted(state), _at(self._way.samples, k))

    def _summed(self, k: int, state: Array) -> Array | None:
        if not self._integral:
            return None
        off = (state - self._way.tracked[k])[list(INTEGRATED)]
        summed = self._integral.add(off, self._held).copy()
        if self._nonlinear:
            cosine, sine = np.cos(state[PSI]), np.sin(state[PSI])
            north, east = summed[0], summed[1]
            summed[:2] = cosine * north + sine * east, cosine * east - sine * north
        return summed


def _predicted(state: Array) -> PredictedState:
    """The plant's state (12,) as a controller is shown it."""
    rotation = rotation_from_quaternion(quaternion_from_euler(*state[PHI : PSI + 1]))
    return PredictedState(
        0.0, state[X : Z + 1], rotation @ state[U : W + 1], rotation[:, 2], _STILL,
        float(state[PSI]), 0.0, 0.0, _STILL, state[P : R + 1],
    )  # fmt: skip


def _velocity_ned(states: Array) -> Array:
    """NED velocity (..., 3) of states (..., 12) whose velocity is in body axes."""
    angles = np.moveaxis(states[..., EULER.attitude], -1, 0)
    rotation = rotation_from_quaternion(quaternion_from_euler(*angles))
    velocity: Array = np.einsum("...ij,...j->...i", rotation, states[..., EULER.velocity])
    return velocity


def _at(samples: FlatSample, k: int) -> FlatSample:
    return FlatSample(
        samples.position_ned_m[k], samples.velocity_ned_mps[k], samples.acceleration_ned_mps2[k],
        samples.jerk_ned_mps3[k], samples.snap_ned_mps4[k], samples.course_rad[k],
        samples.course_rate_radps[k], samples.course_acceleration_radps2[k],
    )  # fmt: skip
