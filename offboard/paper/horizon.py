"""One step compared with longer horizons: closed-loop eigenvalues from the model, and flights.

The law of each objective is linear while no input is at its bound; the slowest eigenvalue of its
closed loop gives the time an error lasts.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag
from scipy.optimize import differential_evolution

from offboard.analysis.page import BLUE, GREY, INK, RED, Figure, curve, panels
from offboard.model.rigid_body import PHI, TAU_X, P, V, Y
from offboard.paper.closed_loop import Flights, FlightTask, LawName, PathName, cost_to_go
from offboard.paper.figures import position_error
from offboard.paper.law import PAPER_STEP_S, PaperSettings
from offboard.paper.plant import PlantKind, paper_model
from offboard.paper.tables import Entries, Table

Array = NDArray[np.float64]
Complexes = NDArray[np.complex128]

LONGEST = 20
_LATERAL = [PHI, P, V, Y]  # y, v, phi, p depend on tau_x alone; x and the others mirror them
_RATIOS = (1, 2, 5, 10, 20, 40, 80)
ONE_STEP, TO_GO, ENDLESS = "one step, Eqs. 33-35", "cost-to-go, Eqs. 33-35", "N = ∞"


def receding(
    dynamics: Array,
    inputs: Array,
    fitness: Array,
    energy: Array,
    rate: Array,
    steps: int | None = None,
    terminal: Array | None = None,
) -> Complexes:
    """Eigenvalues of the loop closed by the first input of the optimum over `steps` steps, largest
    magnitude first.

    Eq. 21 at each step: fitness (n, n) weighs x(k+1) ... x(k+N), `terminal` replaces it at the
    last; energy, rate (m, m). Without `steps` the horizon is infinite. The state is z = [x, u(k-1)]
    because R_du weighs u(k) - u(k-1): a stage costs z'Wz + u'(R + R_du)u + 2 z'Su.
    """
    n, m = inputs.shape
    a, b = block_diag(dynamics, np.zeros((m, m))), np.vstack([inputs, np.eye(m)])
    weight, effort = block_diag(fitness, rate), energy + rate
    cross = np.vstack([np.zeros((n, m)), -rate])
    if steps is None:
        import control  # takes a second: only where something is designed

        to_go = control.dlqr(a, b, weight, effort, cross)[1]
    else:
        to_go = block_diag(fitness if terminal is None else terminal, np.zeros((m, m)))
    for remaining in range(steps or 1, 0, -1):
        curvature = effort + b.T @ to_go @ b
        gain = np.linalg.solve(curvature, b.T @ to_go @ a + cross.T)
        if remaining > 1:
            before = weight + a.T @ to_go @ a - gain.T @ curvature @ gain
            to_go = 0.5 * (before + before.T)
    found = np.asarray(np.linalg.eigvals(a - b @ gain), np.complex128)
    return found[np.argsort(-np.abs(found), kind="stable")]


def time_constant_s(modes: Complexes) -> float:
    """Time constant of the slowest mode; infinite where it does not decay."""
    slowest = float(abs(modes[0]))
    return -PAPER_STEP_S / math.log(slowest) if slowest < 1 else math.inf


def modes_by_law(first: PaperSettings) -> dict[str, Complexes]:
    """One step with both of the paper's weights, without R and R_du, cost-to-go, N = 1 ... 20."""
    final = PaperSettings()
    a, b = paper_model()
    q, r, s = (np.diag(part) for part in (final.fitness, final.energy, final.rate))
    q0, r0, s0 = (np.diag(part) for part in (first.fitness, first.energy, first.rate))
    return {
        "one step, first weights": receding(a, b, q0, r0, s0, 1),
        ONE_STEP: receding(a, b, q, r, s, 1),
        "one step, Eq. 33, R = R_Δu = 0": receding(a, b, q, 0 * r, 0 * s, 1),
        TO_GO: receding(a, b, q, r, s, 1, cost_to_go(final)),
        **{f"N = {n}": receding(a, b, q, r, s, n) for n in range(1, LONGEST + 1)},
        ENDLESS: receding(a, b, q, r, s),
    }


def _slowest(modes: Complexes) -> Entries:
    """The cells that describe the slowest mode of a closed loop."""
    constant_s = time_constant_s(modes)
    return {
        "slowest": ("slowest |eigenvalue|", float(abs(modes[0]))),
        "time_constant_s": (
            "slowest time constant, s",
            constant_s if math.isfinite(constant_s) else None,
        ),
    }


def horizon_table(flights: Flights) -> Table:
    """Slowest eigenvalues and time constants of the closed loops."""
    return Table.of(
        "Closed loop by objective and horizon",
        [
            {
                "law": ("law", name),
                **_slowest(modes),
                "four_slowest": ("four slowest", ", ".join(map(_text, modes[:4]))),
            }
            for name, modes in modes_by_law(flights.first).items()
        ],
        "Position is four integrations from torque: in one step of 0.1 s a newton moves it by "
        "0.4 mm, so the cost of one step hardly depends on it. The same search over four inputs, "
        "with the Riccati solution instead of Q, takes the same time and is as fast as any.",
    )


