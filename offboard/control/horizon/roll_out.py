"""Roll-outs of the attitude interface over N holds, compiled: one plan per particle.

States and inputs are deviations from the reference (`Outlook`): the linear motion of the tracking
law's own model, sampled exactly, plus what thrust times direction adds beyond it, integrated over
start, middle and end of each hold (Simpson). A plan of zeros flies the reference exactly, and for
small deviations cost and motion are those of the closed form. Structure of arrays: the innermost
loop runs over particles. Nothing is drawn, nothing is remembered.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from offboard.control.horizon.keep_out import CENTRE, VELOCITY, distance
from offboard.control.horizon.outlook import Bounds, Outlook
from offboard.control.response import SHORTEST_THRUST_LAG_S, CostToGo
from offboard.model.vehicle import Vehicle

Array = NDArray[np.float64]

# Rows of a state: position, velocity, b, b' north and east in turn; height, climb, T b_z; T.
P, V, B, R, Z, W, F, T = 0, 2, 4, 6, 8, 9, 10, 11
STATE_SIZE = 12
INPUTS = 3

# What a violated limit costs a second: per metre (or m/s, or unit of b), and per its square.
SLOPE, CURVATURE = 20.0, 200.0


class Plant(NamedTuple):
    """Constants of one vehicle and period, all (n,) or (n, n) float arrays."""

    lateral: Array  # (4, 4) transition
    lateral_input: Array  # (4,)
    vertical: Array  # (3, 3)
    vertical_input: Array  # (3,)
    tilt_half: Array  # (2, 3) b and b' after half a hold, of [b, b', input]
    lateral_stage: Array  # (5, 5)
    vertical_stage: Array  # (4, 4)
    lateral_terminal: Array  # (4, 4)
    vertical_terminal: Array  # (3, 3)
    lateral_gain: Array  # (4,)
    vertical_gain: Array  # (3,)
    scalars: Array  # below


# Indices of `Plant.scalars`.
GRAVITY, HOLD, LAG_HALF, LAG_FULL, THRUST_LEAST, THRUST_MOST, TILT_MOST, SPEED_MOST = range(8)
PUSH_V0, PUSH_V1, PUSH_V2, PUSH_P0, PUSH_P1, NONLINEAR, CLEARANCE = range(8, 15)
SCALARS = 15


def plant_of(
    vehicle: Vehicle,
    lateral: CostToGo,
    vertical: CostToGo,
    period_s: float,
    *,
    half: CostToGo,
    nonlinear: bool,
    thrust_mps2: tuple[float, float],
    speed_limit_mps: float,
    clearance_m: float,
) -> Plant:
    """`half` is the lateral model sampled at half the period."""
    lag_s = max(vehicle.thrust_lag_s, SHORTEST_THRUST_LAG_S)
    drag = vehicle.drag_per_mass_ps

    def carried(after_s: float) -> float:
        """Of a push, what is left as position after a time in drag, per unit."""
        return -math.expm1(-drag * after_s) / drag if drag > 0 else after_s

    scalars = np.empty(SCALARS)
    scalars[GRAVITY], scalars[HOLD] = vehicle.gravity_mps2, period_s
    scalars[LAG_HALF] = math.exp(-0.5 * period_s / lag_s)
    scalars[LAG_FULL] = math.exp(-period_s / lag_s)
    scalars[THRUST_LEAST], scalars[THRUST_MOST] = thrust_mps2
    scalars[TILT_MOST] = math.sin(vehicle.tilt_max_rad)
    scalars[SPEED_MOST] = speed_limit_mps
    scalars[PUSH_V0] = period_s / 6.0 * math.exp(-drag * period_s)
    scalars[PUSH_V1] = period_s / 1.5 * math.exp(-0.5 * drag * period_s)
    scalars[PUSH_V2] = period_s / 6.0
    scalars[PUSH_P0] = period_s / 6.0 * carried(period_s)
    scalars[PUSH_P1] = period_s / 1.5 * carried(0.5 * period_s)
    scalars[NONLINEAR] = float(nonlinear)
    scalars[CLEARANCE] = clearance_m
    return Plant(
        *(np.ascontiguousarray(part) for part in (
            lateral.transition, lateral.input_map[:, 0],
            vertical.transition, vertical.input_map[:, 0],
            np.column_stack((half.transition[2:, 2:], half.input_map[2:, 0])),
            lateral.stage, vertical.stage, lateral.terminal, vertical.terminal,
            lateral.gain, vertical.gain, scalars,
        )),
    )  # fmt: skip


class Scene(NamedTuple):
    """What one decision is made in: the outlook, the bounds and the volumes, as arrays."""

    positions: Array  # (2 N + 1, 3)
    velocities: Array
    directions: Array
    thrusts_tilt: Array  # (2 N + 1,)
    thrusts_heave: Array
    uprights: Array
    feedforward: Array  # (N,): of the vertical thrust
    lower: Array  # (N, 3)
    upper: Array
    volumes: Array  # (V, PACKED_SIZE), where they are at the first node
    thrust_share: float  # of the thrust believed, what is there, by the vertical disturbance
    floor_down_m: float  # no way round a volume leads below, where the reference does not


def scene_of(outlook: Outlook, within: Bounds, volumes: Array, floor_down_m: float) -> Scene:
    return Scene(
        outlook.positions_ned_m,
        outlook.velocities_ned_mps,
        outlook.directions_ned,
        outlook.thrusts_tilt_mps2,
        outlook.thrusts_heave_mps2,
        outlook.uprights_heave,
        np.ascontiguousarray(outlook.feedforward[:, 2]),
        within.lower,
        within.upper,
        volumes,
        outlook.thrust_share,
        floor_down_m,
    )


def start_state(lateral: Array, vertical: Array, scene: Scene) -> Array:
    """(STATE_SIZE,) of the deviations lateral (4, 2) and vertical (3,) of `tracking.errors`."""
    start = np.empty(STATE_SIZE)
    start[P:Z] = lateral.reshape(-1)
    start[Z:T] = vertical
    b_n, b_e = scene.directions[0, :2]
    leant = _upright(b_n + start[B], b_e + start[B + 1]) - _upright(b_n, b_e)
    force = scene.thrusts_heave[0] * scene.uprights[0] + start[F]
    start[T] = force / (scene.uprights[0] + leant) - scene.thrusts_heave[0]
    return start


@numba.njit(cache=True)
def _upright(north: float, east: float) -> float:
    return math.sqrt(max(1.0 - north * north - east * east, 0.01))


@numba.njit(cache=True)
def _excess(value: float) -> float:
    over = max(value, 0.0)
    return over * (SLOPE + CURVATURE * over)


@numba.njit(cache=True)
def _clip(value: float, low: float, high: float) -> float:
    return min(max(value, low), high)


@numba.njit(cache=True)
def roll_out(  # type: ignore[no-untyped-def]
    plant, scene, start, base_inputs, base_states, feedback, weights, knots, states, inputs, costs
) -> None:
    """Costs (particles,) of plans, and their states (N + 1, STATE_SIZE, particles) and inputs
    (N, 3, particles).

    Input of a step = base_inputs (N, 3) + `feedback` times the closed form's answer to how far the
    state is from base_states (N + 1, STATE_SIZE) + weights (N, M) @ knots (M, 3, particles),
    clipped to the bounds.
    """
    steps = scene.lower.shape[0]
    particles = costs.shape[0]
    for row in range(STATE_SIZE):
        states[0, row, :] = start[row]
    costs[:] = 0.0
    for k in range(steps):
        _choose(
            plant, scene.lower[k], scene.upper[k], base_inputs[k], base_states[k], feedback,
            weights[k], knots, states[k], inputs[k],
        )  # fmt: skip
        _hold(plant, scene, k, states[k], inputs[k], states[k + 1], costs)
        _penalise(plant, scene, k, states[k], states[k + 1], costs)
    q, s = plant.lateral_terminal, plant.vertical_terminal
    last = states[steps]
    for axis in range(2):
        for i in range(4):
            for j in range(4):
                weight = q[i, j]
                for n in range(particles):
                    costs[n] += weight * last[2 * i + axis, n] * last[2 * j + axis, n]
    for i in range(3):
        for j in range(3):
            for n in range(particles):
                costs[n] += s[i, j] * last[Z + i, n] * last[Z + j, n]


@numba.njit(cache=True)
def _choose(  # type: ignore[no-untyped-def]
    plant, lower, upper, base_input, base_state, feedback, weights, knots, state, chosen
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
        for axis in range(2):
            for i in range(4):
                factor = feedback * gain[i]
                at = base_state[2 * i + axis]
                for n in range(particles):
                    chosen[axis, n] -= factor * (state[2 * i + axis, n] - at)
        for i in range(3):
            factor = feedback * heave[i]
            at = base_state[Z + i]
            for n in range(particles):
                chosen[2, n] -= factor * (state[Z + i, n] - at)
    for axis in range(INPUTS):
        for n in range(particles):
            chosen[axis, n] = _clip(chosen[axis, n], lower[axis], upper[axis])


@numba.njit(cache=True)
def _hold(plant, scene, k, before, chosen, after, costs) -> None:  # type: ignore[no-untyped-def]
    """One hold of every particle: its cost, then where it leads."""
    c = plant.scalars
    a, b = plant.lateral, plant.lateral_input
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
    h, g, s = plant.vertical, plant.vertical_input, plant.vertical_stage
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
    if c[NONLINEAR] != 0.0:
        _bend(plant, scene, k, before, chosen, after)


@numba.njit(cache=True)
def _bend(plant, scene, k, before, chosen, after) -> None:  # type: ignore[no-untyped-def]
    """Add what T b does beyond the linear model: at start, middle and end of the hold."""
    c, tilt = plant.scalars, plant.tilt_half
    g, share = c[GRAVITY], scene.thrust_share
    ref = scene.directions[2 * k : 2 * k + 3]
    thrusts = scene.thrusts_tilt[2 * k : 2 * k + 3]
    heaves = scene.thrusts_heave[2 * k : 2 * k + 3]
    uprights = scene.uprights[2 * k : 2 * k + 3]
    led = scene.feedforward[k] / uprights[0]
    refs = (
        _upright(ref[0, 0], ref[0, 1]),
        _upright(ref[1, 0], ref[1, 1]),
        _upright(ref[2, 0], ref[2, 1]),
    )
    for n in range(chosen.shape[1]):
        f, w, t0 = before[F, n], chosen[2, n], before[T, n]
        # b north and east at the three nodes
        n0, e0 = before[B, n], before[B + 1, n]
        n1 = tilt[0, 0] * n0 + tilt[0, 1] * before[R, n] + tilt[0, 2] * chosen[0, n]
        e1 = tilt[0, 0] * e0 + tilt[0, 1] * before[R + 1, n] + tilt[0, 2] * chosen[1, n]
        n2, e2 = after[B, n], after[B + 1, n]
        d0 = _upright(ref[0, 0] + n0, ref[0, 1] + e0) - refs[0]
        d1 = _upright(ref[1, 0] + n1, ref[1, 1] + e1) - refs[1]
        d2 = _upright(ref[2, 0] + n2, ref[2, 1] + e2) - refs[2]
        asked = (scene.feedforward[k] + w) / max(uprights[0] + d0, 0.1)
        asked = _clip(asked, c[THRUST_LEAST], c[THRUST_MOST]) - led
        t1 = asked + (t0 - asked) * c[LAG_HALF]
        t2 = asked + (t0 - asked) * c[LAG_FULL]
        # residual accelerations: -(T b - T_r b_r), less the linear model's
        x0 = g * n0 - share * ((thrusts[0] + t0) * n0 + t0 * ref[0, 0])
        x1 = g * n1 - share * ((thrusts[1] + t1) * n1 + t1 * ref[1, 0])
        x2 = g * n2 - share * ((thrusts[2] + t2) * n2 + t2 * ref[2, 0])
        y0 = g * e0 - share * ((thrusts[0] + t0) * e0 + t0 * ref[0, 1])
        y1 = g * e1 - share * ((thrusts[1] + t1) * e1 + t1 * ref[1, 1])
        y2 = g * e2 - share * ((thrusts[2] + t2) * e2 + t2 * ref[2, 1])
        z0 = f - ((heaves[0] + t0) * d0 + t0 * uprights[0])
        z1 = w + (f - w) * c[LAG_HALF] - ((heaves[1] + t1) * d1 + t1 * uprights[1])
        z2 = w + (f - w) * c[LAG_FULL] - ((heaves[2] + t2) * d2 + t2 * uprights[2])
        after[P, n] += c[PUSH_P0] * x0 + c[PUSH_P1] * x1
        after[P + 1, n] += c[PUSH_P0] * y0 + c[PUSH_P1] * y1
        after[V, n] += c[PUSH_V0] * x0 + c[PUSH_V1] * x1 + c[PUSH_V2] * x2
        after[V + 1, n] += c[PUSH_V0] * y0 + c[PUSH_V1] * y1 + c[PUSH_V2] * y2
        after[Z, n] += c[PUSH_P0] * z0 + c[PUSH_P1] * z1
        after[W, n] += c[PUSH_V0] * z0 + c[PUSH_V1] * z1 + c[PUSH_V2] * z2
        after[T, n] = t2
        after[F, n] = (heaves[2] + t2) * d2 + t2 * uprights[2]


@numba.njit(cache=True)
def _penalise(plant, scene, k, before, after, costs) -> None:  # type: ignore[no-untyped-def]
    """Speed and tilt at the end of hold k, and distances at its middle and end."""
    c = plant.scalars
    hold = c[HOLD]
    end = 2 * k + 2
    particles = costs.shape[0]
    if c[SPEED_MOST] < math.inf:
        v = scene.velocities[end]
        for n in range(particles):
            north, east = v[0] + after[V, n], v[1] + after[V + 1, n]
            climb = v[2] + after[W, n]
            speed = math.sqrt(north * north + east * east + climb * climb)
            costs[n] += hold * _excess(speed - c[SPEED_MOST])
    if c[NONLINEAR] != 0.0:
        b = scene.directions[end]
        for n in range(particles):
            north, east = b[0] + after[B, n], b[1] + after[B + 1, n]
            costs[n] += hold * _excess(math.sqrt(north * north + east * east) - c[TILT_MOST])
    if scene.volumes.shape[0]:
        down = scene.positions[end, 2]
        room = max(scene.floor_down_m - down, 0.0)
        depths = np.empty(particles)
        for n in range(particles):
            costs[n] += hold * _excess(after[Z, n] - room)
    for i in range(scene.volumes.shape[0]):
        for node in range(2 * k + 1, 2 * k + 3):
            _intrude(plant, scene, i, node, before, after, depths)
            for n in range(particles):
                costs[n] += 0.5 * hold * _excess(depths[n])


@numba.njit(cache=True)
def intrusions(plant, scene, states, depths) -> None:  # type: ignore[no-untyped-def]
    """How deep plans are within the clearance of each volume at each node, metres, negative
    outside: depths (V 2 N, particles) of states (N + 1, STATE_SIZE, particles)."""
    nodes = 2 * (states.shape[0] - 1)
    for i in range(scene.volumes.shape[0]):
        for node in range(1, nodes + 1):
            k = (node - 1) // 2
            row = depths[i * nodes + node - 1]
            _intrude(plant, scene, i, node, states[k], states[k + 1], row)


@numba.njit(cache=True)
def _intrude(plant, scene, i, node, before, after, depths) -> None:  # type: ignore[no-untyped-def]
    """Depths (particles,) within the clearance of volume i at a middle or an end of a hold."""
    c = plant.scalars
    hold = c[HOLD]
    volume = scene.volumes[i].copy()
    for axis in range(3):
        volume[CENTRE + axis] += 0.5 * hold * node * volume[VELOCITY + axis]
    at = scene.positions[node]
    bow = 0.125 * hold
    for n in range(depths.shape[0]):
        if node % 2 == 0:
            x, y, z = after[P, n], after[P + 1, n], after[Z, n]
        else:  # halfway, as position and velocity at both ends have it
            x = 0.5 * (before[P, n] + after[P, n]) + bow * (before[V, n] - after[V, n])
            y = 0.5 * (before[P + 1, n] + after[P + 1, n])
            y += bow * (before[V + 1, n] - after[V + 1, n])
            z = 0.5 * (before[Z, n] + after[Z, n]) + bow * (before[W, n] - after[W, n])
        depths[n] = c[CLEARANCE] - distance(volume, at[0] + x, at[1] + y, at[2] + z)
