"""The plants of the paper: its linear model (Eq. 14) and the nonlinear one (Eq. 7).

Inputs are deviations from hover, held for one step of 0.1 s.
"""

from __future__ import annotations

from enum import StrEnum
from functools import cache

import numpy as np
from numpy.typing import NDArray

from offboard.compiled import array, entry
from offboard.documents import shipped
from offboard.documents.reading import parse
from offboard.model.axes import LinearModel
from offboard.model.rigid_body import (
    EULER,
    RK4_SCRATCH_ROWS,
    THRUST,
    U,
    W,
    derivative_into,
    hover_input,
    hover_matrices,
    pack,
    rk4_into,
    sampled_matrices,
)
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
    """Table 1 and the arm that Eq. 16 requires: the shipped vehicle file `paper`."""
    file = shipped.directory() / "vehicles" / "paper.yaml"
    return parse(file.read_text(encoding="utf-8"), Vehicle, str(file))


@cache
def paper_model() -> tuple[Array, Array]:
    """A_d (12, 12) and B_d (12, 4) of Eq. 14, sampled with the 0.1 s that Eq. 16 is sampled with.

    All callers share the arrays, which are read-only.
    """
    dynamics, inputs = sampled_matrices(paper_vehicle(), PAPER_STEP_S)
    dynamics.flags.writeable = inputs.flags.writeable = False
    return dynamics, inputs


class LinearPlant:
    """Eq. 14 with C = I. A constant wind acts as a force through the drag, sampled exactly.

    Args:
        wind_ned_mps: wind velocity (3,).
        thrust_loss: missing fraction of the total thrust, 0 to 1.
    """

    def __init__(self, wind_ned_mps: Array, thrust_loss: float = 0.0) -> None:
        self._dynamics, self._inputs = paper_model()
        self._thrust_loss = thrust_loss
        self._wind_effect = _sampled_wind(wind_ned_mps)

    def next_state(self, state: Array, inputs: Array) -> Array:
        """x(k+1) (12,) from x(k) (12,) and u(k) (4,)."""
        delivered = _delivered(inputs, self._thrust_loss)
        following: Array = self._dynamics @ state + self._inputs @ delivered + self._wind_effect
        return following


class NonlinearPlant:
    """Eq. 7, integrated by RK4 in ten substeps; the total thrust is never negative.

    Arguments and `next_state` as for `LinearPlant`; velocities u, v, w are in body axes.
    """

    def __init__(self, wind_ned_mps: Array, thrust_loss: float = 0.0) -> None:
        vehicle = paper_vehicle()
        self._hover = hover_input(vehicle)
        self._parameters = pack(vehicle)
        self._wind = np.array(wind_ned_mps, np.float64)
        self._thrust_loss = thrust_loss
        self._scratch = np.empty((RK4_SCRATCH_ROWS, EULER.size))

    def next_state(self, state: Array, inputs: Array) -> Array:
        """x(k+1) (12,) from x(k) (12,) and u(k) (4,)."""
        total = self._hover + _delivered(inputs, self._thrust_loss)
        total[THRUST] = max(total[THRUST], 0.0)
        following = state.copy()
        constants = self._wind, self._parameters, PAPER_STEP_S / _SUBSTEPS, _SUBSTEPS
        follow(following, total, *constants, self._scratch)
        return following


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


def _delivered(inputs: Array, thrust_loss: float) -> Array:
    """Inputs (4,) that the rotors deliver: a fraction of the total thrust is missing."""
    delivered = inputs.copy()
    delivered[THRUST] -= thrust_loss * (hover_input(paper_vehicle())[THRUST] + inputs[THRUST])
    return delivered


def _sampled_wind(wind_ned_mps: Array) -> Array:
    """The term that a constant wind adds to x(k+1) (12,)."""
    vehicle = paper_vehicle()
    dynamics, _ = hover_matrices(vehicle)
    force = np.zeros((len(dynamics), 1))
    drag = np.array(vehicle.drag_translation_npmps) / vehicle.mass_kg
    force[U : W + 1, 0] = drag * wind_ned_mps
    return LinearModel(dynamics, force).sampled(PAPER_STEP_S).input_map[:, 0]
