"""The local end of a search: sequential quadratic steps on all inputs of a plan (Gauss and Newton).

The roll-outs give the slope of the cost and how the states move with each input, which gives its
curvature. Limits and volumes enter as what they are, half-spaces that may be entered at a price
per unit and per square of it (a slack each), so that a step ends on their surface and not beside
it. Each step is searched along on the roll-outs themselves: what is not better is not taken.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

import daqp
import numpy as np
from numpy.typing import NDArray

from offboard.control.horizon.limits import CURVATURE, SLOPE
from offboard.control.horizon.plant import INPUTS, B, F, P, R, V, W, Z
from offboard.control.horizon.search import Evaluator, Plan, Remaining, sequences

Array = NDArray[np.float64]

DIFFERENCE = 1e-6  # for slopes, towards the middle of the bounds
STRIDES = 2.0 ** -np.arange(0.0, 12.0)
TRUSTED, LEAST_TRUSTED = 0.5, 1e-2  # of the bounds: how far the first step may go, and the last
NEAR = 0.3  # metres and the like: a limit further off is not met in one step
ENOUGH = 1e-4  # of the cost: a step that promises less is not worth taking
DAMPING = 1e-6  # of the curvature's trace: inputs that nothing depends on
ENDLESS = 1e30  # daqp's infinity


class Ended(Enum):
    """Why a polish went no further."""

    SETTLED = "what is left to gain is nothing"
    STUCK = "no stride along the step is better"
    SPENT = "all steps were taken"
    LATE = "time ran out"


def polish(
    evaluate: Evaluator, plan: Plan, most: int, remaining_s: Remaining
) -> tuple[Plan, Ended]:
    """At most `most` steps from `plan`, each within a share of the bounds: less of them where the
    last step was no good, more where all of it was."""
    lower, upper = evaluate.lower.T.ravel(), evaluate.upper.T.ravel()
    width, local = TRUSTED, None
    for _ in range(most):
        if remaining_s is not None and remaining_s() <= 0:
            return plan, Ended.LATE
        here = plan.inputs.T.ravel()
        local = local or _local(evaluate, here, upper)
        room = width * (upper - lower)
        step, gain = _step(local, np.maximum(lower - here, -room), np.minimum(upper - here, room))
        if gain <= ENOUGH * abs(plan.cost):
            return plan, Ended.SETTLED
        tried = np.clip(here[:, None] + STRIDES * step[:, None], lower[:, None], upper[:, None])
        costs = evaluate.of_inputs(sequences(tried))
        first = int(np.argmin(costs))
        if costs[first] < plan.cost:
            plan, local = evaluate.picked(len(STRIDES), first), None
        elif width < LEAST_TRUSTED:
            return plan, Ended.STUCK
        width = min(1.0, 2.0 * width) if first == 0 else max(STRIDES[first], 0.1) * width
    return plan, Ended.SPENT


@dataclass(frozen=True, slots=True)
class _Local:
    """About a plan: curvature (n, n) and slope (n,) of the cost without its limits; of the m
    limits that are near, the excess (m,), its slope (m, n), and for how long it is paid (m,)."""

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
    states, over = evaluate.rolled(size + 1)
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
    """(n, n) of the cost of states that move as (N + 1, STATE_SIZE, n) with the n inputs."""
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
    """The minimiser (n,) of the quadratic within its box, a slack for each limit; and by how much
    it is lower there than here."""
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
