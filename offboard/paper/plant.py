"""What the paper's law is flown on: its own linear model (Eq. 14) and the nonlinear one (Eq. 7).

Both take inputs in deviation from hover, hold them over one step, and know wind and a thrust that
is weaker than believed. Neither knows a law or a reference.
"""

from __future__ import annotations

from enum import StrEnum
from functools import cache

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm

from offboard.compiled import array, entry
from offboard.documents import shipped
from offboard.documents.reading import parse
from offboard.model.linear import hover_matrices, sampled_matrices
from offboard.model.rigid_body import (
    RK4_SCRATCH_ROWS,
    derivative_into,
    hover_input,
    pack,
    rk4_into,
)
from offboard.model.state import EULER, THRUST, U, W
from offboard.model.vehicle import Vehicle
from offboard.paper.law import PAPER_STEP_S

Array = NDArray[np.float64]

_SUBSTEPS = 10


class PlantKind(StrEnum):
    """Eqs. 14-18, or the rigid body of Eqs. 1-8."""

    LINEAR = "linear"
    NONLINEAR = "nonlinear"


@cache
def paper_vehicle() -> Vehicle:
    """Table 1, with the arm that Eq. 16 needs: the shipped vehicle file `paper`."""
    file = shipped.directory() / "vehicles" / "paper.yaml"
    return parse(file.read_text(encoding="utf-8"), Vehicle, str(file))


@cache
def paper_model() -> tuple[Array, Array]:
    """A_d (12, 12) and B_d (12, 4) of Eq. 14, sampled with the 0.1 s that Eq. 16 is sampled with.

    Shared between callers: not to be written to.
    """
    dynamics, inputs = sampled_matrices(paper_vehicle(), PAPER_STEP_S)
    dynamics.flags.writeable = inputs.flags.writeable = False
    return dynamics, inputs


class LinearPlant:
    """Eq. 14 with C = I. Wind is a force through the drag, held constant (exactly sampled)."""

    def __init__(self, wind_ned_mps: Array, thrust_loss: float = 0.0) -> None:
        self._dynamics, self._inputs = paper_model()
        self._thrust = _Thrust(thrust_loss)
        self._drift = _sampled_wind(wind_ned_mps)

    def following(self, state: Array, inputs: Array) -> Array:
        """x(k+1) (12,) from x(k) and u(k) (4,)."""
        held = self._thrust.actual(inputs)
        following: Array = self._dynamics @ state + self._inputs @ held + self._drift
        return following


class NonlinearPlant:
    """Eq. 7 integrated by RK4 in ten substeps; the total thrust never pushes down."""

    def __init__(self, wind_ned_mps: Array, thrust_loss: float = 0.0) -> None:
        vehicle = paper_vehicle()
        self._hover = hover_input(vehicle)
        self._parameters = pack(vehicle)
        self._wind = np.array(wind_ned_mps, np.float64)
        self._thrust = _Thrust(thrust_loss)
        self._scratch = np.empty((RK4_SCRATCH_ROWS, EULER.size))

    def following(self, state: Array, inputs: Array) -> Array:
        total = self._hover + self._thrust.actual(inputs)
        total[THRUST] = max(total[THRUST], 0.0)
        out = state.copy()
        step_s = PAPER_STEP_S / _SUBSTEPS
        constants = self._wind, self._parameters, step_s, _SUBSTEPS
        follow(out, total, *constants, self._scratch)
        return out


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
    """`steps` RK4 steps of held inputs and wind, in place; shapes as in `rk4_into`."""
    for _ in range(steps):
        rk4_into(derivative_into, state, inputs, wind_ned, parameters, step_s, scratch, state)


PLANTS: dict[PlantKind, type[LinearPlant | NonlinearPlant]] = {
    PlantKind.LINEAR: LinearPlant,
    PlantKind.NONLINEAR: NonlinearPlant,
}


class _Thrust:
    """Rotors that give a fraction less than asked, of the total and not of the deviation."""

    def __init__(self, loss: float) -> None:
        self._loss = loss
        self._weight_n = float(hover_input(paper_vehicle())[THRUST])

    def actual(self, inputs: Array) -> Array:
        held = inputs.copy()
        held[THRUST] -= self._loss * (self._weight_n + held[THRUST])
        return held


def _sampled_wind(wind_ned_mps: Array) -> Array:
    """What a constant wind adds to x(k+1), (12,)."""
    vehicle = paper_vehicle()
    dynamics, _ = hover_matrices(vehicle)
    size = len(dynamics)
    force = np.zeros(size)
    drag = np.array(vehicle.drag_translation_npmps) / vehicle.mass_kg
    force[U : W + 1] = drag * wind_ned_mps
    whole = np.zeros((size + 1, size + 1))
    whole[:size, :size], whole[:size, size] = dynamics, force
    drift: Array = expm(PAPER_STEP_S * whole)[:size, size]
    return drift
