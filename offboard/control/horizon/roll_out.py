"""Roll-outs of the attitude interface over N holds, compiled: one plan per particle.

The motion is that of the tracking laws' linear model, sampled exactly, plus the nonlinear part of
thrust times direction, integrated over start, middle and end of each hold (Simpson). A plan of
zeros flies the reference exactly, and for small deviations cost and motion are those of the closed
form. Exceeding a soft limit (speed, tilt, the ground, keep-out volumes) is penalised. Structure of
arrays: the innermost loop runs over particles.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from offboard.compiled import array, entry, kernel
from offboard.control.horizon.keep_out import CENTRE, VELOCITY, distance
from offboard.control.horizon.plant import (
    INPUTS,
    PLANT,
    SCENE,
    STATE_SIZE,
    B,
    F,
    P,
    R,
    T,
    V,
    W,
    Z,
)
from offboard.model.axes import b_z_of

Array = NDArray[np.float64]

# Limits of a hold; every volume counts twice, at the middle and at the end
SPEED, TILT, FLOOR, VOLUME = range(4)

# Penalty of an exceeded limit per second: per metre (or m/s, or unit of b), and per its square
SLOPE, CURVATURE = 20.0, 200.0


@kernel
def _clip(value: float, low: float, high: float) -> float:
    return min(max(value, low), high)


@entry(
    PLANT, SCENE, array(2), array(2), array(2), float, array(2), array(3),
    array(3), array(3), array(1), array(1),
)  # fmt: skip
def roll_out(
    plants: Any,
    scenes: Any,
    volumes: Array,
    base_inputs: Array,
    base_states: Array,
    feedback: float,
    weights: Array,
    knots: Array,
    states: Array,
    inputs: Array,
    over: Array,
    costs: Array,
) -> None:
    """Compute costs (particles,), states (N + 1, STATE_SIZE, particles) and inputs
    (N, 3, particles) of plans; `over` (particles,) is scratch.

    The input of a step is base_inputs (N, 3) + weights (N, M) @ knots (M, 3, particles) +
    `feedback` times the closed form's answer to the deviation of the state from base_states
    (N + 1, STATE_SIZE), clipped to the bounds.
    """
    plant, scene = plants[0], scenes[0]
    for row in range(STATE_SIZE):
        states[0, row, :] = scene.start[row]
    costs[:] = 0.0
    for k in range(inputs.shape[0]):
        _choose(
            plant, scene.lower[k], scene.upper[k], base_inputs[k], base_states[k], feedback,
            weights[k], knots, states[k], inputs[k],
        )  # fmt: skip
        _hold(plant, states[k], inputs[k], states[k + 1], costs)
        _add_nonlinear_part(plant, scene, k, states[k], inputs[k], states[k + 1])
        for limit in range(limits_of(volumes)):
            if applies(plant, volumes, limit):
                exceed(plant, scene, volumes, k, limit, states[k], states[k + 1], over)
                penalise(plant.hold_s, limit, over, costs)
    _add_terminal_cost(plant, states[inputs.shape[0]], costs)


@kernel
def _add_terminal_cost(plant: Any, last: Array, costs: Array) -> None:
    """Add the cost-to-go of the last state."""
    q, s = plant.lateral_terminal, plant.vertical_terminal
    for n in range(costs.shape[0]):
        cost = costs[n]
        for axis in range(2):
            for i in range(4):
                for j in range(4):
                    cost += q[i, j] * last[2 * i + axis, n] * last[2 * j + axis, n]
        for i in range(3):
            for j in range(3):
                cost += s[i, j] * last[Z + i, n] * last[Z + j, n]
        costs[n] = cost if math.isfinite(cost) else math.inf  # a NaN would win an argmin


@kernel
def _choose(
    plant: Any,
    lower: Array,
    upper: Array,
    base_input: Array,
    base_state: Array,
    feedback: float,
    weights: Array,
    knots: Array,
    state: Array,
    chosen: Array,
) -> None:
    """The inputs of one step, (3, particles)."""
    particles = chosen.shape[1]
    gain, heave = plant.lateral_gain, plant.vertical_gain
    for axis in range(INPUTS):
        for n in range(particles):
            chosen[axis, n] = base_input[axis]
        for m in range(weights.shape[0]):
            weight = weights[m]
            if weight != 0.0:
                for n in range(particles):
                    chosen[axis, n] += weight * knots[m, axis, n]
    if feedback != 0.0:
        for n in range(particles):
            for axis in range(2):
                for i in range(4):
                    off = state[2 * i + axis, n] - base_state[2 * i + axis]
                    chosen[axis, n] -= feedback * gain[i] * off
            for i in range(3):
                chosen[2, n] -= feedback * heave[i] * (state[Z + i, n] - base_state[Z + i])
    for n in range(particles):
        for axis in range(INPUTS):
            chosen[axis, n] = _clip(chosen[axis, n], lower[axis], upper[axis])


@kernel
def _hold(plant: Any, before: Array, chosen: Array, after: Array, costs: Array) -> None:
    """One hold of every particle: its cost and the state after it, by the linear model."""
    a, b = plant.lateral_transition, plant.lateral_input
    q = plant.lateral_stage
    for axis in range(2):
        for n in range(chosen.shape[1]):
            p, v = before[P + axis, n], before[V + axis, n]
            d, r = before[B + axis, n], before[R + axis, n]
            u = chosen[axis, n]
            costs[n] += (
                p * (q[0, 0] * p + 2.0 * (q[0, 1] * v + q[0, 2] * d + q[0, 3] * r + q[0, 4] * u))
                + v * (q[1, 1] * v + 2.0 * (q[1, 2] * d + q[1, 3] * r + q[1, 4] * u))
                + d * (q[2, 2] * d + 2.0 * (q[2, 3] * r + q[2, 4] * u))
                + r * (q[3, 3] * r + 2.0 * q[3, 4] * u)
                + u * q[4, 4] * u
            )
            after[P + axis, n] = p + a[0, 1] * v + a[0, 2] * d + a[0, 3] * r + b[0] * u
            after[V + axis, n] = a[1, 1] * v + a[1, 2] * d + a[1, 3] * r + b[1] * u
            after[B + axis, n] = a[2, 2] * d + a[2, 3] * r + b[2] * u
            after[R + axis, n] = a[3, 2] * d + a[3, 3] * r + b[3] * u
    h, g, s = plant.vertical_transition, plant.vertical_input, plant.vertical_stage
    for n in range(chosen.shape[1]):
        z, w, f, u = before[Z, n], before[W, n], before[F, n], chosen[2, n]
        costs[n] += (
            z * (s[0, 0] * z + 2.0 * (s[0, 1] * w + s[0, 2] * f + s[0, 3] * u))
            + w * (s[1, 1] * w + 2.0 * (s[1, 2] * f + s[1, 3] * u))
            + f * (s[2, 2] * f + 2.0 * s[2, 3] * u)
            + u * s[3, 3] * u
        )
        after[Z, n] = z + h[0, 1] * w + h[0, 2] * f + g[0] * u
        after[W, n] = h[1, 1] * w + h[1, 2] * f + g[1] * u
        after[F, n] = h[2, 2] * f + g[2] * u
        after[T, n] = 0.0


@kernel
def _add_nonlinear_part(
    plant: Any, scene: Any, k: int, before: Array, chosen: Array, after: Array
) -> None:
    """Add the difference between T b and its linear model, at start, middle and end of a hold."""
    tilt = plant.tilt_half
    g, share = plant.gravity_mps2, scene.thrust_share
    ref = scene.directions[2 * k : 2 * k + 3]
    thrusts = scene.thrusts_tilt[2 * k : 2 * k + 3]
    heaves = scene.thrusts_heave[2 * k : 2 * k + 3]
    down = scene.b_z[2 * k : 2 * k + 3]
    led = scene.feedforward[k] / down[0]
    refs = (
        b_z_of(ref[0, 0], ref[0, 1]),
        b_z_of(ref[1, 0], ref[1, 1]),
        b_z_of(ref[2, 0], ref[2, 1]),
    )
    for n in range(chosen.shape[1]):
        f, w, t0 = before[F, n], chosen[2, n], before[T, n]
        # b north and east at the three nodes
        n0, e0 = before[B, n], before[B + 1, n]
        n1 = tilt[0, 0] * n0 + tilt[0, 1] * before[R, n] + tilt[0, 2] * chosen[0, n]
        e1 = tilt[0, 0] * e0 + tilt[0, 1] * before[R + 1, n] + tilt[0, 2] * chosen[1, n]
        n2, e2 = after[B, n], after[B + 1, n]
        d0 = b_z_of(ref[0, 0] + n0, ref[0, 1] + e0) - refs[0]
        d1 = b_z_of(ref[1, 0] + n1, ref[1, 1] + e1) - refs[1]
        d2 = b_z_of(ref[2, 0] + n2, ref[2, 1] + e2) - refs[2]
        asked = (scene.feedforward[k] + w) / max(down[0] + d0, 0.1)
        asked = _clip(asked, plant.thrust_least_mps2, plant.thrust_most_mps2) - led
        t1 = asked + (t0 - asked) * plant.lag_half
        t2 = asked + (t0 - asked) * plant.lag_full
        # residual accelerations: -(T b - T_r b_r) minus those of the linear model
        x0 = g * n0 - share * ((thrusts[0] + t0) * n0 + t0 * ref[0, 0])
        x1 = g * n1 - share * ((thrusts[1] + t1) * n1 + t1 * ref[1, 0])
        x2 = g * n2 - share * ((thrusts[2] + t2) * n2 + t2 * ref[2, 0])
        y0 = g * e0 - share * ((thrusts[0] + t0) * e0 + t0 * ref[0, 1])
        y1 = g * e1 - share * ((thrusts[1] + t1) * e1 + t1 * ref[1, 1])
        y2 = g * e2 - share * ((thrusts[2] + t2) * e2 + t2 * ref[2, 1])
        z0 = f - ((heaves[0] + t0) * d0 + t0 * down[0])
        z1 = w + (f - w) * plant.lag_half - ((heaves[1] + t1) * d1 + t1 * down[1])
        z2 = w + (f - w) * plant.lag_full - ((heaves[2] + t2) * d2 + t2 * down[2])
        after[P, n] += plant.push_p0 * x0 + plant.push_p1 * x1
        after[P + 1, n] += plant.push_p0 * y0 + plant.push_p1 * y1
        after[V, n] += plant.push_v0 * x0 + plant.push_v1 * x1 + plant.push_v2 * x2
        after[V + 1, n] += plant.push_v0 * y0 + plant.push_v1 * y1 + plant.push_v2 * y2
        after[Z, n] += plant.push_p0 * z0 + plant.push_p1 * z1
        after[W, n] += plant.push_v0 * z0 + plant.push_v1 * z1 + plant.push_v2 * z2
        after[T, n] = t2
        after[F, n] = (heaves[2] + t2) * d2 + t2 * down[2]


@kernel
def penalise(hold_s: float, limit: int, over: Array, costs: Array) -> None:
    """Add the penalties of one hold to costs (particles,), for exceeding a limit by `over`."""
    share = share_of(hold_s, limit)
    for n in range(costs.shape[0]):
        costs[n] += share * _excess(over[n])


@entry(PLANT, SCENE, array(2), array(3), array(2))
def excesses(plants: Any, scenes: Any, volumes: Array, states: Array, over: Array) -> None:
    """Compute by how much plans exceed each limit in each hold: over (N * limits, particles) of
    states (N + 1, STATE_SIZE, particles). Negative within a limit, -inf where it does not apply."""
    plant, scene = plants[0], scenes[0]
    count = limits_of(volumes)
    for k in range(states.shape[0] - 1):
        for limit in range(count):
            row = over[k * count + limit]
            row[:] = -math.inf
            if applies(plant, volumes, limit):
                exceed(plant, scene, volumes, k, limit, states[k], states[k + 1], row)


@kernel
def limits_of(volumes: Array) -> int:
    """Number of limits in each hold: speed, tilt, floor, and two for every volume."""
    return int(VOLUME + 2 * volumes.shape[0])


@kernel
def share_of(hold_s: float, limit: int) -> float:
    """The seconds of a hold for which an excess is penalised."""
    return float(hold_s * (0.5 if limit >= VOLUME else 1.0))


@kernel
def applies(plant: Any, volumes: Array, limit: int) -> bool:
    """Whether this limit applies to the plant and the situation."""
    if limit == SPEED:
        return bool(plant.speed_most_mps < math.inf)
    return bool(limit == TILT or volumes.shape[0] > 0)


@kernel
def exceed(
    plant: Any,
    scene: Any,
    volumes: Array,
    k: int,
    limit: int,
    before: Array,
    after: Array,
    over: Array,
) -> None:
    """Compute by how much hold k exceeds a limit, over (particles,)."""
    end = 2 * k + 2
    if limit == SPEED:
        v = scene.velocities[end]
        for n in range(over.shape[0]):
            north, east = v[0] + after[V, n], v[1] + after[V + 1, n]
            climb = v[2] + after[W, n]
            over[n] = math.sqrt(north * north + east * east + climb * climb) - plant.speed_most_mps
    elif limit == TILT:
        b = scene.directions[end]
        for n in range(over.shape[0]):
            north, east = b[0] + after[B, n], b[1] + after[B + 1, n]
            over[n] = math.sqrt(north * north + east * east) - plant.tilt_most
    elif limit == FLOOR:
        room = max(scene.floor_down_m - scene.positions[end, 2], 0.0)
        for n in range(over.shape[0]):
            over[n] = after[Z, n] - room
    else:
        volume, node = volumes[(limit - VOLUME) // 2], end - limit % 2
        _intrude(plant, scene, volume, node, before, after, over)


@kernel
def _intrude(
    plant: Any, scene: Any, volume: Array, node: int, before: Array, after: Array, over: Array
) -> None:
    """Compute how deep particles are in the clearance of a volume, in the middle or at the end of
    a hold."""
    hold = plant.hold_s
    centre_n = volume[CENTRE] + 0.5 * hold * node * volume[VELOCITY]
    centre_e = volume[CENTRE + 1] + 0.5 * hold * node * volume[VELOCITY + 1]
    centre_d = volume[CENTRE + 2] + 0.5 * hold * node * volume[VELOCITY + 2]
    at = scene.positions[node]
    bow = 0.125 * hold
    for n in range(over.shape[0]):
        if node % 2 == 0:
            x, y, z = after[P, n], after[P + 1, n], after[Z, n]
        else:  # the middle, from position and velocity at both ends
            x = 0.5 * (before[P, n] + after[P, n]) + bow * (before[V, n] - after[V, n])
            y = 0.5 * (before[P + 1, n] + after[P + 1, n])
            y += bow * (before[V + 1, n] - after[V + 1, n])
            z = 0.5 * (before[Z, n] + after[Z, n]) + bow * (before[W, n] - after[W, n])
        away = distance(volume, centre_n, centre_e, centre_d, at[0] + x, at[1] + y, at[2] + z)
        over[n] = plant.clearance_m - away


@kernel
def _excess(value: float) -> float:
    over = max(value, 0.0)
    return over * (SLOPE + CURVATURE * over)
