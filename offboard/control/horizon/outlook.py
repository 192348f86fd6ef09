"""What the reference asks over N decisions, and the deviations and bounds that follow from it.

Everything beyond is in deviations from these values, with the attitude loop's own response taken
out by the feed-forward: a plan of zeros flies the reference. Lateral axes live on the clock of the
tilt, the vertical one on that of the thrust. Knows no search and no keep-out volume.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from offboard.control.laws.tracking import heave_of
from offboard.control.riccati import held_lead
from offboard.model.predicted_state import PredictedState
from offboard.model.vehicle import Vehicle
from offboard.reference.base import Reference
from offboard.reference.flatness import flat_state

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Outlook:
    """The reference at the 2 N + 1 nodes (start, middle, ..., end) of N holds, NED, SI.

    positions_ned_m, velocities_ned_mps, directions_ned (2 N + 1, 3), each axis at its own clock;
    thrusts_tilt_mps2 and thrusts_heave_mps2 (2 N + 1,) T at the clocks of tilt and thrust,
    uprights_heave (2 N + 1,) b_z at that of the thrust. feedforward (N, 3): b_c north and east and
    the vertical thrust, led and half a hold late. A steady vertical disturbance is nearly always a
    wrong thrust or mass, so the tilted thrust pushes sideways with `thrust_share` of what is
    believed: g of it holds the weight.
    """

    positions_ned_m: Array
    velocities_ned_mps: Array
    directions_ned: Array
    thrusts_tilt_mps2: Array
    thrusts_heave_mps2: Array
    uprights_heave: Array
    feedforward: Array
    thrust_share: float

    @property
    def steps(self) -> int:
        return len(self.feedforward)


def look_ahead(
    vehicle: Vehicle, reference: Reference, state: PredictedState, period_s: float, steps: int
) -> Outlook:
    """The outlook from the moments at which a command sent now takes effect."""
    nodes_s = 0.5 * period_s * np.arange(2 * steps + 1)
    times = np.concatenate((state.time_s + nodes_s, heave_of(state).time_s + nodes_s))
    sample = reference.sample(times)
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
        uprights_heave=b[count:, 2].copy(),
        feedforward=np.column_stack((led_tilt, led_down)),
        thrust_share=vehicle.gravity_mps2
        / (vehicle.gravity_mps2 + float(state.disturbance_ned_mps2[2])),
    )


@dataclass(frozen=True, slots=True)
class Bounds:
    """Of the deviations [b_c north, b_c east, T b_z] of each step from the feed-forward, (N, 3)."""

    lower: Array
    upper: Array


def bounds(
    outlook: Outlook,
    upright: float,
    tilt_limit: float,
    feedback_limit: float,
    thrust_mps2: tuple[float, float],
) -> Bounds:
    """As the box of one decision has them, at every step: `thrust_mps2` is (least, most) and
    `upright` b_z as predicted, which the first thrust is divided by."""
    nominal = outlook.feedforward
    lower, upper = np.empty_like(nominal), np.empty_like(nominal)
    tilt = nominal[:, :2]
    centre = np.clip(tilt, -tilt_limit, tilt_limit)
    lower[:, :2] = np.maximum(centre - feedback_limit, -tilt_limit) - tilt
    upper[:, :2] = np.minimum(centre + feedback_limit, tilt_limit) - tilt
    uprights = outlook.uprights_heave[0:-1:2].copy()
    uprights[0] = upright
    lower[:, 2] = thrust_mps2[0] * uprights - nominal[:, 2]
    upper[:, 2] = thrust_mps2[1] * uprights - nominal[:, 2]
    return Bounds(lower, upper)
