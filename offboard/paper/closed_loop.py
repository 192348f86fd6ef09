"""One flight of the paper's closed loop: reference, law and plant, with a certificate for every
step.

The plants are the paper's linear model (Eq. 14) and its nonlinear one (Eq. 7); inputs are
deviations from hover, held for one step of 0.1 s. The paper draws its path (Figs. 5 and 6) without
numbers. The path here is similar: about 100 s at some 3 m/s through turns and changes of height,
minimum snap from rest to rest, with the nose along the path.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum
from functools import cache

import numpy as np
from numpy.typing import NDArray

from offboard.compiled import array, entry
from offboard.control.quadratic import ExactMinimum
from offboard.control.swarm import certify
from offboard.link.clock import monotonic_s
from offboard.model.axes import LinearModel
from offboard.model.command import PredictedState
from offboard.model.frames import quaternion_from_euler, rotation_from_quaternion
from offboard.model.rigid_body import (
    EULER,
    PSI,
    QUATERNION,
    RK4_SCRATCH_ROWS,
    THRUST,
    P,
    R,
    U,
    W,
    X,
    Z,
    derivative_into,
    hover_input,
    hover_matrices,
    pack,
    quaternion_state,
    rk4_into,
    sampled_matrices,
)
from offboard.paper.controller import flyable_box, heading_frame, paper_vehicle
from offboard.paper.law import INTEGRATED, PAPER_STEP_S, PaperLaw, PaperSettings
from offboard.reference.base import FlatSample
from offboard.reference.path import Smoothness
from offboard.reference.shapes import Hover, Waypoints

Array = NDArray[np.float64]

HOVER = Hover(height_m=2.0, duration_s=60.0)
TOUR = Waypoints(
    points_m=(
        (0.0, 0.0, 2.0), (20.0, 5.0, 2.0), (30.0, 25.0, 4.0), (10.0, 40.0, 6.0),
        (-15.0, 30.0, 6.0), (-25.0, 0.0, 4.0), (-10.0, -30.0, 4.0), (20.0, -40.0, 3.0),
        (45.0, -20.0, 2.0), (50.0, 10.0, 2.0),
    ),
    speed_mps=2.8,  # mean speed of inner legs
    minimise=Smoothness.SNAP,
    course="along_velocity",
)  # fmt: skip
FIRST = PaperSettings.first_configuration()
TRACKED = (*range(U, Z + 1), PSI)  # Eq. 31, in the order of Tables 3 and 4: u v w x y z psi
_SUBSTEPS = 10


@cache
def reference_states(hover: bool, steps: int) -> Array:
    """Return the reference states (steps + 1, 12) of Eq. 27 for a hover or the path of Figs. 5-6:
    zero except psi, u, v, w, x, y, z, with velocities in NED as on the linear plant."""
    samples = (HOVER if hover else TOUR).track().sample(PAPER_STEP_S * np.arange(steps + 1.0))
    tracked = np.zeros((steps + 1, 12))
    tracked[:, PSI] = samples.heading_rad
    tracked[:, U : W + 1] = samples.velocity_ned_mps
    tracked[:, X : Z + 1] = samples.position_ned_m
    return tracked


# ---------------------------------------------------------------------- plants


@cache
def paper_model() -> tuple[Array, Array]:
    """Return A_d (12, 12) and B_d (12, 4) of Eq. 14, sampled with 0.1 s, as Eq. 16 is.

    All callers share the arrays, which are read-only.
    """
    dynamics, inputs = sampled_matrices(paper_vehicle(), PAPER_STEP_S)
    dynamics.flags.writeable = inputs.flags.writeable = False
    return dynamics, inputs


class PlantKind(StrEnum):
    """The linear model of Eqs. 14-18, or the nonlinear rigid body of Eqs. 1-8."""

    LINEAR = "linear"
    NONLINEAR = "nonlinear"


Plant = Callable[[Array, Array], Array]  # x(k+1) (12,) from x(k) (12,) and u(k) (4,)


def linear_plant(wind_ned_mps: Array, thrust_loss: float) -> Plant:
    """Return the plant of Eq. 14 with C = I. A constant wind (3,) acts as a force through the drag,
    sampled exactly; `thrust_loss` is the missing fraction of the total thrust, 0 to 1."""
    vehicle = paper_vehicle()
    motion, _ = hover_matrices(vehicle)
    force = np.zeros((len(motion), 1))
    drag = np.array(vehicle.drag_translation_npmps) / vehicle.mass_kg
    force[U : W + 1, 0] = drag * wind_ned_mps
    wind_effect = LinearModel(motion, force).sampled(PAPER_STEP_S).input_map[:, 0]
    dynamics, control_map = paper_model()

    def next_state(state: Array, inputs: Array) -> Array:
        delivered = _delivered(inputs, thrust_loss)
        following: Array = dynamics @ state + control_map @ delivered + wind_effect
        return following

    return next_state


def nonlinear_plant(wind_ned_mps: Array, thrust_loss: float) -> Plant:
    """Return the plant of Eq. 7, integrated by RK4 in ten substeps; the total thrust is never
    negative. The arguments are those of `linear_plant`; velocities u, v, w are in body axes.
    """
    hover, parameters = hover_input(paper_vehicle()), pack(paper_vehicle())
    wind, scratch = np.array(wind_ned_mps, np.float64), np.empty((RK4_SCRATCH_ROWS, EULER.size))

    def next_state(state: Array, inputs: Array) -> Array:
        total = hover + _delivered(inputs, thrust_loss)
        total[THRUST] = max(total[THRUST], 0.0)
        following, step_s = state.copy(), PAPER_STEP_S / _SUBSTEPS
        follow(following, total, wind, parameters, step_s, _SUBSTEPS, scratch)
        return following

    return next_state


@entry(array(1), array(1), array(1), array(1), float, int, array(2))
def follow(
    state: Array,
    inputs: Array,
    wind_ned: Array,
    parameters: Array,
    step_s: float,
    steps: int,
    scratch: Array,
) -> None:
    """Do `steps` RK4 steps with held inputs and wind, in place; shapes as in `rk4_into`."""
    for _ in range(steps):
        rk4_into(derivative_into, state, inputs, wind_ned, parameters, step_s, scratch, state)


def _delivered(inputs: Array, thrust_loss: float) -> Array:
    """Return the inputs (4,) that the rotors deliver, with a fraction of the total thrust lost."""
    delivered = inputs.copy()
    delivered[THRUST] -= thrust_loss * (hover_input(paper_vehicle())[THRUST] + inputs[THRUST])
    return delivered


# ---------------------------------------------------------------------- flights


@dataclass(frozen=True, slots=True)
class FlightTask:
    """A flight to be computed.

    `hover`: whether a hover is flown instead of the path of Figs. 5-6. `cost_to_go`: whether the
    Riccati solution replaces Q of Eq. 21; only for a hover, because the model would not follow a
    moving reference by itself. `start_offset_m` is the start relative to that of the reference,
    NED; `thrust_loss` is the missing fraction of the total thrust."""

    settings: PaperSettings
    plant: PlantKind = PlantKind.LINEAR
    hover: bool = False
    cost_to_go: bool = False
    steps: int = 1000
    wind_ned_mps: tuple[float, float, float] = (0.0, 0.0, 0.0)
    thrust_loss: float = 0.0
    start_offset_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    seed: int = 0


@dataclass(frozen=True, slots=True)
class Flight:
    """A computed flight of K steps. `states` and the reference `tracked` (K + 1, 12) have
    velocities u, v, w in NED; `inputs` (K, 4) are relative to hover. Per step (K,): `costs` J and
    their part weighted by R and R_du, `spreads` epsilon, `gaps` to the exact optimum, `solve_s`.
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
        return PAPER_STEP_S * np.arange(float(len(self.states)))

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
    """Compute the flight of `task`. The same task gives the same flight, except for solve times."""
    settings, nonlinear = task.settings, task.plant is PlantKind.NONLINEAR
    plant = (nonlinear_plant if nonlinear else linear_plant)(
        np.array(task.wind_ned_mps), task.thrust_loss
    )
    lower, upper = flyable_box(paper_vehicle(), settings) if nonlinear else (None, None)
    terminal = cost_to_go(settings) if task.cost_to_go else None
    law = PaperLaw(*paper_model(), settings, lower, upper, terminal, seed=task.seed)
    exact, tracked = ExactMinimum(4), reference_states(task.hover, task.steps)
    state = tracked[0].copy()
    state[X : Z + 1] += task.start_offset_m
    states, inputs, quality = [state], [], []
    for k in range(task.steps):
        target = tracked[k + 1]
        seen, wanted = _in_heading_frame(state, target) if nonlinear else (state, target)
        started = monotonic_s()
        move = law.move(
            seen,
            wanted,
            error=(state - tracked[k])[list(INTEGRATED)],
            heading_rad=state[PSI] if nonlinear else 0.0,
        )
        solve_s = monotonic_s() - started
        certificate = certify(move.problem, move.result, exact)
        quality.append((certificate.cost, certificate.spread, certificate.gap, solve_s))
        inputs.append(move.inputs)
        state = plant(state, move.inputs)
        states.append(state)
    flown, applied = np.array(states), np.array(inputs)
    if nonlinear:
        flown[:, U : W + 1] = quaternion_state(flown)[:, QUATERNION.velocity]
    changes = np.diff(applied, axis=0, prepend=0.0)
    signal_costs = applied**2 @ settings.energy + changes**2 @ settings.rate
    costs, *rest = np.array(quality).T
    return Flight(flown, tracked, applied, costs, signal_costs, *rest)


