"""Why one step is not enough: closed-loop eigenvalues from the model alone, nothing flown.

The unconstrained law of each objective is linear; its slowest eigenvalue says how long an error
lasts. Knows the model and the weights; no swarm, because the box does not matter near the end.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_discrete_are
from scipy.optimize import differential_evolution

from offboard.control.riccati import cost_to_go
from offboard.model.state import PHI, TAU_X, P, V, Y
from offboard.paper.law import PAPER_STEP_S, PaperSettings
from offboard.paper.plant import paper_model
from offboard.paper.study.table import Column, Row, Table

Array = NDArray[np.float64]
Complexes = NDArray[np.complex128]

LONGEST = 20
_LATERAL = (PHI, P, V, Y)  # y, v, phi, p answer to tau_x alone; x and the rest mirror it
_RATIOS = (1, 2, 5, 10, 20, 40, 80)


@dataclass(frozen=True, slots=True)
class Modes:
    """Eigenvalues of the closed loop, largest magnitude first."""

    name: str
    eigenvalues: Complexes

    @property
    def slowest(self) -> float:
        return float(abs(self.eigenvalues[0]))

    @property
    def time_constant_s(self) -> float:
        """Of the slowest mode; infinite where it does not decay."""
        return -PAPER_STEP_S / math.log(self.slowest) if self.slowest < 1 else math.inf


def extended(dynamics: Array, inputs: Array) -> tuple[Array, Array]:
    """A (n + m, n + m) and B of [x, u(k-1)]: R_du needs the input applied last."""
    states, count = inputs.shape
    a = np.zeros((states + count, states + count))
    a[:states, :states] = dynamics
    return a, np.vstack([inputs, np.eye(count)])


def receding(
    dynamics: Array,
    inputs: Array,
    fitness: Array,
    energy: Array,
    rate: Array,
    steps: int,
    terminal: Array | None = None,
) -> Complexes:
    """Eigenvalues under the first input of the optimal `steps`, Eq. 21 at each of them.

    fitness (n, n) on x(k+1) ... x(k+N), the last replaced by `terminal`; energy, rate (m, m).
    """
    states = len(dynamics)
    a, b = extended(dynamics, inputs)
    weight = np.zeros_like(a)
    weight[:states, :states] = fitness
    last = np.zeros_like(a)
    last[:states, :states] = fitness if terminal is None else terminal
    # u - u(k-1) couples input and state: u'(R + R_du)u - 2 u'R_du u(k-1) + u(k-1)'R_du u(k-1)
    held = np.zeros_like(a)
    held[states:, states:] = rate
    cross = np.zeros_like(b)
    cross[states:] = -rate
    to_go = last
    for step in range(steps):
        if step:
            to_go = to_go + weight
        curvature = energy + rate + b.T @ to_go @ b
        gain = np.linalg.solve(curvature, b.T @ to_go @ a + cross.T)
        to_go = held + a.T @ to_go @ a - gain.T @ curvature @ gain
        to_go = 0.5 * (to_go + to_go.T)
    return _sorted(a - b @ gain)


def endless(
    dynamics: Array, inputs: Array, fitness: Array, energy: Array, rate: Array
) -> Complexes:
    """Eigenvalues for an infinite horizon of the same stage cost (Riccati)."""
    states = len(dynamics)
    a, b = extended(dynamics, inputs)
    weight = np.zeros_like(a)
    weight[:states, :states] = fitness
    weight[states:, states:] = rate
    cross = np.zeros_like(b)
    cross[states:] = -rate
    p = solve_discrete_are(a, b, weight, energy + rate, s=cross)
    gain = np.linalg.solve(energy + rate + b.T @ p @ b, b.T @ p @ a + cross.T)
    return _sorted(a - b @ gain)


def study(settings: PaperSettings, first: PaperSettings) -> list[Modes]:
    """One step with both of the paper's weights, without R and R_du, cost-to-go, N = 1 ... 20."""
    a, b = paper_model()
    q, r, s = (np.diag(part) for part in (settings.fitness, settings.energy, settings.rate))
    q0, r0, s0 = (np.diag(part) for part in (first.fitness, first.energy, first.rate))
    modes = [
        Modes("one step, first weights", receding(a, b, q0, r0, s0, 1)),
        Modes("one step, Eqs. 33-35", receding(a, b, q, r, s, 1)),
        Modes("one step, Eq. 33, R = R_Δu = 0", receding(a, b, q, 0 * r, 0 * s, 1)),
        Modes("cost-to-go, Eqs. 33-35", receding(a, b, q, r, s, 1, cost_to_go(a, b, q, r))),
    ]
    modes += [Modes(f"N = {n}", receding(a, b, q, r, s, n)) for n in range(1, LONGEST + 1)]
    return [*modes, Modes("N = ∞", endless(a, b, q, r, s))]


