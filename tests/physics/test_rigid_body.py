"""The rigid body with quaternions against conservation laws and Newton's law in the inertial frame;
with Euler angles it flies the same. The linear model against SciPy and Eq. 16."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from numpy.typing import ArrayLike, NDArray
from scipy.integrate import solve_ivp
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from offboard.model.rigid_body import (
    PHI,
    PSI,
    QUATERNION,
    RK4_SCRATCH_ROWS,
    TAU_X,
    TAU_Y,
    TAU_Z,
    THETA,
    THRUST,
    P,
    Q,
    R,
    U,
    V,
    W,
    X,
    Z,
    derivative,
    derivative_into,
    hover_input,
    hover_matrices,
    pack,
    quaternion_state,
    rk4_into,
    sampled_matrices,
)
from offboard.model.vehicle import Vehicle
from offboard.paper.closed_loop import follow
from simulator.config import vehicle as load

Array = NDArray[np.float64]

NO_INPUT, STILL_AIR = np.zeros(4), np.zeros(3)
ATTITUDE, RATES = QUATERNION.attitude, QUATERNION.rates
VELOCITY, POSITION = QUATERNION.velocity, QUATERNION.position  # NED


def state_of(euler: ArrayLike) -> Array:
    """The state (13,) of roll, pitch, yaw, rates, body velocity and position (Eq. 5)."""
    return quaternion_state(np.array(euler, dtype=np.float64))


def rotation(state: Array) -> Rotation:
    """FRD -> NED by SciPy."""
    return Rotation.from_quat(state[ATTITUDE], scalar_first=True)


def step(
    state: Array, inputs: Array, parameters: Array, step_s: float, wind_ned: Array = STILL_AIR
) -> Array:
    """One RK4 step by the compiled function."""
    after, scratch = state.copy(), np.empty((RK4_SCRATCH_ROWS, len(state)))
    follow(after, inputs, wind_ned, parameters, step_s, 1, scratch)
    return after


def fly(state: Array, inputs: Array, parameters: Array, duration_s: float, step_s: float) -> Array:
    for _ in range(round(duration_s / step_s)):
        state = step(state, inputs, parameters, step_s)
    return state


def random_states(count: int, seed: int) -> Array:
    """Eq. 5 states away from the Euler singularity."""
    generator = np.random.default_rng(seed)
    scale = np.repeat([0.8, 2.0, 3.0, 10.0], 3)
    return generator.uniform(-1.0, 1.0, (count, 12)) * scale


@pytest.fixture
def lopsided() -> Vehicle:
    """Three different moments of inertia and drags, so that no axis can stand in for another."""
    return Vehicle(
        name="lopsided",
        mass_kg=1.3,
        inertia_kgm2=(0.02, 0.05, 0.09),
        arm_m=0.3,
        drag_translation_npmps=(0.2, 0.5, 0.9),
        drag_rotation_nmpradps=(0.01, 0.02, 0.03),
        hover_thrust=0.5,
        tilt={"delay_s": 0.05, "natural_frequency_radps": 12, "damping": 0.6},
        yaw={"delay_s": 0.1, "natural_frequency_radps": 4, "damping": 0.6},
    )


@pytest.fixture
def dragless(lopsided: Vehicle) -> Vehicle:
    none = (0.0, 0.0, 0.0)
    return lopsided.model_copy(
        update={"drag_translation_npmps": none, "drag_rotation_nmpradps": none}
    )


def test_free_spin_conserves_energy_and_angular_momentum(dragless: Vehicle) -> None:
    """An asymmetric body spins without torque near its unstable middle axis; momentum is in NED."""
    inertia = np.array(dragless.inertia_kgm2)

    def energy_and_momentum(state: Array) -> tuple[float, Array]:
        rates, height = state[RATES], -state[POSITION][2]
        speed = np.linalg.norm(state[VELOCITY])
        mechanical = dragless.mass_kg * (0.5 * speed**2 + dragless.gravity_mps2 * height)
        return mechanical + 0.5 * rates @ (inertia * rates), rotation(state).apply(inertia * rates)

    state = state_of([0.1, 0.2, 0.3, 0.05, 2.0, 0.02, 1.0, -2.0, 0.5, 0, 0, 0])
    energy, momentum = energy_and_momentum(state)
    state = fly(state, NO_INPUT, pack(dragless), 10.0, 0.001)
    energy_after, momentum_after = energy_and_momentum(state)
    assert energy_after == pytest.approx(energy, abs=1e-8)  # of up to 6 kJ falling
    assert_allclose(momentum_after, momentum, atol=1e-11)
    assert np.linalg.norm(state[ATTITUDE]) == pytest.approx(1.0, abs=1e-15)


def test_acceleration_agrees_with_newtons_law(lopsided: Vehicle) -> None:
    """m a = m g + R (lift along -z - (D + q |u|) u), u = R^T (v - wind), with SciPy's rotation."""
    wind, inputs = np.array([2.0, -1.0, 0.5]), np.array([15.0, 0.1, -0.2, 0.05])
    parameters = pack(lopsided)
    parameters[12] = 0.3
    for state in quaternion_state(random_states(5, 0)):
        turn = rotation(state).as_matrix()
        through_air = turn.T @ (state[VELOCITY] - wind)
        drag = (lopsided.drag_translation_npmps + 0.3 * np.abs(through_air)) * through_air
        force = turn @ ([0, 0, -15.0] - drag)
        expected = force / lopsided.mass_kg + [0, 0, lopsided.gravity_mps2]
        slope = derivative(state, inputs, parameters, wind)
        assert_allclose(slope[VELOCITY], expected, rtol=1e-12)
        assert_allclose(slope[POSITION], state[VELOCITY])


