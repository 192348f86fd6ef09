"""The local end of a search: sequential quadratic steps on all inputs of a plan.

The slope of the roll-outs and the curvature of the linear problem give a quadratic; volumes enter
as what they are, half-spaces that may be entered at a price per metre and square metre (a slack
each), so that a step ends on their surface and not beside it. Each step is searched along on the
roll-outs themselves: what is not better is not taken.
"""

from __future__ import annotations

from enum import Enum

import daqp
import numpy as np
from numpy.typing import NDArray

from offboard.control.horizon.roll_out import CURVATURE, SLOPE
from offboard.control.horizon.search import Evaluator, Plan, Remaining, sequences

Array = NDArray[np.float64]

DIFFERENCE = 1e-6  # for slopes, towards the middle of the bounds
STRIDES = 2.0 ** -np.arange(0.0, 12.0)
NEAR_M = 0.3  # what is further outside than this is not met in one step
ENOUGH = 1e-4  # of the cost: a step that promises less is not worth taking
ENDLESS = 1e30  # daqp's infinity


class Ended(Enum):
    """Why a polish went no further."""

    SETTLED = "what is left to gain is nothing"
    STUCK = "no stride along the step is better"
    SPENT = "all steps were taken"
    LATE = "time ran out"


def polish(
    evaluate: Evaluator, plan: Plan, hessian: Array, most: int, remaining_s: Remaining
) -> tuple[Plan, Ended]:
    """At most `most` steps from `plan`, with the curvature (3 N, 3 N) of the linear problem."""
    lower, upper = evaluate.lower.T.ravel(), evaluate.upper.T.ravel()
    for _ in range(most):
        if remaining_s is not None and remaining_s() <= 0:
            return plan, Ended.LATE
        here = plan.inputs.T.ravel()
        slope, depths, steepness = _slopes(evaluate, here, upper)
        step, gain = _step(
            hessian, slope, depths, steepness, (lower - here, upper - here), evaluate.hold_s
        )
        if gain <= ENOUGH * abs(plan.cost):
            return plan, Ended.SETTLED
        tried = np.clip(here[:, None] + STRIDES * step[:, None], lower[:, None], upper[:, None])
        costs = evaluate.of_inputs(sequences(tried))
        first = int(np.argmin(costs))
        if not costs[first] < plan.cost:
            return plan, Ended.STUCK
        plan = evaluate.picked(len(STRIDES), first)
    return plan, Ended.SPENT


def _slopes(evaluate: Evaluator, here: Array, upper: Array) -> tuple[Array, Array, Array]:
    """Of the cost without the volumes (n,); depths (m,) within what is near of them, and their
    slopes (m, n)."""
    size = len(here)
    inward = np.where(here + DIFFERENCE <= upper, DIFFERENCE, -DIFFERENCE)
    probes = np.repeat(here[:, None], size + 1, axis=1)
    probes[np.arange(size), np.arange(size)] += inward
    costs = evaluate.of_inputs(sequences(probes))
    depths = evaluate.depths(size + 1)
    over = np.maximum(depths, 0.0)
    smooth = costs - 0.5 * evaluate.hold_s * (over * (SLOPE + CURVATURE * over)).sum(axis=0)
    slope = (smooth[:size] - smooth[size]) / inward
    near = depths[depths[:, size] > -NEAR_M]
    steepness = (near[:, :size] - near[:, size:]) / inward
    return slope, near[:, size].copy(), steepness


def _step(
    hessian: Array,
    slope: Array,
    depths: Array,
    steepness: Array,
    box: tuple[Array, Array],
    hold_s: float,
) -> tuple[Array, float]:
    """The minimiser (n,) of the quadratic within its box, a slack for each depth; and by how much
    it is lower there than here."""
    size, count = len(slope), len(depths)
    curvature = np.zeros((size + count, size + count))
    curvature[:size, :size] = hessian
    slacks = np.arange(size, size + count)
    curvature[slacks, slacks] = hold_s * CURVATURE
    gradient = np.concatenate((slope, np.full(count, 0.5 * hold_s * SLOPE)))
    rows = np.hstack((-steepness, np.eye(count)))
    least = np.concatenate((box[0], np.zeros(count), depths))
    most = np.concatenate((box[1], np.full(2 * count, ENDLESS)))
    free = np.zeros(len(least), np.int32)
    found, lowest, status, _ = daqp.solve(curvature, gradient, rows, most, least, free)
    if status < 1 or not np.isfinite(found).all():
        return np.zeros(size), 0.0
    here = np.concatenate((np.zeros(size), np.maximum(depths, 0.0)))
    return found[:size], float(0.5 * here @ curvature @ here + gradient @ here - lowest)
