"""Extensions of the paper: horizons longer than one step, and the integral term and state limits
that its conclusions propose.

The law of each objective is linear while no input is at its bound. The slowest eigenvalue of its
closed loop determines how long an error lasts.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from offboard.analysis.page import BLUE, GREY, RED, Figure, curve, panels
from offboard.model.rigid_body import PHI, PSI, P, U, V, W
from offboard.paper.closed_loop import (
    FIRST,
    Flight,
    Flights,
    FlightTask,
    PlantKind,
    cost_to_go,
    paper_model,
)
from offboard.paper.law import PAPER_STEP_S, IntegralSettings, PaperSettings, StateLimits
from offboard.paper.tables import Row, Table

Array = NDArray[np.float64]
Complexes = NDArray[np.complex128]

LONGEST = 20
ONE_STEP = "one step, Eqs. 33-35"
# The time constant with Eq. 33's position weights, 39 s, is too long for an integral term
RAISED = PaperSettings(fitness=(1, 1, 25, 1, 1, 1, 20, 20, 5, 150, 150, 20))
INTEGRAL = RAISED.model_copy(update={"integral": IntegralSettings()})
LAWS = {"Eqs. 33-35": PaperSettings(), "position weights raised": RAISED, "integral": INTEGRAL}
CASES: dict[str, dict[str, Any]] = {
    "wind 2 m/s N, -1 m/s E": {"wind_ned_mps": (2.0, -1.0, 0.0)},
    "thrust 10 % weak": {"thrust_loss": 0.1},
}
LIMITS = StateLimits(
    tilt_rad=0.35, tilt_rate_radps=0.4, yaw_rate_radps=0.5, speed_mps=2.5, climb_mps=0.5
)
MARGIN = 0.05  # for errors of the linear model on the nonlinear plant
_STEADY_STEPS, _LAST_STEPS = 1500, 100


def receding(
    dynamics: Array,
    inputs: Array,
    fitness: Array,
    energy: Array,
    rate: Array,
    steps: int | None = None,
    terminal: Array | None = None,
) -> Complexes:
    """Return the eigenvalues of the loop that is closed by the first input of the optimum over
    `steps` steps, the largest magnitude first.

    Each step costs Eq. 21: fitness (n, n) weights x(k+1) ... x(k+N), `terminal` replaces it at the
    last step; energy, rate (m, m). Without `steps` the horizon is infinite. The state is
    z = [x, u(k-1)], because R_du weights u(k) - u(k-1): a stage costs
    z'Wz + u'(R + R_du)u + 2 z'Su.
    """
    n, m = inputs.shape
    a, b = block_diag(dynamics, np.zeros((m, m))), np.vstack([inputs, np.eye(m)])
    weight, effort = block_diag(fitness, rate), energy + rate
    cross = np.vstack([np.zeros((n, m)), -rate])
    if steps is None:
        import control  # takes a second: imported only for a design

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
    """Return the time constant of the slowest mode; infinite if it does not decay."""
    slowest = float(abs(modes[0]))
    return -PAPER_STEP_S / math.log(slowest) if slowest < 1 else math.inf


def modes_by_law() -> dict[str, Complexes]:
    """Return eigenvalues by law: one step with the paper's first and final weights, one step
    without R and R_du, cost-to-go, N = 1 ... 20, and the infinite horizon."""
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
    """Make the table of slowest eigenvalues and time constants of the closed loops."""
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
    """Make the figure of position errors of one step and cost-to-go, from 1 m off at hover."""
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


# ---------------------------------------------------------------------- integral term and limits


def integral_table(flights: Flights) -> Table:
    """Make the table of steady and greatest position errors of a hover of 150 s in wind or with
    weak thrust."""
    rows: list[Row] = []
    for case, disturbance in CASES.items():
        for plant in PlantKind:
            for law, settings in LAWS.items():
                task = FlightTask(settings, plant, hover=True, steps=_STEADY_STEPS, **disturbance)
                errors_m = flights(task).position_errors_m
                rows.append(
                    {
                        "hover, 150 s": case,
                        "plant": str(plant),
                        "law": law,
                        "steady position error, m": float(errors_m[-_LAST_STEPS:].mean()),
                        "greatest, m": float(errors_m.max()),
                    }
                )
    return Table(
        "Integral term",
        rows,
        "Flown by the controller paper_integral. With the position weights of Eq. 33 the integral "
        "would have a time constant of 79 s at best; hence the raised weights, which alone leave "
        "a steady error.",
    )


def limits_table(flights: Flights) -> Table:
    """Make the table of the greatest value of each limited state, and the number of samples above
    its limit, along the path of Figs. 5-6."""
    rows: list[Row] = []
    for plant in PlantKind:
        margin = MARGIN if plant is PlantKind.NONLINEAR else 0.0
        limited = LIMITS.model_copy(update={"margin": margin})
        for law, limits in {"free": None, "limited": limited}.items():
            flight = flights(FlightTask(PaperSettings(limits=limits), plant))
            for state, values in _limited_states(flight, plant).items():
                limit = float(getattr(LIMITS, state))
                rows.append(
                    {
                        "plant": str(plant),
                        "law": law,
                        "state": state,
                        "limit": limit,
                        "greatest": float(values.max()),
                        "samples over the limit": int(np.sum(values > limit * (1 + 1e-9))),
                        "of": len(values),
                    }
                )
    return Table(
        "State limits",
        rows,
        "Flown by the controller paper_limited. On the linear plant the limits hold exactly, by "
        "construction; on the nonlinear one a margin of 5 % covers what the model neglects. The "
        "reference requires more than the limits allow, so the tracking error grows.",
    )


def _limited_states(flight: Flight, plant: PlantKind) -> dict[str, Array]:
    """Return field of `StateLimits` -> greatest magnitude of the states it limits, (K + 1,)."""
    states = flight.states
    north, east = states[:, U], states[:, V]
    heading = states[:, PSI] if plant is PlantKind.NONLINEAR else np.zeros(len(states))
    along = np.cos(heading) * north + np.sin(heading) * east
    across = np.cos(heading) * east - np.sin(heading) * north
    return {
        "tilt_rad": np.abs(states[:, PHI:PSI]).max(axis=1),
        "tilt_rate_radps": np.abs(states[:, P : P + 2]).max(axis=1),
        "yaw_rate_radps": np.abs(states[:, P + 2]),
        "speed_mps": np.maximum(np.abs(along), np.abs(across)),
        "climb_mps": np.abs(states[:, W]),
    }
