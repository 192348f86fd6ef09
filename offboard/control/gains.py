"""Gains of the tracking law: linear-quadratic regulators of its axes, by python-control.

Each axis (`offboard.model.axes`) is sampled with a zero-order hold (`control.c2d`); its gain
minimises the sum of x' Q x + R u^2 over all decisions (`control.dlqr`). This module knows no
reference, no measurement and no search.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from offboard.model.axes import LinearModel, lateral_model, vertical_model
from offboard.model.vehicle import Vehicle

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class CostToGo:
    """One sampled axis, its gain, and the cost of one held input including the cost-to-go.

    J(u; x) = T x_0^2 + effort u^2 + x(k+1)' P x(k+1) = 1/2 curvature (u + K x)^2 + x' P x
    in deviations from the reference, for a period T; P solves the Riccati equation.
    `transition` is A (n, n), `input_map` B (n, 1), `terminal` P (n, n), `gain` K (n,).
    """

    transition: Array
    input_map: Array
    effort: float
    terminal: Array
    curvature: float
    gain: Array


def lateral_gain(vehicle: Vehicle, bandwidth_radps: float, period_s: float) -> CostToGo:
    """Return a lateral axis with weights 1 on position and g^2 / wc^4 on b_c, for a bandwidth
    wc."""
    effort = vehicle.gravity_mps2**2 / bandwidth_radps**4
    return _regulator(lateral_model(vehicle), effort, period_s)


def vertical_gain(vehicle: Vehicle, bandwidth_radps: float, period_s: float) -> CostToGo:
    """Return the vertical axis with weights 1 on height and 1 / wc^4 on the vertical thrust."""
    return _regulator(vertical_model(vehicle), bandwidth_radps**-4, period_s)


def _regulator(model: LinearModel, effort: float, period_s: float) -> CostToGo:
    """Return the axis with weights 1 on the first state and `effort` on the input, per second."""
    return _solved(model.dynamics.tobytes(), model.input_map.tobytes(), effort, period_s)


# Designing a gain takes 5 ms. A take-over and each search for the supported bandwidth need the same
# few gains again. They were computed on the ground, and delays do not change them
@lru_cache(maxsize=256)
def _solved(dynamics: bytes, input_map: bytes, effort: float, period_s: float) -> CostToGo:
    inputs = np.frombuffer(input_map)
    states = len(inputs)
    model = LinearModel(np.frombuffer(dynamics).reshape(states, states), inputs.reshape(states, 1))
    held = model.sampled(period_s)
    a, b = held.dynamics, held.input_map
    q, r = np.zeros_like(a), np.array([[period_s * effort]])
    q[0, 0] = period_s
    import control  # takes a second: imported only to design a gain

    gain, terminal, _ = control.dlqr(a, b, q, r)
    return CostToGo(
        transition=a,
        input_map=b,
        effort=period_s * effort,
        terminal=terminal,
        curvature=2.0 * float((r + b.T @ terminal @ b)[0, 0]),
        gain=gain[0],
    )


def hold_ripple(axis: LinearModel, period_s: float) -> Array:
    """Return the difference between the response to held inputs and that to the ramp u = t, at the
    times when the held input changes. It has all states except position and velocity: [b, b'] of a
    lateral axis, [T b_z] of the vertical one.

    The held inputs equal the ramp in the middle of each hold. A sampled law decides exactly when
    its input changes: without this difference in its target it would try to remove the ripple of
    its own hold, which no held input can.
    """
    model = LinearModel(axis.dynamics[2:, 2:], axis.input_map[2:])
    held = model.sampled(period_s)
    # The response to the ramp is slope t + smooth, that to held inputs slope t + stepped
    slope = -np.linalg.solve(model.dynamics, model.input_map[:, 0])
    smooth = np.linalg.solve(model.dynamics, slope)
    pushed = (0.5 * held.input_map[:, 0] - slope) * period_s
    stepped = np.linalg.solve(np.eye(len(pushed)) - held.dynamics, pushed)
    return np.asarray(stepped - smooth, np.float64)
