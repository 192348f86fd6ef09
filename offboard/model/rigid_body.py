"""The nonlinear rigid body of Eqs. 1-8, which forces and torques move, and its linear model at
hover, Eqs. 8-18.

One function, `body_accelerations`, contains the physics (Newton-Euler with drag). Two charts add
the kinematics: the paper's 12 states (Eq. 5, Euler angles, body velocity), and 13 states with a
quaternion and NED velocity, without singularity, which the simulator integrates. The length of the
state selects the chart. A state is an array (..., 12) or (..., 13), inputs (Eq. 6) are (..., 4) and
total: hover is [m g, 0, 0, 0].

The simulator, the paper's plant and the linearisation all use this code. Compiled code calls it
compiled; Python calls it with numpy arrays, also complex ones for differentiation by complex step.
For attitude setpoints instead of torques, see `axes`. This module knows no rotors, ground, sensors
or randomness.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from offboard.compiled import kernel
from offboard.model.axes import LinearModel
from offboard.model.frames import quaternion_from_euler, rotation_from_quaternion
from offboard.model.vehicle import Vehicle

Array = NDArray[np.float64]

# Eq. 5: Euler angles rad, body rates rad/s, body velocity m/s, position NED m
PHI, THETA, PSI, P, Q, R, U, V, W, X, Y, Z = range(12)

# Eq. 6: lift N, roll and pitch input (N if the vehicle has an arm, else N m), yaw torque N m
THRUST, TAU_X, TAU_Y, TAU_Z = range(4)
INPUT_SIZE: Final = 4


@dataclass(frozen=True, slots=True)
class Chart:
    """The layout of a state: the slices of its last axis."""

    size: int
    attitude: slice
    rates: slice
    velocity: slice
    position: slice


EULER: Final = Chart(12, slice(0, 3), slice(3, 6), slice(6, 9), slice(9, 12))
"""[phi theta psi, p q r, u v w (body), x y z (NED)], Eq. 5."""

QUATERNION: Final = Chart(13, slice(0, 4), slice(4, 7), slice(7, 10), slice(10, 13))
"""[w x y z (FRD -> NED), p q r, velocity NED, position NED]."""

RK4_SCRATCH_ROWS = 3
_COMPLEX_STEP = 1e-30
_STILL_AIR = np.zeros(3)


def pack(vehicle: Vehicle, quadratic_drag_npmps2: float = 0.0) -> Array:
    """Vehicle -> (13,) parameters of the compiled functions, SI:
    [mass, gravity, I_x, I_y, I_z, arm, D_t (3), D_r (3), quadratic drag], where the quadratic drag
    acts on each body axis separately, in addition to the linear drag D_t.
    """
    return np.array(
        [
            vehicle.mass_kg,
            vehicle.gravity_mps2,
            *vehicle.inertia_kgm2,
            vehicle.arm_m,
            *vehicle.drag_translation_npmps,
            *vehicle.drag_rotation_nmpradps,
            quadratic_drag_npmps2,
        ]
    )


def hover_input(vehicle: Vehicle) -> Array:
    """Inputs (4,) that hold the vehicle still (u* of Eq. 8); deviations are counted from here."""
    return np.array([vehicle.mass_kg * vehicle.gravity_mps2, 0.0, 0.0, 0.0])


def derivative(
    state: ArrayLike, inputs: ArrayLike, parameters: Array, wind_ned_mps: ArrayLike = _STILL_AIR
) -> Any:
    """x' = f(x, u), Eq. 7: state (..., 12 or 13), inputs (..., 4), wind (..., 3) -> like state.

    Leading axes broadcast against each other. Raises ValueError for other lengths.
    """
    given = [np.asarray(part) for part in (state, inputs, wind_ned_mps)]
    sizes = tuple(part.shape[-1] if part.ndim else 0 for part in given)
    if sizes[0] not in (EULER.size, QUATERNION.size) or sizes[1:] != (INPUT_SIZE, 3):
        raise ValueError(
            f"state, inputs and wind must end in 12 or 13, 4 and 3 elements, not {sizes}"
        )
    lead = np.broadcast_shapes(*(part.shape[:-1] for part in given))
    result = np.empty((*lead, sizes[0]), np.result_type(np.float64, *given))
    state, inputs, wind, out = (np.moveaxis(part, -1, 0) for part in (*given, result))
    derivative_into(state, inputs, wind, parameters, out)
    return result


@kernel
def body_accelerations(air_velocity: Any, rates: Any, inputs: Any, parameters: Any) -> Any:
    """Newton-Euler equations in body axes: the only function that computes forces and torques.

    `air_velocity` is the velocity relative to the air in body axes, (u, v, w); `rates` (p, q, r).
    Returns six scalars: specific force (which an accelerometer measures, m/s^2) and angular
    acceleration (rad/s^2). Lift acts along -z, drag D_t (Eq. 3) on the velocity relative to the
    air, D_r (Eq. 4) on the rates; quadratic drag acts on each axis separately.
    """
    u, v, w = air_velocity
    p, q, r = rates
    mass, arm = parameters[0], parameters[5]
    inertia_x, inertia_y, inertia_z = parameters[2], parameters[3], parameters[4]
    force_x = -(parameters[6] + parameters[12] * abs(u)) * u
    force_y = -(parameters[7] + parameters[12] * abs(v)) * v
    force_z = -(parameters[8] + parameters[12] * abs(w)) * w - inputs[0]
    torque_x = arm * inputs[1] - parameters[9] * p - (inertia_z - inertia_y) * q * r
    torque_y = arm * inputs[2] - parameters[10] * q - (inertia_x - inertia_z) * r * p
    torque_z = inputs[3] - parameters[11] * r - (inertia_y - inertia_x) * p * q
    return (
        force_x / mass,
        force_y / mass,
        force_z / mass,
        torque_x / inertia_x,
        torque_y / inertia_y,
        torque_z / inertia_z,
    )


@kernel
def _euler_into(state: Any, inputs: Any, wind_ned: Any, parameters: Any, out: Any) -> None:
    p, q, r = state[3], state[4], state[5]
    u, v, w = state[6], state[7], state[8]
    sin_phi, cos_phi = np.sin(state[0]), np.cos(state[0])
    sin_theta, cos_theta = np.sin(state[1]), np.cos(state[1])
    sin_psi, cos_psi = np.sin(state[2]), np.cos(state[2])
    # Body axes in NED, columns of the rotation FRD -> NED
    xn, xe, xd = cos_theta * cos_psi, cos_theta * sin_psi, -sin_theta
    yn = sin_phi * sin_theta * cos_psi - cos_phi * sin_psi
    ye = sin_phi * sin_theta * sin_psi + cos_phi * cos_psi
    yd = sin_phi * cos_theta
    zn = cos_phi * sin_theta * cos_psi + sin_phi * sin_psi
    ze = cos_phi * sin_theta * sin_psi - sin_phi * cos_psi
    zd = cos_phi * cos_theta
    air_u = u - (xn * wind_ned[0] + xe * wind_ned[1] + xd * wind_ned[2])
    air_v = v - (yn * wind_ned[0] + ye * wind_ned[1] + yd * wind_ned[2])
    air_w = w - (zn * wind_ned[0] + ze * wind_ned[1] + zd * wind_ned[2])
    force_x, force_y, force_z, turn_x, turn_y, turn_z = body_accelerations(
        (air_u, air_v, air_w), (p, q, r), inputs, parameters
    )
    gravity = parameters[1]
    out[0] = p + (q * sin_phi + r * cos_phi) * sin_theta / cos_theta
    out[1] = q * cos_phi - r * sin_phi
    out[2] = (q * sin_phi + r * cos_phi) / cos_theta
    out[3], out[4], out[5] = turn_x, turn_y, turn_z
    out[6] = r * v - q * w + gravity * xd + force_x
    out[7] = p * w - r * u + gravity * yd + force_y
    out[8] = q * u - p * v + gravity * zd + force_z
    out[9] = xn * u + yn * v + zn * w
    out[10] = xe * u + ye * v + ze * w
    out[11] = xd * u + yd * v + zd * w


@kernel
def quaternion_into(state: Any, inputs: Any, wind_ned: Any, parameters: Any, out: Any) -> None:
    qw, qx, qy, qz = state[0], state[1], state[2], state[3]
    p, q, r = state[4], state[5], state[6]
    # Body axes in NED, columns of the rotation FRD -> NED
    xn, xe, xd = (
        1.0 - 2.0 * (qy * qy + qz * qz),
        2.0 * (qx * qy + qw * qz),
        2.0 * (qx * qz - qw * qy),
    )
    yn, ye, yd = (
        2.0 * (qx * qy - qw * qz),
        1.0 - 2.0 * (qx * qx + qz * qz),
        2.0 * (qy * qz + qw * qx),
    )
    zn, ze, zd = (
        2.0 * (qx * qz + qw * qy),
        2.0 * (qy * qz - qw * qx),
        1.0 - 2.0 * (qx * qx + qy * qy),
    )
    north, east, down = state[7] - wind_ned[0], state[8] - wind_ned[1], state[9] - wind_ned[2]
    air_u = xn * north + xe * east + xd * down
    air_v = yn * north + ye * east + yd * down
    air_w = zn * north + ze * east + zd * down
    force_x, force_y, force_z, turn_x, turn_y, turn_z = body_accelerations(
        (air_u, air_v, air_w), (p, q, r), inputs, parameters
    )
    out[0] = -0.5 * (qx * p + qy * q + qz * r)
    out[1] = 0.5 * (qw * p + qy * r - qz * q)
    out[2] = 0.5 * (qw * q + qz * p - qx * r)
    out[3] = 0.5 * (qw * r + qx * q - qy * p)
    out[4], out[5], out[6] = turn_x, turn_y, turn_z
    out[7] = xn * force_x + yn * force_y + zn * force_z
    out[8] = xe * force_x + ye * force_y + ze * force_z
    out[9] = xd * force_x + yd * force_y + zd * force_z + parameters[1]
    out[10], out[11], out[12] = state[7], state[8], state[9]


@kernel
def derivative_into(state: Any, inputs: Any, wind_ned: Any, parameters: Any, out: Any) -> None:
    """One state (12,) or (13,), inputs (4,), wind (3,) m/s, parameters of `pack` -> `out`. In
    Python, arrays may have further axes, for many states."""
    if state.shape[0] == 12:
        _euler_into(state, inputs, wind_ned, parameters, out)
    else:
        quaternion_into(state, inputs, wind_ned, parameters, out)


@kernel
def rk4_into(
    derivative: Any,
    state: Any,
    inputs: Any,
    wind_ned: Any,
    parameters: Any,
    step_s: float,
    scratch: Any,
    out: Any,
) -> None:
    """Do one RK4 step of one state into `out`, which may be `state`. `derivative` is
    `derivative_into`, or `quaternion_into` if all states have 13 numbers; `scratch` is
    (3, state size)."""
    slope, total, probe = scratch[0], scratch[1], scratch[2]
    derivative(state, inputs, wind_ned, parameters, total)
    for stage in range(1, 4):
        reach = step_s if stage == 3 else 0.5 * step_s
        previous = total if stage == 1 else slope
        for i in range(state.shape[0]):
            probe[i] = state[i] + reach * previous[i]
        derivative(probe, inputs, wind_ned, parameters, slope)
        weight = 1.0 if stage == 3 else 2.0
        for i in range(state.shape[0]):
            total[i] += weight * slope[i]
    for i in range(state.shape[0]):
        out[i] = state[i] + step_s / 6.0 * total[i]
    if state.shape[0] == 13:
        length = np.sqrt(out[0] * out[0] + out[1] * out[1] + out[2] * out[2] + out[3] * out[3])
        for i in range(4):
            out[i] /= length


def hover_matrices(vehicle: Vehicle) -> tuple[Array, Array]:
    """Return A (12, 12) and B (12, 4) of Eq. 9 at hover, level, nose north.

    Computed by complex step, f'(x) = Im f(x + ih) / h, which is exact to rounding, with exact zeros
    where f is decoupled.
    """
    size = EULER.size
    steps = 1j * _COMPLEX_STEP * np.eye(size + INPUT_SIZE)
    slopes = derivative(
        steps[:, :size], hover_input(vehicle) + steps[:, size:], pack(vehicle)
    ).imag.T
    jacobian = slopes / _COMPLEX_STEP
    return jacobian[:, :size], jacobian[:, size:]


def sampled_matrices(vehicle: Vehicle, step_s: float) -> tuple[Array, Array]:
    """Return A_d (12, 12) and B_d (12, 4) of Eq. 14: zero-order hold over `step_s` seconds."""
    sampled = LinearModel(*hover_matrices(vehicle)).sampled(step_s)
    return sampled.dynamics, sampled.input_map


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
