"""The linear model against hand-written physics, finite differences, expm, flight and Eq. 16."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.linalg import expm

from offboard.model.rigid_body import (
    PHI,
    PSI,
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
    hover_input,
    hover_matrices,
    pack,
    sampled_matrices,
)
from offboard.model.vehicle import Vehicle
from offboard.paper.plant import follow

# Every non-zero Eq. 16 prints. Its rows are interleaved [phi p psi r theta q x u (y lost) v z w];
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


def test_hover_matrices_are_the_physics_written_by_hand(paper_vehicle: Vehicle) -> None:
    """Kinematics, gravity tilting into the lateral axes, drag over mass, inputs over inertia."""
    a, b = np.zeros((12, 12)), np.zeros((12, 4))
    a[0:3, 3:6] = a[9:12, 6:9] = np.eye(3)
    a[U, THETA], a[V, PHI] = -9.81, 9.81
    a[3:6, 3:6] = np.diag([-0.1 / 0.0196, -0.1 / 0.0196, -0.1 / 0.0264])
    a[6:9, 6:9] = np.diag([-0.5 / 0.4] * 3)
    b[W, THRUST] = -1 / 0.4
    b[P, TAU_X] = b[Q, TAU_Y] = 0.225 / 0.0196
    b[R, TAU_Z] = 1 / 0.0264
    model_a, model_b = hover_matrices(paper_vehicle)
    assert_allclose(model_a, a, rtol=1e-14)
    assert_allclose(model_b, b, rtol=1e-14)


def test_zero_order_hold_is_the_exponential_of_the_augmented_matrix(
    paper_vehicle: Vehicle,
) -> None:
    a, b = hover_matrices(paper_vehicle)
    augmented = expm(0.1 * np.block([[a, b], [np.zeros((4, 16))]]))
    sampled_a, sampled_b = sampled_matrices(paper_vehicle, 0.1)
    assert_allclose(sampled_a, augmented[:12, :12], atol=1e-13)
    assert_allclose(sampled_b, augmented[:12, 12:], atol=1e-13)


def test_the_sampled_model_predicts_small_flights(paper_vehicle: Vehicle) -> None:
    """The nonlinear vehicle, 1e-5 from hover, is where the sampled model says after 0.1 s."""
    generator = np.random.default_rng(8)
    state, deviation = 1e-5 * generator.normal(size=12), 1e-5 * generator.normal(size=4)
    sampled_a, sampled_b = sampled_matrices(paper_vehicle, 0.1)
    predicted = sampled_a @ state + sampled_b @ deviation
    inputs, scratch = hover_input(paper_vehicle) + deviation, np.empty((RK4_SCRATCH_ROWS, 12))
    follow(state, inputs, np.zeros(3), pack(paper_vehicle), 0.005, 20, scratch)
    assert_allclose(state, predicted, atol=2e-9)


def test_eq_16_is_reproduced_to_four_digits_at_a_tenth_of_a_second(paper_vehicle: Vehicle) -> None:
    _, sampled_b = sampled_matrices(paper_vehicle, 0.1)
    for place, printed in EQ_16.items():
        assert sampled_b[place] == pytest.approx(printed, abs=0.5e-4), place
    others = np.ones_like(sampled_b, dtype=bool)
    others[tuple(np.transpose(list(EQ_16)))] = False
    others[10, TAU_X] = False  # the lost y row
    assert_array_equal(sampled_b[others], 0.0)
