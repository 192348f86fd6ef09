"""Closed-loop eigenvalues by horizon, against closed loops that are simulated and against LQR."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.linalg import solve_discrete_are

from offboard.control.gains import riccati
from offboard.paper.law import PaperSettings
from offboard.paper.plant import paper_model
from offboard.paper.study.horizon import receding, study

FINAL = PaperSettings()
Q, R, RATE = (np.diag(part) for part in (FINAL.fitness, FINAL.energy, FINAL.rate))
NONE = np.zeros((4, 4))


def slowest_s(eigenvalues: np.ndarray) -> float:
    return -0.1 / math.log(abs(eigenvalues[0]))


@pytest.mark.parametrize(
    ("steps", "time_constant_s"), [(1, 39.16), (5, 5.46), (10, 1.69), (20, 1.07)]
)
def test_time_constant_by_horizon(steps: int, time_constant_s: float) -> None:
    found = slowest_s(receding(*paper_model(), Q, R, RATE, steps))
    assert found == pytest.approx(time_constant_s, rel=5e-3)


def test_one_step_without_control_weights_is_no_faster() -> None:
    assert slowest_s(receding(*paper_model(), Q, 0 * R, NONE, 1)) > 39.0


def test_cost_to_go_without_rate_is_lqr() -> None:
    a, b = paper_model()
    p = solve_discrete_are(a, b, Q, R)
    lqr = a - b @ np.linalg.solve(R + b.T @ p @ b, b.T @ p @ a)
    found = receding(a, b, Q, R, NONE, 1, riccati(a, b, Q, R))
    expected = np.sort(np.abs(np.linalg.eigvals(lqr)))[::-1]
    np.testing.assert_allclose(np.abs(found)[:12], expected, rtol=1e-6)


def test_a_long_horizon_is_the_endless_one() -> None:
    long, endless = receding(*paper_model(), Q, R, RATE, 300), receding(*paper_model(), Q, R, RATE)
    np.testing.assert_allclose(np.abs(long)[:6], np.abs(endless)[:6], rtol=1e-4)


def test_two_steps_against_least_squares() -> None:
    """The first input of the stacked two-step problem, solved without a recursion."""
    a, b = paper_model()
    root_q, root_r, root_s = np.sqrt(Q), np.sqrt(R), np.sqrt(RATE)
    zero = np.zeros((4, 4))
    rows = np.vstack(
        [
            np.hstack([root_q @ b, np.zeros((12, 4))]),
            np.hstack([root_q @ a @ b, root_q @ b]),
            np.hstack([root_r, zero]),
            np.hstack([zero, root_r]),
            np.hstack([root_s, zero]),
            np.hstack([-root_s, root_s]),
        ]
    )
    from_state = np.vstack([root_q @ a, root_q @ a @ a, np.zeros((16, 12))])
    from_held = np.zeros((40, 4))
    from_held[32:36] = -root_s
    first = -np.linalg.pinv(rows)[:4] @ np.hstack([from_state, from_held])
    closed = np.block([[a + b @ first[:, :12], b @ first[:, 12:]], [first]])
    expected = np.sort(np.abs(np.linalg.eigvals(closed)))[::-1]
    found = np.abs(receding(a, b, Q, R, RATE, 2))
    np.testing.assert_allclose(found[:8], expected[:8], rtol=1e-6)


def test_study_names_every_horizon() -> None:
    names = [mode.name for mode in study(FINAL, PaperSettings.first_configuration())]
    assert [f"N = {n}" for n in range(1, 21)] == [n for n in names if n[4:].isdecimal()]
    assert names[-1] == "N = ∞"