def horizon_table(modes: list[Modes]) -> Table:
    """Slowest eigenvalues and time constants (s) of the closed loops."""
    rows: list[Row] = [
        {
            "law": mode.name,
            "slowest": mode.slowest,
            "time_constant_s": mode.time_constant_s if mode.slowest < 1 else None,
            "four_slowest": ", ".join(_text(value) for value in mode.eigenvalues[:4]),
        }
        for mode in modes
    ]
    columns = (
        ("law", "law"), ("slowest", "slowest |eigenvalue|"),
        ("time_constant_s", "slowest time constant, s"), ("four_slowest", "four slowest"),
    )  # fmt: skip
    notes = (
        "Position is four integrations from torque: one step of 0.1 s moves it by 0.4 mm per "
        "newton, so one step's cost hardly sees it. The same 4-dimensional search with the "
        "Riccati solution in the place of Q does, at the same price.",
    )
    return Table("Closed loop by objective and horizon", [Column(*p) for p in columns], rows, notes)


def weights_table(settings: PaperSettings, seed: int = 0) -> Table:
    """What diagonal weights alone can do for one step: the lateral loop, y over v from 1 to 80."""
    a, b = paper_model()
    lateral = list(_LATERAL)
    a, b = a[np.ix_(lateral, lateral)], b[lateral, TAU_X : TAU_X + 1]
    fitness = np.array(settings.fitness)[lateral]
    energy, rate = np.eye(1) * settings.energy[TAU_X], np.eye(1) * settings.rate[TAU_X]

    def modes(name: str, diagonal: Array) -> Modes:
        return Modes(name, receding(a, b, np.diag(diagonal), energy, rate, 1))

    tried = [
        modes(f"Q_y = {ratio} Q_v", np.array([*fitness[:3], ratio * fitness[2]]))
        for ratio in _RATIOS
    ]
    found = differential_evolution(
        lambda exponents: modes("", 10.0**exponents).slowest,
        [(-3.0, 7.0)] * len(lateral), seed=seed, maxiter=150, tol=1e-8,
    )  # fmt: skip
    best = 10.0**found.x
    shown = ", ".join(f"{weight:.3g}" for weight in best)
    tried.append(modes(f"searched: Q_φ, Q_p, Q_v, Q_y = {shown}", best))
    rows: list[Row] = [
        {
            "weights": mode.name,
            "slowest": mode.slowest,
            "time_constant_s": mode.time_constant_s if mode.slowest < 1 else None,
        }
        for mode in tried
    ]
    columns = (
        ("weights", "diagonal weights"), ("slowest", "slowest |eigenvalue|"),
        ("time_constant_s", "slowest time constant, s"),
    )  # fmt: skip
    notes = (
        "With Eq. 33's equal weights on y and v even R = R_Δu = 0 does not help. Unequal ones do: "
        "in one step four diagonal weights are four feedback gains in disguise, and any stable "
        "pole placement is within reach of a search over them. Towards Q_y = 40 Q_v the loop gets "
        "slower again, then unstable. Such weights no longer mean what they say, and what is found "
        "holds inside the box only; the cost-to-go needs no search.",
    )
    return Table("One step, other diagonal weights", [Column(*p) for p in columns], rows, notes)


def _sorted(matrix: Array) -> Complexes:
    eigenvalues = np.asarray(np.linalg.eigvals(matrix), np.complex128)
    return eigenvalues[np.argsort(-np.abs(eigenvalues), kind="stable")]


def _text(value: complex) -> str:
    if abs(value.imag) < 1e-9:
        return f"{value.real:.5f}"
    return f"{value.real:.4f}{value.imag:+.4f}i"