def manoeuvre(vehicle: Vehicle, seed: int) -> Callable[[float], Array]:
    """Smooth random inputs: three sines each, gentle enough to stay off the singularity."""
    generator = np.random.default_rng(seed)
    size = np.array([3.0, 0.08, 0.08, 0.03])[:, None] * generator.uniform(-1, 1, (4, 3))
    frequency = generator.uniform(2.0, 9.0, (4, 3))
    phase = generator.uniform(0, 2 * np.pi, (4, 3))
    swing = lambda t: (size * np.sin(frequency * t + phase)).sum(axis=1)  # noqa: E731
    return lambda time_s: hover_input(vehicle) + swing(time_s)


@pytest.mark.parametrize("seed", [1, 2])
def test_euler_and_quaternion_models_fly_the_same_manoeuvre(lopsided: Vehicle, seed: int) -> None:
    euler, quaternion = np.zeros(12), quaternion_state(np.zeros(12))
    inputs, parameters = manoeuvre(lopsided, seed), pack(lopsided)
    wind, steepest, drift = np.array([1.0, -2.0, 0.3]), 0.0, 0.0
    for k in range(3000):
        euler = step(euler, inputs(k * 0.001), parameters, 0.001, wind)
        quaternion = step(quaternion, inputs(k * 0.001), parameters, 0.001, wind)
        steepest = max(steepest, abs(euler[1]), abs(euler[0]))
        drift = max(drift, float(np.abs(quaternion - quaternion_state(euler))[4:].max()))
    assert 0.2 < steepest < 1.4  # a large manoeuvre, away from the singularity
    assert drift < 1e-9
    turned = Rotation.from_euler("ZYX", euler[[2, 1, 0]]).inv() * rotation(quaternion)
    assert turned.magnitude() < 1e-9


