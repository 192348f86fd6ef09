"""Local optimisation of a plan: sequential quadratic programming on all its inputs (Gauss-Newton).

The roll-outs give the gradient of the cost and the derivatives of the states by each input, from
which the curvature follows. Each limit and volume is a half-space with a slack variable and the
penalty of `roll_out`, so that a step ends on its surface. A line search on the roll-outs takes a
step only where it lowers the cost.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

import daqp
import numpy as np
from numpy.typing import NDArray

from offboard.control.horizon.plant import INPUTS, B, F, P, R, V, W, Z
from offboard.control.horizon.roll_out import CURVATURE, SLOPE
from offboard.control.horizon.search import Evaluator, Plan, Remaining, sequences

Array = NDArray[np.float64]

MOST_POLISH_STEPS = 8  # by then the gain is negligible, or the time is over
DIFFERENCE = 1e-6  # of the finite differences, towards the middle of the bounds
STRIDES = 2.0 ** -np.arange(0.0, 12.0)
TRUSTED, LEAST_TRUSTED = 0.5, 1e-2  # trust region as a fraction of the bounds: first and least
NEAR = 0.3  # m, m/s: a limit further away is not reached in one step
ENOUGH = 1e-4  # of the cost: least predicted gain of a step
DAMPING = 1e-6  # added to the curvature, for inputs that nothing depends on
ENDLESS = 1e30  # infinity for daqp


class Ended(Enum):
    """Why `polish` ended."""

    CONVERGED = "the predicted gain is negligible"
    STUCK = "no part of the step lowers the cost"
    SPENT = "all steps were taken"
    LATE = "no time is left"


def polish(evaluate: Evaluator, plan: Plan, remaining_s: Remaining) -> tuple[Plan, Ended]:
    """Take at most MOST_POLISH_STEPS steps from `plan`. The trust region shrinks where only a part
    of a step lowers the cost, and grows where the whole step does."""
    lower, upper = evaluate.lower.T.ravel(), evaluate.upper.T.ravel()
    width, local = TRUSTED, None
    for _ in range(MOST_POLISH_STEPS):
        if remaining_s is not None and remaining_s() <= 0:
            return plan, Ended.LATE
        here = plan.inputs.T.ravel()
        local = local or _local(evaluate, here, upper)
        room = width * (upper - lower)
        step, gain = _step(local, np.maximum(lower - here, -room), np.minimum(upper - here, room))
        if gain <= ENOUGH * abs(plan.cost):
            return plan, Ended.CONVERGED
        tried = np.clip(here[:, None] + STRIDES * step[:, None], lower[:, None], upper[:, None])
        costs = evaluate.of_inputs(sequences(tried))
        first = int(np.argmin(costs))
        if costs[first] < plan.cost:
            plan, local = evaluate.plan(len(STRIDES), first), None
        elif width < LEAST_TRUSTED:
            return plan, Ended.STUCK
        width = min(1.0, 2.0 * width) if first == 0 else max(STRIDES[first], 0.1) * width
    return plan, Ended.SPENT


@dataclass(frozen=True, slots=True)
class _Local:
    """The problem about a plan: curvature (n, n) and slope (n,) of the cost without penalties; for
    each of the m limits nearby the excess (m,), its slope (m, n) and the seconds for which it is
    penalised (m,)."""

    curvature: Array
    slope: Array
    over: Array
    steepness: Array
    shares: Array


def _local(evaluate: Evaluator, here: Array, upper: Array) -> _Local:
    size = len(here)
    inward = np.where(here + DIFFERENCE <= upper, DIFFERENCE, -DIFFERENCE)
    probes = np.repeat(here[:, None], size + 1, axis=1)
    probes[np.arange(size), np.arange(size)] += inward
    costs = evaluate.of_inputs(sequences(probes))
    states, over = evaluate.last_states(size + 1)
    shares = evaluate.shares()
    paid = np.maximum(over, 0.0)
    smooth = costs - shares @ (paid * (SLOPE + CURVATURE * paid))
    near = over[:, size] > -NEAR
    return _Local(
        curvature=_curvature(evaluate.plant, (states[:, :, :size] - states[:, :, size:]) / inward),
        slope=(smooth[:size] - smooth[size]) / inward,
        over=over[near, size],
        steepness=(over[near, :size] - over[near, size:]) / inward,
        shares=shares[near],
    )


def _curvature(plant: NDArray[np.void], moved: Array) -> Array:
    """Curvature (n, n) of the cost; `moved` (N + 1, STATE_SIZE, n) is the derivative of the states
    by the n inputs."""
    steps, size = len(moved) - 1, moved.shape[2]
    held = np.eye(size).reshape(INPUTS, steps, size)
    total = DAMPING * np.eye(size)
    for axis, rows, model in (
        (0, (P, V, B, R), "lateral"),
        (1, (P + 1, V + 1, B + 1, R + 1), "lateral"),
        (2, (Z, W, F), "vertical"),
    ):
        stage, terminal = plant[f"{model}_stage"][0], plant[f"{model}_terminal"][0]
        both = np.concatenate((moved[:-1, rows], held[axis][:, None]), axis=1)
        total += both.reshape(-1, size).T @ (stage @ both).reshape(-1, size)
        last = moved[-1, rows]
        total += last.T @ terminal @ last
    return 2.0 * total


def _step(local: _Local, lower: Array, upper: Array) -> tuple[Array, float]:
    """The step (n,) to the minimum of the quadratic with a slack variable for each limit, and the
    predicted gain."""
    size, count = len(local.slope), len(local.over)
    curvature = np.zeros((size + count, size + count))
    curvature[:size, :size] = local.curvature
    slacks = np.arange(size, size + count)
    curvature[slacks, slacks] = 2.0 * local.shares * CURVATURE
    gradient = np.concatenate((local.slope, local.shares * SLOPE))
    rows = np.hstack((-local.steepness, np.eye(count)))
    least = np.concatenate((lower, np.zeros(count), local.over))
    most = np.concatenate((upper, np.full(2 * count, ENDLESS)))
    free = np.zeros(len(least), np.int32)
    found, lowest, status, _ = daqp.solve(curvature, gradient, rows, most, least, free)
    if status < 1 or not np.isfinite(found).all():
        return np.zeros(size), 0.0
    here = np.concatenate((np.zeros(size), np.maximum(local.over, 0.0)))
    return found[:size], float(0.5 * here @ curvature @ here + gradient @ here - lowest)
