"""Data of the roll-outs as records for compiled code: the plant of one vehicle, the scene of one
decision, and the layout of a state.

States and inputs are deviations from the reference (`Outlook`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from offboard.control.gains import CostToGo
from offboard.control.horizon.outlook import Bounds, Outlook
from offboard.control.law import Task, TrackingLaw
from offboard.model.axes import SHORTEST_THRUST_LAG_S, b_z_of, lateral_model

Array = NDArray[np.float64]

# Rows of a state: position, velocity, b, b', each north and east; then z, v_z, T b_z; T
P, V, B, R, Z, W, F, T = 0, 2, 4, 6, 8, 9, 10, 11
STATE_SIZE = 12
INPUTS = 3
MOST_STEPS = 40


PLANT = np.dtype(
    [
        ("lateral_transition", "f8", (4, 4)),
        ("lateral_input", "f8", 4),
        ("lateral_stage", "f8", (5, 5)),
        ("lateral_terminal", "f8", (4, 4)),
        ("lateral_gain", "f8", 4),
        ("vertical_transition", "f8", (3, 3)),
        ("vertical_input", "f8", 3),
        ("vertical_stage", "f8", (4, 4)),
        ("vertical_terminal", "f8", (3, 3)),
        ("vertical_gain", "f8", 3),
        ("tilt_half", "f8", (2, 3)),  # b and b' after half a hold, of [b, b', input]
        ("hold_s", "f8"),
        ("gravity_mps2", "f8"),
        # share of a thrust error that is left after half a hold and a whole one
        ("lag_half", "f8"),
        ("lag_full", "f8"),
        ("thrust_least_mps2", "f8"),
        ("thrust_most_mps2", "f8"),
        ("tilt_most", "f8"),  # sine
        ("speed_most_mps", "f8"),
        ("clearance_m", "f8"),
        # velocity and position after a hold per acceleration at its start, middle and end
        ("push_v0", "f8"),
        ("push_v1", "f8"),
        ("push_v2", "f8"),
        ("push_p0", "f8"),
        ("push_p1", "f8"),
    ],
    align=True,
)
"""Constants of one vehicle and period."""


def plant_of(law: TrackingLaw, *, speed_limit_mps: float, clearance_m: float) -> NDArray[np.void]:
    """One `PLANT`, for the vehicle and the gains of `law`."""
    vehicle, period_s = law.vehicle, law.period_s
    half = lateral_model(vehicle).sampled(0.5 * period_s)
    lag_s = max(vehicle.thrust_lag_s, SHORTEST_THRUST_LAG_S)
    constants = {
        "tilt_half": np.column_stack((half.dynamics[2:, 2:], half.input_map[2:, 0])),
        "hold_s": period_s,
        "gravity_mps2": vehicle.gravity_mps2,
        "lag_half": math.exp(-0.5 * period_s / lag_s),
        "lag_full": math.exp(-period_s / lag_s),
        "thrust_least_mps2": law.limits.thrust_floor * vehicle.gravity_mps2,
        "thrust_most_mps2": vehicle.thrust_max_mps2,
        "tilt_most": math.sin(vehicle.tilt_max_rad),
        "speed_most_mps": speed_limit_mps,
        "clearance_m": clearance_m,
    }
    constants |= _pushes(vehicle.drag_per_mass_ps, period_s)
    constants |= _axis("lateral", law.lateral)
    constants |= _axis("vertical", law.vertical)
    plant = np.zeros(1, PLANT)
    for name, value in constants.items():
        plant[name] = value
    return plant


def _pushes(drag: float, period_s: float) -> dict[str, float]:
    def carried(after_s: float) -> float:
        """The distance covered in this time with an initial velocity of 1, against the drag."""
        return -math.expm1(-drag * after_s) / drag if drag > 0 else after_s

    return {
        "push_v0": period_s / 6.0 * math.exp(-drag * period_s),
        "push_v1": period_s / 1.5 * math.exp(-0.5 * drag * period_s),
        "push_v2": period_s / 6.0,
        "push_p0": period_s / 6.0 * carried(period_s),
        "push_p1": period_s / 1.5 * carried(0.5 * period_s),
    }


def _axis(name: str, model: CostToGo) -> dict[str, Array]:
    return {
        f"{name}_transition": model.transition,
        f"{name}_input": model.input_map[:, 0],
        f"{name}_stage": model.stage,
        f"{name}_terminal": model.terminal,
        f"{name}_gain": model.gain,
    }


@dataclass(frozen=True, slots=True)
class Scene:
    """All that a roll-out reads of one decision: the outlook, the bounds of the inputs, the volumes
    (V, PACKED_SIZE) where they are at the first node, and the height NED (m) below which no way
    round a volume leads, where the reference does not."""

    ahead: Outlook
    within: Bounds
    volumes: Array
    floor_down_m: float

    def fill(self, record: NDArray[np.void], volumes: Array) -> None:
        """Write all into one `SCENE` and the volumes into an array of their own."""
        ahead = self.ahead
        record["thrust_share"], record["floor_down_m"] = ahead.thrust_share, self.floor_down_m
        for name, values in (
            ("positions", ahead.positions_ned_m),
            ("velocities", ahead.velocities_ned_mps),
            ("directions", ahead.directions_ned),
            ("thrusts_tilt", ahead.thrusts_tilt_mps2),
            ("thrusts_heave", ahead.thrusts_heave_mps2),
            ("b_z", ahead.b_z_heave),
            ("feedforward", ahead.feedforward[:, 2]),
            ("lower", self.within.lower),
            ("upper", self.within.upper),
        ):
            record[name][0, : len(values)] = values
        volumes[:] = self.volumes


_NODES = 2 * MOST_STEPS + 1
SCENE = np.dtype(
    [
        ("positions", "f8", (_NODES, 3)),
        ("velocities", "f8", (_NODES, 3)),
        ("directions", "f8", (_NODES, 3)),
        ("thrusts_tilt", "f8", _NODES),
        ("thrusts_heave", "f8", _NODES),
        ("b_z", "f8", _NODES),
        ("feedforward", "f8", MOST_STEPS),
        ("lower", "f8", (MOST_STEPS, 3)),
        ("upper", "f8", (MOST_STEPS, 3)),
        ("thrust_share", "f8"),
        ("floor_down_m", "f8"),
        ("start", "f8", STATE_SIZE),
    ],
    align=True,
)
"""A `Scene` of up to `MOST_STEPS` holds without its volumes, and the state to start from."""


def start_state(task: Task, ahead: Outlook) -> Array:
    """The state (STATE_SIZE,) of a task's deviations."""
    start = np.empty(STATE_SIZE)
    start[P:Z] = task.lateral.reshape(-1)
    start[Z:T] = task.vertical
    b_n, b_e = ahead.directions_ned[0, :2]
    leant = b_z_of(b_n + start[B], b_e + start[B + 1]) - b_z_of(b_n, b_e)
    thrust, b_z = ahead.thrusts_heave_mps2[0], ahead.b_z_heave[0]
    start[T] = (thrust * b_z + start[F]) / (b_z + leant) - thrust
    return start
