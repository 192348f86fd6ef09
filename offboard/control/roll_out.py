"""Compiled roll-outs of plans over N decisions, by which `horizon` evaluates them.

States and inputs are deviations from the reference (`mpc.OUTLOOK`). The motion is that of the
tracking laws' linear model, sampled exactly, plus the nonlinear part of thrust times direction,
integrated from start, middle and end of each hold (Simpson's rule). A plan of zeros flies the
reference exactly; for small deviations from hover, cost and motion equal those of the closed form.
Exceeding a soft limit (speed, tilt, the ground, keep-out volumes) is penalised.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from offboard.compiled import array, entry, kernel
from offboard.control.keep_out import CENTRE, VELOCITY, distance
from offboard.control.law import TrackingLaw
from offboard.control.mpc import OUTLOOK
from offboard.model.axes import SHORTEST_THRUST_LAG_S, b_z_of, lateral_model

Array = NDArray[np.float64]

# Indices of a state: position, velocity, b, b', each north and east; then z, v_z, T b_z; T
P, V, B, R, Z, W, F, T = 0, 2, 4, 6, 8, 9, 10, 11
STATE_SIZE = 12
INPUTS = 3  # b_c north and east, vertical thrust

# Penalty per second for exceeding a limit: per m (or m/s, or unit of b), and per square of that
SLOPE, CURVATURE = 20.0, 200.0

PLANT = np.dtype(
    [
        ("lateral_transition", "f8", (4, 4)),
        ("lateral_input", "f8", 4),
        ("lateral_effort", "f8"),
        ("lateral_terminal", "f8", (4, 4)),
        ("lateral_gain", "f8", 4),
        ("vertical_transition", "f8", (3, 3)),
        ("vertical_input", "f8", 3),
        ("vertical_effort", "f8"),
        ("vertical_terminal", "f8", (3, 3)),
        ("vertical_gain", "f8", 3),
        ("tilt_half", "f8", 3),  # b after half a hold = tilt_half . [b, b', input]
        ("hold_s", "f8"),
        ("gravity_mps2", "f8"),
        # share of a thrust error that is left after half a hold and after a whole one
        ("lag_half", "f8"),
        ("lag_full", "f8"),
        ("thrust_least_mps2", "f8"),
        ("thrust_most_mps2", "f8"),
        ("tilt_most", "f8"),  # sine of the tilt limit
        ("speed_most_mps", "f8"),
        ("clearance_m", "f8"),
        # velocity and position after a hold, per acceleration at its start, middle and end
        ("push_velocity", "f8", 3),
        ("push_position", "f8", 3),
    ],
    align=True,
)
"""Constants of one vehicle and period."""


def plant_of(law: TrackingLaw, *, speed_limit_mps: float, clearance_m: float) -> NDArray[np.void]:
    """Return one `PLANT` (1,) for the vehicle and the gains of `law`."""
    vehicle, period_s, drag = law.vehicle, law.period_s, law.vehicle.drag_per_mass_ps
    half = lateral_model(vehicle).sampled(0.5 * period_s)
    lag_s = max(vehicle.thrust_lag_s, SHORTEST_THRUST_LAG_S)
    simpson, left_s = period_s / np.array([6.0, 1.5, 6.0]), period_s * np.array([1.0, 0.5, 0.0])
    carried = -np.expm1(-drag * left_s) / drag if drag > 0 else left_s  # m per m/s
    constants = {
        "tilt_half": [*half.dynamics[2, 2:], half.input_map[2, 0]],
        "hold_s": period_s,
        "gravity_mps2": vehicle.gravity_mps2,
        "lag_half": math.exp(-0.5 * period_s / lag_s),
        "lag_full": math.exp(-period_s / lag_s),
        "thrust_least_mps2": vehicle.thrust_min_mps2,
        "thrust_most_mps2": vehicle.thrust_max_mps2,
        "tilt_most": math.sin(vehicle.tilt_max_rad),
        "speed_most_mps": speed_limit_mps,
        "clearance_m": clearance_m,
        "push_velocity": simpson * np.exp(-drag * left_s),
        "push_position": simpson * carried,
    }
    for name, axis in (("lateral", law.lateral), ("vertical", law.vertical)):
        constants[f"{name}_transition"] = axis.transition
        constants[f"{name}_input"] = axis.input_map[:, 0]
        constants[f"{name}_effort"] = axis.effort
        constants[f"{name}_terminal"] = axis.terminal
        constants[f"{name}_gain"] = axis.gain
    plant = np.zeros(1, PLANT)
    for key, value in constants.items():
        plant[key] = value
    return plant


@entry(
    PLANT, OUTLOOK, array(2), float, array(1), array(2), array(2), float, array(2), array(3),
    array(3), array(3), array(1),
)  # fmt: skip
def roll_out(
    plants: Any,
    outlooks: Any,
    volumes: Array,
    floor_down_m: float,
    start: Array,
    base_inputs: Array,
    base_states: Array,
    feedback: float,
    weights: Array,
    knots: Array,
    states: Array,
    inputs: Array,
    costs: Array,
) -> None:
    """Compute costs (n,), states (n, N + 1, STATE_SIZE) and inputs (n, N, 3) of n plans.

    The input of a step is base_inputs (N, 3) + weights (N, M) @ knots (n, M, 3) + `feedback` times
    the closed form's feedback for the deviation of the state from base_states (N + 1, STATE_SIZE),
    clipped to the bounds. `start` (STATE_SIZE,) is the first state, and `volumes` (V, PACKED_SIZE)
    are the keep-out volumes at that time. With volumes, a plan is penalised for being below
    `floor_down_m` (NED), or below the reference if that is lower.
    """
    plant, ahead = plants[0], outlooks[0]
    for n in range(costs.shape[0]):
        costs[n] = 0.0
        states[n, 0] = start
        for k in range(inputs.shape[1]):
            before, after, chosen = states[n, k], states[n, k + 1], inputs[n, k]
            for axis in range(INPUTS):
                chosen[axis] = base_inputs[k, axis]
                for m in range(weights.shape[1]):
                    chosen[axis] += weights[k, m] * knots[n, m, axis]
            for row in range(Z):
                off = feedback * (before[row] - base_states[k, row])
                if row < B:  # position and velocity are scaled as in `law.to_hover`
                    north, east = ahead.to_hover[k, 0, row % 2], ahead.to_hover[k, 1, row % 2]
                    chosen[0] -= plant.lateral_gain[row // 2] * north * off
                    chosen[1] -= plant.lateral_gain[row // 2] * east * off
                else:
                    chosen[row % 2] -= plant.lateral_gain[row // 2] * off
            for row in range(Z, T):
                off = feedback * (before[row] - base_states[k, row])
                chosen[2] -= plant.vertical_gain[row - Z] * off
            for axis in range(INPUTS):
                chosen[axis] = min(max(chosen[axis], ahead.lower[k, axis]), ahead.upper[k, axis])
            costs[n] += _hold(plant, before, chosen, after)
            _add_nonlinear_part(plant, ahead, k, before, chosen, after)
            costs[n] += _penalties(plant, ahead, volumes, floor_down_m, k, before, after)
        costs[n] += _cost_to_go(plant, states[n, inputs.shape[1]])
        if not math.isfinite(costs[n]):
            costs[n] = math.inf  # argmin would select a NaN


@kernel
def _hold(plant: Any, before: Array, chosen: Array, after: Array) -> float:
    """Compute the state after one hold by the linear model, and return the cost of the hold."""
    a, b = plant.lateral_transition, plant.lateral_input
    cost = 0.0
    for axis in range(2):
        u = chosen[axis]
        cost += plant.hold_s * before[axis] ** 2 + plant.lateral_effort * u * u
        for i in range(4):
            row = b[i] * u
            for j in range(4):
                row += a[i, j] * before[2 * j + axis]
            after[2 * i + axis] = row
    h, g, u = plant.vertical_transition, plant.vertical_input, chosen[2]
    cost += plant.hold_s * before[Z] ** 2 + plant.vertical_effort * u * u
    for i in range(3):
        after[Z + i] = h[i, 0] * before[Z] + h[i, 1] * before[W] + h[i, 2] * before[F] + g[i] * u
    return float(cost)


@kernel
def _add_nonlinear_part(
    plant: Any, ahead: Any, k: int, before: Array, chosen: Array, after: Array
) -> None:
    """Add the difference between T b and its linear model, at start, middle and end of a hold."""
    half, share = plant.tilt_half, ahead.thrust_share
    w, thrust_error = chosen[2], before[T]
    asked, down_error, vertical_error = 0.0, 0.0, 0.0
    for node in range(3):
        i = 2 * k + node
        ref_n, ref_e, down = ahead.directions[i, 0], ahead.directions[i, 1], ahead.b_z[i]
        # deviations of b north and east and of T, and T b_z of the linear model
        if node == 0:
            off_n, off_e, linear = before[B], before[B + 1], before[F]
        elif node == 1:
            off_n = half[0] * before[B] + half[1] * before[R] + half[2] * chosen[0]
            off_e = half[0] * before[B + 1] + half[1] * before[R + 1] + half[2] * chosen[1]
            linear = w + (before[F] - w) * plant.lag_half
            thrust_error = asked + (before[T] - asked) * plant.lag_half
        else:
            off_n, off_e = after[B], after[B + 1]
            linear = w + (before[F] - w) * plant.lag_full
            thrust_error = asked + (before[T] - asked) * plant.lag_full
        down_error = b_z_of(ref_n + off_n, ref_e + off_e) - b_z_of(ref_n, ref_e)
        if node == 0:
            led = ahead.feedforward[k, 2]
            asked = (led + w) / max(down + down_error, 0.1)
            asked = min(max(asked, plant.thrust_least_mps2), plant.thrust_most_mps2) - led / down
        # accelerations -(T b - T_r b_r), minus those of the linear model
        thrust = ahead.thrusts_tilt[i] + thrust_error
        north = plant.gravity_mps2 * off_n - share * (thrust * off_n + thrust_error * ref_n)
        east = plant.gravity_mps2 * off_e - share * (thrust * off_e + thrust_error * ref_e)
        vertical_error = (
            ahead.thrusts_vertical[i] + thrust_error
        ) * down_error + thrust_error * down
        after[P] += plant.push_position[node] * north
        after[P + 1] += plant.push_position[node] * east
        after[V] += plant.push_velocity[node] * north
        after[V + 1] += plant.push_velocity[node] * east
        after[Z] += plant.push_position[node] * (linear - vertical_error)
        after[W] += plant.push_velocity[node] * (linear - vertical_error)
    after[F], after[T] = vertical_error, thrust_error


@kernel
def _cost_to_go(plant: Any, last: Array) -> float:
    """Return the cost-to-go of the last state."""
    lateral, vertical = plant.lateral_terminal, plant.vertical_terminal
    cost = 0.0
    for i in range(4):
        for j in range(4):
            both = last[2 * i] * last[2 * j] + last[2 * i + 1] * last[2 * j + 1]
            cost += lateral[i, j] * both
    for i in range(3):
        for j in range(3):
            cost += vertical[i, j] * last[Z + i] * last[Z + j]
    return cost


@kernel
def _penalties(
    plant: Any,
    ahead: Any,
    volumes: Array,
    floor_down_m: float,
    k: int,
    before: Array,
    after: Array,
) -> float:
    """Return the penalties of hold k. Volumes count at its middle and end, other limits at its
    end."""
    hold, end = plant.hold_s, 2 * k + 2
    b, v = ahead.directions[end], ahead.velocities[end]
    paid = hold * _penalty(math.hypot(b[0] + after[B], b[1] + after[B + 1]) - plant.tilt_most)
    if plant.speed_most_mps < math.inf:
        north, east, down = v[0] + after[V], v[1] + after[V + 1], v[2] + after[W]
        speed = math.sqrt(north * north + east * east + down * down)
        paid += hold * _penalty(speed - plant.speed_most_mps)
    if volumes.shape[0] > 0:
        room = max(floor_down_m - ahead.positions[end, 2], 0.0)
        paid += hold * _penalty(after[Z] - room)
    # position in the middle of the hold, from position and velocity at both ends
    bow = 0.125 * hold
    middle_n = 0.5 * (before[P] + after[P]) + bow * (before[V] - after[V])
    middle_e = 0.5 * (before[P + 1] + after[P + 1]) + bow * (before[V + 1] - after[V + 1])
    middle_d = 0.5 * (before[Z] + after[Z]) + bow * (before[W] - after[W])
    for i in range(volumes.shape[0]):
        volume = volumes[i]
        for node in range(end - 1, end + 1):
            n, e, d = after[P], after[P + 1], after[Z]
            if node < end:
                n, e, d = middle_n, middle_e, middle_d
            at, since_s = ahead.positions[node], 0.5 * hold * node
            away = distance(
                volume,
                at[0] + n - (volume[CENTRE] + since_s * volume[VELOCITY]),
                at[1] + e - (volume[CENTRE + 1] + since_s * volume[VELOCITY + 1]),
                at[2] + d - (volume[CENTRE + 2] + since_s * volume[VELOCITY + 2]),
            )
            paid += 0.5 * hold * _penalty(plant.clearance_m - away)
    return float(paid)


@kernel
def _penalty(over: float) -> float:
    """Return the penalty per second for exceeding a limit by `over`."""
    return max(over, 0.0) * (SLOPE + CURVATURE * max(over, 0.0))
