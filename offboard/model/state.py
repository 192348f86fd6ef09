"""Layout of states and inputs, and the conversion between the two charts of the rigid body.

A state is an array (..., 12) in the paper's order (Eq. 5), or (..., 13) with a quaternion, which
has no singularity and is what the simulator integrates. Inputs (Eq. 6) are (..., 4).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from offboard.model.frames import (
    euler_from_quaternion,
    quaternion_from_euler,
    rotation_from_quaternion,
)

Array = NDArray[np.float64]

# Eq. 5: Euler angles rad, body rates rad/s, body velocity m/s, position NED m
PHI, THETA, PSI, P, Q, R, U, V, W, X, Y, Z = range(12)

# Eq. 6: lift N, roll and pitch input (N if the vehicle has an arm, else N m), yaw torque N m
THRUST, TAU_X, TAU_Y, TAU_Z = range(4)
INPUT_SIZE: Final = 4


@dataclass(frozen=True, slots=True)
class Chart:
    """The parts of a state along its last axis."""

    size: int
    attitude: slice
    rates: slice
    velocity: slice
    position: slice


EULER: Final = Chart(12, slice(0, 3), slice(3, 6), slice(6, 9), slice(9, 12))
"""[phi theta psi, p q r, u v w (body), x y z (NED)], Eq. 5."""

QUATERNION: Final = Chart(13, slice(0, 4), slice(4, 7), slice(7, 10), slice(10, 13))
"""[w x y z (FRD -> NED), p q r, velocity NED, position NED]."""


def quaternion_state(euler_state: Array) -> Array:
    """Eq. 5 state (..., 12) -> quaternion state (..., 13); velocity from body axes to NED."""
    phi, theta, psi = np.moveaxis(euler_state[..., EULER.attitude], -1, 0)
    quaternion = quaternion_from_euler(phi, theta, psi)
    velocity_ned = np.einsum(
        "...ij,...j->...i", rotation_from_quaternion(quaternion), euler_state[..., EULER.velocity]
    )
    return np.concatenate(
        (quaternion, euler_state[..., EULER.rates], velocity_ned, euler_state[..., EULER.position]),
        axis=-1,
    )


def euler_state(quaternion_state: Array) -> Array:
    """Quaternion state (..., 13) -> Eq. 5 state (..., 12); velocity from NED to body axes."""
    quaternion = quaternion_state[..., QUATERNION.attitude]
    velocity_body = np.einsum(
        "...ji,...j->...i",
        rotation_from_quaternion(quaternion),
        quaternion_state[..., QUATERNION.velocity],
    )
    return np.concatenate(
        (
            euler_from_quaternion(quaternion),
            quaternion_state[..., QUATERNION.rates],
            velocity_body,
            quaternion_state[..., QUATERNION.position],
        ),
        axis=-1,
    )
