"""What the reference asks for over N decisions, the bounds of the deviations from it, and the
problem over N decisions for the linear plant as one quadratic in all inputs (condensed).

Plans are deviations from these values, and the feed-forward compensates the response of the
attitude loop: a plan of zeros flies the reference. The lateral axes are sampled at the times when
the tilt acts, the vertical one when the thrust acts. Knows no solver and no keep-out volume.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from offboard.control.base import Situation
from offboard.control.gains import CostToGo, held_lead
from offboard.control.law import Task, TrackingLaw, heave_of
from offboard.control.quadratic import BoxQuadratic
from offboard.reference.flatness import flat_state

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Outlook:
    """The reference at the 2 N + 1 nodes (start, middle, ..., end) of N holds, NED, SI.

    positions_ned_m, velocities_ned_mps, directions_ned (2 N + 1, 3), each axis at its own times;
    thrusts_tilt_mps2 and thrusts_heave_mps2 (2 N + 1,): T when tilt and when thrust act;
    b_z_heave (2 N + 1,): b_z when the thrust acts. feedforward (N, 3): b_c north and east and
    the vertical thrust in the middle of each hold, led. A steady vertical disturbance is nearly
    always a wrong hover thrust or mass; therefore the lateral force of the tilted thrust is taken
    as `thrust_share` of the modelled one.
    """

    positions_ned_m: Array
    velocities_ned_mps: Array
    directions_ned: Array
    thrusts_tilt_mps2: Array
    thrusts_heave_mps2: Array
    b_z_heave: Array
    feedforward: Array
    thrust_share: float


def look_ahead(law: TrackingLaw, situation: Situation, steps: int) -> Outlook:
    """The outlook over `steps` holds, from the times at which a command sent now takes effect."""
    vehicle, state, period_s = law.vehicle, situation.state, law.period_s
    nodes_s = 0.5 * period_s * np.arange(2 * steps + 1)
    times = np.concatenate((state.time_s + nodes_s, heave_of(state).time_s + nodes_s))
    sample = situation.reference.sample(times)
    flat = flat_state(
        sample, vehicle.gravity_mps2, vehicle.drag_per_mass_ps, state.disturbance_ned_mps2
    )
    count = len(nodes_s)
    positions, velocities = sample.position_ned_m[:count], sample.velocity_ned_mps[:count]
    positions, velocities = positions.copy(), velocities.copy()
    positions[:, 2] = sample.position_ned_m[count:, 2]
    velocities[:, 2] = sample.velocity_ned_mps[count:, 2]
    b = flat.thrust_direction_ned
    middle = slice(1, count, 2)
    led_tilt = held_lead(
        b[:count][middle, :2],
        flat.thrust_direction_rate_ned_ps[:count][middle, :2],
        flat.thrust_direction_acceleration_ned_ps2[:count][middle, :2],
        vehicle.tilt,
        period_s,
    )
    led_thrust = flat.thrust_mps2 + vehicle.thrust_lag_s * flat.thrust_rate_mps3
    led_down = (led_thrust * b[:, 2])[count:][middle]
    return Outlook(
        positions_ned_m=positions,
        velocities_ned_mps=velocities,
        directions_ned=np.ascontiguousarray(b[:count]),
        thrusts_tilt_mps2=flat.thrust_mps2[:count].copy(),
        thrusts_heave_mps2=flat.thrust_mps2[count:].copy(),
        b_z_heave=b[count:, 2].copy(),
        feedforward=np.column_stack((led_tilt, led_down)),
        thrust_share=vehicle.gravity_mps2
        / (vehicle.gravity_mps2 + float(state.disturbance_ned_mps2[2])),
    )


@dataclass(frozen=True, slots=True)
class Bounds:
    """Bounds (N, 3) of the deviations [b_c north, b_c east, T b_z] of each step from the
    feed-forward."""

    lower: Array
    upper: Array


def bounds(outlook: Outlook, task: Task, law: TrackingLaw) -> Bounds:
    """The bounds of `task`, at every step."""
    nominal, limit = outlook.feedforward, law.tilt_limit
    reach = law.limits.feedback_limit
    lower, upper = np.empty_like(nominal), np.empty_like(nominal)
    tilt = nominal[:, :2]
    centre = np.clip(tilt, -limit, limit)
    lower[:, :2] = np.maximum(centre - reach, -limit) - tilt
    upper[:, :2] = np.minimum(centre + reach, limit) - tilt
    down = outlook.b_z_heave[0:-1:2].copy()
    down[0] = task.b_z
    lower[:, 2] = task.problem.lower[0] * down - nominal[:, 2]
    upper[:, 2] = task.problem.upper[0] * down - nominal[:, 2]
    return Bounds(lower, upper)


class HorizonQuadratic:
    """J of N held inputs and the cost-to-go that follows them, for the gains of `law`; `problem`
    fills in the state. Inputs are deviations from the `Outlook`: N of b_c north, N of b_c east, N
    of vertical thrust. The axes do not couple."""

    def __init__(self, law: TrackingLaw, steps: int) -> None:
        self.steps = steps
        lateral = _condense(law.lateral, steps)
        self._axes = (lateral, lateral, _condense(law.vertical, steps))
        self._hessian: Array = block_diag(*(axis[0] for axis in self._axes))

    def problem(self, task: Task, within: Bounds) -> BoxQuadratic:
        """The quadratic in (3 N,) from the deviations of `task`."""
        starts = (task.lateral[:, 0], task.lateral[:, 1], task.vertical)
        axes = list(zip(starts, self._axes, strict=True))
        gradient = np.concatenate([start @ axis[1] for start, axis in axes])
        rest = sum(float(start @ axis[2] @ start) for start, axis in axes)
        lower, upper = within.lower.T.ravel(), within.upper.T.ravel()
        return BoxQuadratic(self._hessian, gradient, rest, lower, upper)

    def plan(self, stacked: Array) -> Array:
        """Inputs (3 N,) of the problem as (N, 3), one row per step."""
        return stacked.reshape(3, self.steps).T


def _condense(to_go: CostToGo, steps: int) -> tuple[Array, Array, Array]:
    """J = 1/2 u' H u + x' F u + x' G x of u (N,) from the state x (n,): H, F (n, N), G (n, n)."""
    size = len(to_go.transition)
    at = np.zeros((size, size + steps))  # the state, as a function of the first one and the inputs
    at[:, :size] = np.eye(size)
    total = np.zeros((size + steps, size + steps))
    for step in range(steps):
        held = np.zeros((1, size + steps))
        held[0, size + step] = 1.0
        both = np.vstack((at, held))
        total += both.T @ to_go.stage @ both
        at = to_go.transition @ at + to_go.input_map @ held
    total += at.T @ to_go.terminal @ at
    return 2.0 * total[size:, size:], 2.0 * total[:size, size:], total[:size, :size]
