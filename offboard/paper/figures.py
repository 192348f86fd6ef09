"""Figures 4 to 17 of the paper, drawn from flights and searches that are computed here."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import plotly.graph_objects as go
from numpy.typing import NDArray
from plotly.subplots import make_subplots

from offboard.analysis.page import (
    BLUE,
    GREY,
    INK,
    RED,
    STYLE,
    Figure,
    coordinates,
    curve,
    panels,
)
from offboard.control.quadratic import ExactMinimum
from offboard.control.swarm import Swarm
from offboard.model.rigid_body import PSI, U, X
from offboard.paper import closed_loop
from offboard.paper.closed_loop import Flights, FlightTask, PlantKind, damped, paper_model
from offboard.paper.law import PAPER_STEP_S, PaperLaw, PaperSettings
from offboard.paper.printed import BEST_DAMPING, LEAST_DAMPING, TABLE_2, UNDAMPED

Array = NDArray[np.float64]

MIDWAY = 509  # of 1000 steps
SHOWN_ITERATIONS = (1, 5, 20, 150)  # Fig. 4 a-d
UNDAMPED_FLIGHT = "λ = 1, first weights"
DAMPED_FLIGHT = "λ = 0.65, first weights"
FINAL_FLIGHT = "λ = 0.65, Eqs. 33-35"
SETTINGS = {
    UNDAMPED_FLIGHT: damped(UNDAMPED),
    DAMPED_FLIGHT: damped(BEST_DAMPING),
    FINAL_FLIGHT: PaperSettings(),
}

_COLOURS = {PlantKind.LINEAR: BLUE, PlantKind.NONLINEAR: RED}
_CONTROLS, _VELOCITIES, _POSITIONS, _SPREADS = "controls", "u, v, w", "x, y, z, ψ", "ε"
_PANELS = {
    _CONTROLS: ("f_t, N", "τ_x, N", "τ_y, N", "τ_z, N m"),
    _VELOCITIES: ("u, m/s", "v, m/s", "w, m/s"),
    _POSITIONS: ("x, m", "y, m", "z, m", "ψ, °"),
    _SPREADS: ("ε",),
}
_UNDAMPED, _BEST = TABLE_2[UNDAMPED], TABLE_2[BEST_DAMPING]
# Number -> flight (on both plants), panels that are shown, caption
FLOWN = {
    7: (UNDAMPED_FLIGHT, _CONTROLS, "The distortion that the paper describes: the undamped swarm "
        "ends anywhere in a flat valley of the cost."),
    8: (UNDAMPED_FLIGHT, _VELOCITIES, "The states follow nevertheless: the plant filters the "
        "noise."),
    9: (UNDAMPED_FLIGHT, _POSITIONS, "Positions lag by tens of metres: with Q = I the cost of one "
        "step hardly depends on them."),
    10: (UNDAMPED_FLIGHT, _SPREADS, f"ε at λ = 1; printed mean {_UNDAMPED.mean:.4f}, least "
         f"{_UNDAMPED.least:.4f}, greatest {_UNDAMPED.greatest:.4f}."),
    11: (DAMPED_FLIGHT, _SPREADS, f"ε at λ = 0.65; printed mean {_BEST.mean:.4e}. Its floor is "
         "the rounding of J, not the swarm."),
    12: (DAMPED_FLIGHT, _CONTROLS, "The same flight with λ = 0.65: smooth."),
    13: (DAMPED_FLIGHT, _VELOCITIES, "Hardly different from Fig. 8, as in the paper."),
    14: (DAMPED_FLIGHT, _POSITIONS, "Hardly different from Fig. 9, as in the paper."),
    15: (FINAL_FLIGHT, _CONTROLS, "Weights of Eqs. 33-35."),
    16: (FINAL_FLIGHT, _VELOCITIES, "Velocities now follow the reference closely."),
    17: (FINAL_FLIGHT, _POSITIONS, "The steady error that the conclusions mention: a time constant "
         "of 39 s. On the nonlinear plant tilt reduces the lift, which adds a height error."),
}  # fmt: skip


def search_motion(_: Flights) -> Figure:
    """Draw Fig. 4: the particles in [f_t, tau_x], one row per lambda, four iterations each."""
    dampings = (BEST_DAMPING, UNDAMPED, LEAST_DAMPING)
    titles = [f"λ = {damping:g}, iteration {n}" for damping in dampings for n in SHOWN_ITERATIONS]
    drawing = make_subplots(
        rows=len(dampings), cols=len(SHOWN_ITERATIONS), shared_xaxes="all", shared_yaxes="all",
        subplot_titles=titles, horizontal_spacing=0.015, vertical_spacing=0.07,
    )  # fmt: skip
    for row, damping in enumerate(dampings, 1):
        for column, traces in enumerate(_search(damped(damping)), 1):
            drawing.add_traces(traces, rows=row, cols=column)
    drawing.update_layout(
        template=STYLE, height=110 + 240 * len(dampings), showlegend=False,
        margin={"t": 60, "b": 50},
    )  # fmt: skip
    drawing.update_annotations(font_size=12)
    drawing.update_xaxes(title_text="f_t, N", row=len(dampings))
    drawing.update_yaxes(title_text="τ_x, N", col=1)
    caption = "Dots: particles; cross: the exact optimum; the box is Eq. 26. Two of four inputs."
    return Figure("Fig. 4: the search of the swarm", drawing, caption, width_px=760)


def _search(settings: PaperSettings) -> Iterator[list[go.Scatter]]:
    """Yield the drawing of a search midway along the path of Figs. 5-6, at each of
    SHOWN_ITERATIONS: the bounds, the particles and the exact optimum."""
    tracked = closed_loop.reference_states(hover=False, steps=1000)
    law = PaperLaw(*paper_model(), settings)
    state = tracked[0]
    for following in tracked[1 : MIDWAY + 2]:
        move = law.move(state, following)
        state = move.following
    problem = move.problem
    (left, low), (right, high) = problem.lower[:2], problem.upper[:2]
    corners = [left, right, right, left, left], [low, low, high, high, low]
    optimum = ExactMinimum(4).minimise(problem)[:, None]
    cross = {"color": RED, "size": 10, "symbol": "cross-thin", "line": {"width": 2, "color": RED}}
    dot = {"color": BLUE, "size": 5, "opacity": 0.7}
    swarm = Swarm(settings.swarm, problem.lower, problem.upper, np.random.default_rng(0))
    for iteration in SHOWN_ITERATIONS:
        swarm.tell_all(problem, min(iteration, settings.swarm.iterations) - 1)
        drawn: list[tuple[Any, dict[str, Any]]] = [
            (corners, {"mode": "lines", "line": {"color": GREY, "width": 1}, "hoverinfo": "skip"}),
            (swarm.ask().T, {"mode": "markers", "name": "particle", "marker": dot}),
            (optimum, {"mode": "markers", "name": "optimum", "marker": cross}),
        ]
        yield [go.Scatter(x=coordinates(x[0]), y=coordinates(x[1]), **style) for x, style in drawn]


def reference_states(_: Flights) -> Figure:
    """Draw Fig. 5: the reference of position, heading and velocity over time."""
    tracked = closed_loop.reference_states(hover=False, steps=1000)
    drawing = panels(_PANELS[_POSITIONS] + _PANELS[_VELOCITIES], "t, s", panel_px=100)
    columns, times_s = _columns(tracked), PAPER_STEP_S * np.arange(len(tracked))
    for panel, column in enumerate((*columns[_POSITIONS], *columns[_VELOCITIES]), 1):
        curve(drawing, panel, times_s, column, "reference", INK)
    drawing.update_layout(showlegend=False, margin={"b": 50})
    caption = "The paper draws its path without numbers; this one is similar."
    return Figure("Fig. 5: reference of the states", drawing, caption)


def reference_path(flights: Flights) -> Figure:
    """Draw Fig. 6: the path in space, with two flights and their names."""
    tracked = closed_loop.reference_states(hover=False, steps=1000)
    drawing = go.Figure()
    lines = [("reference", tracked, INK, 4)]
    for name, colour in ((DAMPED_FLIGHT, BLUE), (FINAL_FLIGHT, RED)):
        lines.append((name, flights(FlightTask(SETTINGS[name])).states, colour, 3))
    for name, states, colour, width in lines:
        line = {"color": colour, "width": width}
        drawing.add_scatter3d(**_in_space(states[::4]), mode="lines", name=name, line=line)
    drawing.add_scatter3d(
        **_in_space(tracked[[0, -1]]), mode="markers+text", text=["S", "D"],
        textposition="top center", showlegend=False, marker={"size": 4, "color": INK},
    )  # fmt: skip
    scene = {
        "xaxis_title": "north, m", "yaxis_title": "east, m", "zaxis_title": "height, m",
        "aspectmode": "manual", "aspectratio": {"x": 1.5, "y": 1.5, "z": 0.6},
        "camera": {"eye": {"x": 1.2, "y": 1.3, "z": 0.8}, "center": {"z": -0.2}},
    }  # fmt: skip
    drawing.update_layout(template=STYLE, height=560, scene=scene, margin={"l": 0, "b": 40})
    caption = "S start, D destination. Flown on the linear plant."
    return Figure("Fig. 6: the path", drawing, caption, width_px=560)


def _in_space(states: Array) -> dict[str, NDArray[np.float32]]:
    """Return north, east and height of states (N, 12)."""
    x, y, z = (coordinates(column) for column in (states[:, X : X + 3] * (1, 1, -1)).T)
    return {"x": x, "y": y, "z": z}


def flown_figure(number: int, flights: Flights) -> Figure:
    """Draw one of Figs. 7 to 17 (`FLOWN`): a flight on both plants and the reference of states."""
    name, shown, caption = FLOWN[number]
    flown = {plant: flights(FlightTask(SETTINGS[name], plant)) for plant in PlantKind}
    drawing = panels(_PANELS[shown], "t, s", 300 if shown == _SPREADS else 150)
    first = next(iter(flown.values()))
    lines = [(f"{p} plant", f, f.states, _COLOURS[p], "solid") for p, f in flown.items()]
    if shown in (_VELOCITIES, _POSITIONS):
        lines.insert(0, ("reference", first, first.tracked, INK, "dash"))
    for label, flight, states, colour, dash in lines:
        columns = _columns(states) | {_CONTROLS: [*flight.inputs.T], _SPREADS: [flight.spreads]}
        for panel, column in enumerate(columns[shown], 1):
            curve(drawing, panel, flight.times_s[: len(column)], column, label, colour, dash)
    if shown == _SPREADS:
        drawing.update_yaxes(type="log")
    return Figure(f"Fig. {number}: {shown}, {name}", drawing, caption)


def _columns(states: Array) -> dict[str, list[Array]]:
    positions = [*states[:, X : X + 3].T, np.degrees(states[:, PSI])]
    return {_POSITIONS: positions, _VELOCITIES: [*states[:, U : U + 3].T]}