def horizon_figure(flights: Flights) -> Figure:
    """Slowest time constant over the horizon."""
    by_law = {name: time_constant_s(modes) for name, modes in modes_by_law(flights.first).items()}
    steps = list(range(1, LONGEST + 1))
    drawing = panels(("slowest time constant, s",), "horizon N, steps of 0.1 s", panel_px=300)
    values = [by_law[f"N = {n}"] for n in steps]
    curve(drawing, 1, steps, values, "N steps, Eqs. 33-35", BLUE, mode="lines+markers")
    curve(drawing, 1, [1, LONGEST], [by_law[ENDLESS]] * 2, ENDLESS, INK, "dash")
    diamond = {"size": 11, "color": RED, "symbol": "diamond"}
    name = "one step + cost-to-go"
    curve(drawing, 1, [1], [by_law[TO_GO]], name, RED, mode="markers", marker=diamond)
    drawing.update_yaxes(type="log", tickvals=[1, 2, 5, 10, 20, 50])
    caption = "Computed from the model. One step with the cost-to-go is as fast as any horizon."
    return Figure("Slowest time constant of the closed loop", drawing, caption)


def laws_figure(flights: Flights) -> Figure:
    """Both laws flown, from 1 m off at hover and along the path of Figs. 5-6: position errors."""
    titles = {"offset": "1 m off at hover: position error, m", "tour": "tour: position error, m"}
    drawing = panels(list(titles.values()), "t, s", panel_px=240)
    for panel, kind in enumerate(titles, 1):
        for law, colour in ((LawName.ONE_STEP, RED), (LawName.COST_TO_GO, BLUE)):
            for plant in PlantKind:
                task = FlightTask(PaperSettings(), plant, law=law)
                if kind == "offset":
                    task = replace(task, path=PathName.HOVER, start_offset_m=(1.0, 0.0, 0.0))
                position_error(drawing, panel, flights(task), law, plant, colour)
    slow_s, times = time_constant_s(modes_by_law(flights.first)[ONE_STEP]), np.linspace(0, 100, 50)
    name = f"model: e^(-t / {slow_s:.1f} s)"
    curve(drawing, 1, times, np.exp(-times / slow_s), name, GREY, "dash")
    drawing.update_yaxes(type="log", range=[-5, 0.7])
    caption = (
        "Same weights (Eqs. 33-35), swarm and box; the cost-to-go also gets a reference that the "
        "model can follow."
    )
    return Figure("One step and cost-to-go, flown", drawing, caption)


def weights_table(_: Flights) -> Table:
    """What diagonal weights alone achieve in one step: the lateral loop with y over v 1 to 80."""
    settings = PaperSettings()
    a, b = paper_model()
    a, b = a[np.ix_(_LATERAL, _LATERAL)], b[_LATERAL, TAU_X : TAU_X + 1]
    fitness = np.array(settings.fitness)[_LATERAL]
    energy, rate = np.eye(1) * settings.energy[TAU_X], np.eye(1) * settings.rate[TAU_X]

    def modes(diagonal: Array) -> Complexes:
        return receding(a, b, np.diag(diagonal), energy, rate, 1)

    tried = {
        f"Q_y = {ratio} Q_v": modes(np.array([*fitness[:3], ratio * fitness[2]]))
        for ratio in _RATIOS
    }
    found = differential_evolution(
        lambda exponents: float(abs(modes(10.0**exponents)[0])),
        [(-3.0, 7.0)] * len(_LATERAL), seed=0, maxiter=150, tol=1e-8,
    )  # fmt: skip
    best = 10.0**found.x
    weights = ", ".join(f"{weight:.3g}" for weight in best)
    tried[f"searched: Q_φ, Q_p, Q_v, Q_y = {weights}"] = modes(best)
    return Table.of(
        "One step, other diagonal weights",
        [
            {"weights": ("diagonal weights", name), **_slowest(found_modes)}
            for name, found_modes in tried.items()
        ],
        "With the equal weights of Eq. 33 on y and v even R = R_Δu = 0 does not help. Unequal ones "
        "do: in one step four diagonal weights determine four feedback gains, and a search over "
        "them reaches any stable pole placement. Towards Q_y = 40 Q_v the loop gets slower again, "
        "then unstable. Such weights no longer express what matters, and the result holds inside "
        "the box only; the cost-to-go needs no search.",
    )


def _text(value: complex) -> str:
    if abs(value.imag) < 1e-9:
        return f"{value.real:.5f}"
    return f"{value.real:.4f}{value.imag:+.4f}i"