def test_rk4_global_error_falls_with_the_fourth_power(lopsided: Vehicle) -> None:
    """Against DOP853 at 1e-13: halving the step divides the error by 16."""
    inputs, parameters = hover_input(lopsided) + np.array([1, 0.05, -0.04, 0.02]), pack(lopsided)
    start = state_of([0.2, -0.1, 0.4, 2.0, -1.5, 1.0, 3.0, 1.0, -1.0, 0, 0, 0])

    def slope(_: float, x: Array) -> Array:
        return derivative(x, inputs, parameters)

    exact = solve_ivp(slope, (0.0, 0.8), start, "DOP853", rtol=1e-13, atol=1e-13).y[:, -1]
    steps = np.array([0.08, 0.04, 0.02, 0.01])
    errors = [np.abs(fly(start, inputs, parameters, 0.8, h) - exact).max() for h in steps]
    order = np.polyfit(np.log(steps), np.log(errors), 1)[0]
    assert order == pytest.approx(4.0, abs=0.15)


def test_batches_and_compiled_steps_agree_with_python(lopsided: Vehicle) -> None:
    generator, parameters = np.random.default_rng(5), pack(lopsided)
    inputs = hover_input(lopsided) + generator.normal(0, 0.1, (4, 4))
    wind = generator.normal(0, 2.0, (3, 1, 3))
    for states in (random_states(4, 7), quaternion_state(random_states(4, 7))):
        slopes = derivative(states, inputs, parameters, wind)
        assert slopes.shape == (3, *states.shape)
        for i, j in np.ndindex(3, 4):
            one = derivative(states[j], inputs[j], parameters, wind[i, 0])
            assert_array_equal(slopes[i, j], one)
        after, scratch = np.empty_like(states.T), np.empty((RK4_SCRATCH_ROWS, *states.T.shape))
        hover = hover_input(lopsided)
        rk4_into(derivative_into, states.T, hover, STILL_AIR, parameters, 0.03, scratch, after)
        for before, expected in zip(states, after.T, strict=True):
            found = step(before, hover, parameters, 0.03)
            assert_allclose(found, expected, rtol=1e-14, atol=1e-14)


def test_arrays_of_wrong_length_are_refused(lopsided: Vehicle) -> None:
    for shapes in ((11, 4, 3), (12, 3, 3), (13, 4, 2)):
        state, inputs, wind = map(np.zeros, shapes)
        with pytest.raises(ValueError, match="12 or 13, 4 and 3"):
            derivative(state, inputs, pack(lopsided), wind)


# --- the linear model -----------------------------------------------------------------------------


PAPER = load("paper")
# Non-zeros that Eq. 16 prints. Its rows are interleaved [phi p psi r theta q x u (y lost) v z w];
# its v row reads -0.0161, a slip: a roll to the right accelerates to the right.
EQ_16 = {
    (PHI, TAU_X): 0.0488,
    (P, TAU_X): 0.8992,
    (PSI, TAU_Z): 0.1676,
    (R, TAU_Z): 3.1531,
    (THETA, TAU_Y): 0.0488,
    (Q, TAU_Y): 0.8992,
    (X, TAU_Y): -0.0004,
    (U, TAU_Y): -0.0161,
    (V, TAU_X): 0.0161,
    (Z, THRUST): -0.0120,
    (W, THRUST): -0.2350,
}


def test_sampled_model_agrees_with_scipy_and_eq_16() -> None:
    """The exponential is that of the augmented matrix (zero-order hold) at 0.1 s."""
    a, b = hover_matrices(PAPER)
    augmented = expm(0.1 * np.block([[a, b], [np.zeros((4, 16))]]))
    sampled_a, sampled_b = sampled_matrices(PAPER, 0.1)
    assert_allclose(sampled_a, augmented[:12, :12], atol=1e-13)
    assert_allclose(sampled_b, augmented[:12, 12:], atol=1e-13)
    for place, printed in EQ_16.items():
        assert sampled_b[place] == pytest.approx(printed, abs=0.5e-4), place
    others = np.ones_like(sampled_b, dtype=bool)
    others[tuple(np.transpose(list(EQ_16)))] = False
    others[10, TAU_X] = False  # the lost y row
    assert_array_equal(sampled_b[others], 0.0)
