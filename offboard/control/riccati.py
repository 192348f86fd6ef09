"""The cost of one held input and of the optimal inputs after it: sampled costs, Riccati solutions.

The linear models of the axes (`offboard.model.axes`) are sampled with a zero-order hold. The
stabilising Riccati solution adds the cost of an infinite horizon. Knows no reference, no
measurement and no search.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import expm, solve_discrete_are

from offboard.model.axes import LinearModel, lateral_model, lead, vertical_model
from offboard.model.vehicle import AxisResponse, Vehicle

Array = NDArray[np.float64]

# The block exponential contains exp(-A t), which overflows for loops much faster than the hold;
# it is taken over period / 2**DOUBLINGS and doubled.
DOUBLINGS = 10


@dataclass(frozen=True, slots=True)
class CostToGo:
    """The sampled model of one axis and the optimal cost that follows one held input.

    J(u; x) = integral over the hold of (x' Q x + R u^2) + x(k+1)' P x(k+1)
            = 1/2 curvature u^2 + (coupling x) u + 1/2 x' state_cost x, minimal at u = -gain x,
    in deviations from the reference. transition (n, n), input_map (n, 1); stage (n + 1, n + 1):
    the cost of one hold is [x, u]' stage [x, u]; terminal P (n, n); coupling and gain (n,).
    """

    transition: Array
    input_map: Array
    stage: Array
    terminal: Array
    curvature: float
    coupling: Array
    state_cost: Array
    gain: Array


def sampled_cost_to_go(
    model: LinearModel, state_weight: Array, input_weight: float, period_s: float
) -> CostToGo:
    """Sample `model` and its stage cost, integrated over the hold (C. F. Van Loan, 1978), and add
    the stabilising solution of the discrete Riccati equation as the cost of all that follows.

    state_weight (n, n) and input_weight are the continuous weights of x' Q x + R u^2.
    """
    transition, stage = _sample_with_cost(model, state_weight, input_weight, period_s)
    size = len(model.dynamics)
    a, b = transition[:size, :size], transition[:size, size:]
    q, s, r = stage[:size, :size], stage[:size, size:], stage[size:, size:]
    terminal = cost_to_go(a, b, q, r, s)
    curvature = float((r + b.T @ terminal @ b)[0, 0])
    coupling = (b.T @ terminal @ a + s.T)[0]
    return CostToGo(
        transition=a,
        input_map=b,
        stage=stage,
        terminal=terminal,
        curvature=2.0 * curvature,
        coupling=2.0 * coupling,
        state_cost=2.0 * (q + a.T @ terminal @ a),
        gain=coupling / curvature,
    )


def _sample_with_cost(
    model: LinearModel, state_weight: Array, input_weight: float, period_s: float
) -> tuple[Array, Array]:
    """Transition and stage cost, both (n + 1, n + 1), of [x, u] with u held for `period_s`."""
    size = len(model.dynamics)
    flow = np.zeros((size + 1, size + 1))
    flow[:size, :size] = model.dynamics
    flow[:size, size:] = model.input_map
    weight = np.zeros_like(flow)
    weight[:size, :size] = state_weight
    weight[size, size] = input_weight
    step_s = period_s / 2**DOUBLINGS
    block = expm(np.block([[-flow.T, weight], [np.zeros_like(flow), flow]]) * step_s)
    transition: Array = block[size + 1 :, size + 1 :]
    stage: Array = transition.T @ block[: size + 1, size + 1 :]
    for _ in range(DOUBLINGS):
        stage = stage + transition.T @ stage @ transition
        transition = transition @ transition
    return transition, 0.5 * (stage + stage.T)


def lateral_cost_to_go(vehicle: Vehicle, bandwidth_radps: float, period_s: float) -> CostToGo:
    """Weights 1 on position and g^2 / wc^4 on b_c, for a bandwidth wc."""
    weight = np.diag([1.0, 0.0, 0.0, 0.0])
    effort = vehicle.gravity_mps2**2 / bandwidth_radps**4
    return sampled_cost_to_go(lateral_model(vehicle), weight, effort, period_s)


def vertical_cost_to_go(vehicle: Vehicle, bandwidth_radps: float, period_s: float) -> CostToGo:
    """Weights 1 on height and 1 / wc^4 on the vertical thrust."""
    weight = np.diag([1.0, 0.0, 0.0])
    return sampled_cost_to_go(vertical_model(vehicle), weight, bandwidth_radps**-4, period_s)


def tilt_ripple(vehicle: Vehicle, period_s: float) -> Array:
    """`hold_ripple` (2,) of [b, b'] for a slope of b_c of 1 per second."""
    whole = lateral_model(vehicle)
    return hold_ripple(LinearModel(whole.dynamics[2:, 2:], whole.input_map[2:]), period_s)


def thrust_ripple(vehicle: Vehicle, period_s: float) -> float:
    """`hold_ripple` of T b_z for a slope of f_c of 1 m/s^3."""
    whole = vertical_model(vehicle)
    return float(hold_ripple(LinearModel(whole.dynamics[2:, 2:], whole.input_map[2:]), period_s)[0])


def hold_ripple(model: LinearModel, period_s: float) -> Array:
    """How much the state (n,) of a stable model driven by held inputs differs from its response to
    the ramp u = t, at the times when the input changes.

    The held inputs equal the ramp in the middle of each hold. A sampled law decides exactly at
    these times: without this difference in its target it would try to remove the ripple of its own
    hold, which no held input can.
    """
    held = model.sampled(period_s)
    # Response to the ramp: slope t + smooth; to held inputs, when they change: slope t + stepped
    slope = -np.linalg.solve(model.dynamics, model.input_map[:, 0])
    smooth = np.linalg.solve(model.dynamics, slope)
    pushed = (0.5 * held.input_map[:, 0] - slope) * period_s
    stepped = np.linalg.solve(np.eye(len(pushed)) - held.dynamics, pushed)
    return np.asarray(stepped - smooth, np.float64)


def held_lead(
    value: Array, rate: Array, acceleration: Array, response: AxisResponse, period_s: float
) -> Array:
    """`axes.lead` in the middle of a hold, less the second-order difference between a curved
    command and its mean over the hold. Arguments and result have one common shape."""
    led: Array = lead(value, rate, acceleration, response) - period_s**2 / 24.0 * acceleration
    return led


def cost_to_go(
    dynamics: ArrayLike,
    inputs: ArrayLike,
    fitness: ArrayLike,
    energy: ArrayLike,
    cross: ArrayLike | None = None,
) -> Array:
    """The stabilising solution P (n, n) of the discrete Riccati equation; x'Px is the optimal cost
    from x on.

    x(k+1) = A x + B u with dynamics A (n, n) and inputs B (n, m); stage cost
    x'Qx + u'Ru + 2 x'Su with fitness Q, energy R, cross S (n, m). Raises numpy.linalg.LinAlgError
    where no stabilising solution exists.
    """
    s = None if cross is None else np.asarray(cross, np.float64)
    solution: Array = solve_discrete_are(
        *(np.asarray(matrix, np.float64) for matrix in (dynamics, inputs, fitness, energy)), s=s
    )
    return 0.5 * (solution + solution.T)