def _in_heading_frame(state: Array, target: Array) -> tuple[Array, Array]:
    """Return state and reference (12,) of the nonlinear plant in the frame of `heading_frame`."""
    rotation = rotation_from_quaternion(quaternion_from_euler(*state[EULER.attitude]))
    still = np.zeros(3)
    predicted = PredictedState(
        0.0, state[X : Z + 1], rotation @ state[U : W + 1], rotation[:, 2], still,
        float(state[PSI]), 0.0, 0.0, still, state[P : R + 1],
    )  # fmt: skip
    velocity, heading = target[U : W + 1], target[PSI]
    nothing = np.zeros(())
    return heading_frame(
        predicted,
        FlatSample(target[X : Z + 1], velocity, still, still, still, heading, nothing, nothing),
    )


def cost_to_go(settings: PaperSettings) -> Array:
    """Return P (12, 12) of the infinite horizon (Riccati) with Q and R of `settings`."""
    import control  # takes a second: imported only for a design

    weights = np.diag(settings.fitness), np.diag(settings.energy)
    solution: Array = control.dlqr(*paper_model(), *weights)[1]
    return solution


def damped(damping: float, **swarm: float) -> PaperSettings:
    """Return the first configuration (section 4.1) with this lambda and the settings `swarm`."""
    changes = {"swarm": FIRST.swarm.model_copy(update={"damping": damping, **swarm})}
    return FIRST.model_copy(update=changes)


class Flights:
    """The flights of one run of the study; each is computed once. `seeds` is the number of flights
    per row of a table; `on_flight` is called after each flight with the number of flights."""

    def __init__(self, seeds: int = 1, on_flight: Callable[[int], None] = lambda _: None) -> None:
        self.seeds = seeds
        self._on_flight = on_flight
        self._flown: dict[FlightTask, Flight] = {}

    def __call__(self, task: FlightTask) -> Flight:
        """Return the flight of `task`."""
        if task not in self._flown:
            self._flown[task] = fly(task)
            self._on_flight(len(self._flown))
        return self._flown[task]

    def by_seed(
        self, settings: PaperSettings, plant: PlantKind = PlantKind.LINEAR, most: int = 10_000
    ) -> list[Flight]:
        """Return one flight on the path per seed, at most `most` flights."""
        count = min(self.seeds, most)
        return [self(FlightTask(settings, plant, seed=seed)) for seed in range(count)]
