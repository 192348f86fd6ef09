"""The law `paper`: the paper's law, one step ahead with inputs [f_t, tau], by attitude setpoints.

The swarm searches for the inputs of Eq. 6 on the hover model (Eqs. 14, 21, 26). Instead of torques,
the attitude that the model predicts for k+1 is sent; the autopilot's attitude loop controls it.
"""

from __future__ import annotations

import math
from functools import cache
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from offboard.control.base import ControllerSettings, Decision, DecisionError, Situation
from offboard.control.quadratic import ExactMinimum
from offboard.control.swarm import certify
from offboard.documents.reading import load_document
from offboard.model.command import Command, PredictedState
from offboard.model.frames import (
    quaternion_from_euler,
    thrust_direction_from_quaternion,
    wrap_pi,
)
from offboard.model.rigid_body import PHI, PSI, THETA, THRUST, P, R, U, W, X, Z, sampled_matrices
from offboard.model.vehicle import Vehicle
from offboard.paper.law import PAPER_STEP_S, Move, PaperLaw, PaperSettings
from offboard.reference.base import FlatSample

Array = NDArray[np.float64]


class PaperControllerSettings(PaperSettings, ControllerSettings):
    """Settings of the law `paper`, registered as an entry point, as those of other packages are."""

    law: Literal["paper"] = "paper"

    def build(self, vehicle: Vehicle, *, period_s: float, seed: int) -> PaperController:
        return PaperController(vehicle, self, period_s, seed)


class PaperController:
    """Controller that computes a command from the predicted state by `PaperLaw`.

    Raises ValueError if this vehicle cannot keep the state limits of the settings.
    """

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
        self._settings = settings
        self._step_s = step_s
        scaled = inputs * input_scale(vehicle)
        self._law = PaperLaw(dynamics, scaled, settings, lower, upper, step_s=step_s, seed=seed)
        self._exact = ExactMinimum(len(lower))

    def decide(self, situation: Situation) -> Decision:
        target = situation.reference.sample(situation.state.time_s + self._step_s)
        if not _usable(situation.state):
            raise DecisionError("the predicted state is not finite")
        state, reference = heading_frame(situation.state, target)
        move = self._law.move(
            state,
            reference,
            situation.remaining_s,
            error=self._error(situation) if self._settings.integral else None,
            heading_rad=situation.state.heading_rad,
        )
        if not math.isfinite(move.result.cost):
            raise DecisionError("the cost of this decision is not finite")
        certificate = certify(move.problem, move.result, self._exact)
        return Decision(self._command(move, float(target.heading_rad)), certificate)

    def reset(self) -> None:
        self._law.reset()

    def _error(self, situation: Situation) -> Array:
        """Return the present error (4,) of position (NED) and heading."""
        state, now = situation.state, situation.reference.sample(situation.state.time_s)
        heading = wrap_pi(state.heading_rad - float(now.heading_rad))
        return np.append(state.position_ned_m - now.position_ned_m, heading)

    def _command(self, move: Move, target_heading_rad: float) -> Command:
        gravity, limit = self._vehicle.gravity_mps2, self._vehicle.thrust_max_mps2
        thrust = gravity + float(move.inputs[THRUST]) / paper_vehicle().mass_kg
        phi, theta, psi = move.following[PHI : PSI + 1].tolist()
        heading = target_heading_rad + psi
        attitude = quaternion_from_euler(phi, theta, heading)
        north, east, down = thrust_direction_from_quaternion(attitude).tolist()
        return Command(min(max(thrust, 0.0), limit), (north, east, down), wrap_pi(heading))


@cache
def paper_vehicle() -> Vehicle:
    """Return the vehicle of Table 1 with the arm that Eq. 16 requires: the vehicle file `paper`."""
    return load_document("paper", "vehicle", Vehicle)[0]


def input_scale(vehicle: Vehicle) -> Array:
    """Return the factors (4,) from inputs of the paper's vehicle (Eq. 6) to those of `vehicle` that
    cause the same accelerations, in translation and in rotation."""
    paper = paper_vehicle()
    arms = np.array([vehicle.arm_m / paper.arm_m, vehicle.arm_m / paper.arm_m, 1.0])
    inertia = np.array(vehicle.inertia_kgm2) / np.array(paper.inertia_kgm2)
    return np.concatenate([[vehicle.mass_kg / paper.mass_kg], inertia / arms])


def flyable_box(vehicle: Vehicle, settings: PaperSettings) -> tuple[Array, Array]:
    """Return the lower and upper bounds (4,) of the settings, with f_t limited to a total thrust
    between 0 and the vehicle's maximum (cf. Eq. 26)."""
    lower, upper = np.array(settings.lower), np.array(settings.upper)
    hover, mass_kg = vehicle.gravity_mps2, paper_vehicle().mass_kg
    lower[THRUST] = max(lower[THRUST], -mass_kg * hover)
    upper[THRUST] = min(upper[THRUST], mass_kg * (vehicle.thrust_max_mps2 - hover))
    return lower, upper


def heading_frame(state: PredictedState, target: FlatSample) -> tuple[Array, Array]:
    """Return state and reference (12,) of Eqs. 5, 27, rotated by -psi and relative to the target.

    The hover model is valid for a heading of north only, but in axes along and across the nose for
    every heading. Positions and heading are relative to the target; velocities stay absolute,
    because drag depends on them.
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
