"""One step compared with longer horizons: closed-loop eigenvalues from the model, and flights.

The law of each objective is linear while no input is at its bound; the slowest eigenvalue of its
closed loop gives the time an error lasts.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from offboard.analysis.page import BLUE, GREY, RED, Figure, curve, panels
from offboard.paper.closed_loop import (
    FIRST,
    Flights,
    FlightTask,
    PlantKind,
    cost_to_go,
    paper_model,
)
from offboard.paper.controller import PAPER_STEP_S, PaperSettings
from offboard.paper.tables import Table

Array = NDArray[np.float64]
Complexes = NDArray[np.complex128]

LONGEST = 20
ONE_STEP = "one step, Eqs. 33-35"


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


def modes_by_law() -> dict[str, Complexes]:
    """One step with both of the paper's weights, without R and R_du, cost-to-go, N = 1 ... 20."""
    final = PaperSettings()
    a, b = paper_model()
    q, r, s = (np.diag(part) for part in (final.fitness, final.energy, final.rate))
    q0, r0, s0 = (np.diag(part) for part in (FIRST.fitness, FIRST.energy, FIRST.rate))
    return {
        "one step, first weights": receding(a, b, q0, r0, s0, 1),
        ONE_STEP: receding(a, b, q, r, s, 1),
        "one step, Eq. 33, R = R_Δu = 0": receding(a, b, q, 0 * r, 0 * s, 1),
        "cost-to-go, Eqs. 33-35": receding(a, b, q, r, s, 1, cost_to_go(final)),
        **{f"N = {n}": receding(a, b, q, r, s, n) for n in range(1, LONGEST + 1)},
        "N = ∞": receding(a, b, q, r, s),
    }


def horizon_table(_: Flights) -> Table:
    """Slowest eigenvalues and time constants of the closed loops."""
    return Table(
        "Closed loop by objective and horizon",
        [
            {
                "law": name,
                "slowest |eigenvalue|": float(abs(modes[0])),
                "slowest time constant, s": time_constant_s(modes),
            }
            for name, modes in modes_by_law().items()
        ],
        "Position is four integrations from torque: in one step of 0.1 s a newton moves it by "
        "0.4 mm, so the cost of one step hardly depends on it. The same search over four inputs, "
        "with the Riccati solution instead of Q, takes the same time and is as fast as any.",
    )


def laws_figure(flights: Flights) -> Figure:
    """One step and cost-to-go, flown from 1 m off at hover: position errors."""
    drawing = panels(["1 m off at hover: position error, m"], "t, s", panel_px=300)
    for law, colour in (("one step", RED), ("cost-to-go", BLUE)):
        for plant in PlantKind:
            flight = flights(
                FlightTask(
                    PaperSettings(),
                    plant,
                    hover=True,
                    cost_to_go=law == "cost-to-go",
                    start_offset_m=(1.0, 0.0, 0.0),
                )
            )
            errors = np.maximum(flight.position_errors_m, 1e-9)  # a logarithmic axis has no zero
            dash = "solid" if plant is PlantKind.LINEAR else "dot"
            curve(drawing, 1, flight.times_s, errors, f"{law}, {plant}", colour, dash)
    slow_s, times = time_constant_s(modes_by_law()[ONE_STEP]), np.linspace(0, 100, 50)
    name = f"model: e^(-t / {slow_s:.1f} s)"
    curve(drawing, 1, times, np.exp(-times / slow_s), name, GREY, "dash")
    drawing.update_yaxes(type="log", range=[-5, 0.7])
    return Figure("One step and cost-to-go, flown", drawing, "Same weights (Eqs. 33-35) and swarm.")
