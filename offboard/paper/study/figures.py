"""Figures 4 to 17 of the paper, from flights and searches computed here."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import plotly.graph_objects as go
from numpy.typing import NDArray
from plotly.subplots import make_subplots

from offboard.analysis.figure import (
    BLUE,
    GREEN,
    GREY,
    INK,
    RED,
    STYLE,
    Figure,
    coordinates,
    curve,
    panels,
)
from offboard.control.certificate import ExactMinimum
from offboard.control.swarm import QuadraticSwarm, RandomLanes
from offboard.model.state import PSI, U, X
from offboard.paper.law import PaperSettings
from offboard.paper.plant import PlantKind
from offboard.paper.study.closed_loop import Flight
from offboard.paper.study.peers import problems
from offboard.paper.trajectory import PathName, sampled_path

Array = NDArray[np.float64]

SHOWN_ITERATIONS = (1, 5, 20, 150)  # Fig. 4 a-d
UNDAMPED_FLIGHT = "λ = 1, first weights"
DAMPED_FLIGHT = "λ = 0.65, first weights"
FINAL_FLIGHT = "λ = 0.65, Eqs. 33-35"

_INPUTS = ("f_t, N", "τ_x, N", "τ_y, N", "τ_z, N m")
_VELOCITIES = ("u, m/s", "v, m/s", "w, m/s")
_POSITIONS = ("x, m", "y, m", "z, m", "ψ, °")
DASHES = {PlantKind.LINEAR: "solid", PlantKind.NONLINEAR: "dot"}
_COLOURS = {PlantKind.LINEAR: BLUE, PlantKind.NONLINEAR: RED}
_CAPTIONS = {
    7: "The distortion that the paper describes: the undamped swarm ends anywhere in a flat valley "
    "of the cost.",
    8: "The states follow nevertheless: the plant filters the noise.",
    9: "Positions lag by tens of metres: with Q = I the cost of one step hardly depends on them.",
    10: "ε at λ = 1; printed mean 1.3944, least 0.9380, greatest 2.0023.",
    11: "ε at λ = 0.65; printed mean 2.7744e-08. Its floor is the rounding of J, not the swarm.",
    12: "The same flight with λ = 0.65: smooth.",
    13: "Hardly different from Fig. 8, as in the paper.",
    14: "Hardly different from Fig. 9, as in the paper.",
    15: "Weights of Eqs. 33-35.",
    16: "Velocities now follow the reference closely.",
    17: "The steady error that the conclusions mention: a time constant of 39 s. On the nonlinear "
    "plant tilt reduces the lift, which adds a height error.",
}
Flown = Mapping[PlantKind, Flight]


@dataclass(frozen=True, slots=True)
class Search:
    """Positions (4 shown iterations, particles, 4), box lower, upper (4,), optimum u* (4,)."""

    positions: Array
    lower: Array
    upper: Array
    optimum: Array


def search(settings: PaperSettings) -> Search:
    """A search of the swarm of `settings` midway along the path of Figs. 5-6."""
    problem = problems(3, settings)[1]
    swarm = QuadraticSwarm(settings.swarm, 4)
    history = swarm.minimise(problem, RandomLanes(0), keep_history=True).history
    assert history is not None
    picked = np.minimum(SHOWN_ITERATIONS, len(history.positions)) - 1
    optimum = ExactMinimum(4).minimise(problem)
    return Search(history.positions[picked], problem.lower, problem.upper, optimum)


def search_motion(searches: Mapping[float, Search]) -> Figure:
    """Fig. 4: the particles in [f_t, tau_x], one row per lambda, four iterations each."""
    titles = [f"λ = {damping:g}, iteration {n}" for damping in searches for n in SHOWN_ITERATIONS]
    drawing = make_subplots(
        rows=len(searches), cols=len(SHOWN_ITERATIONS), shared_xaxes="all", shared_yaxes="all",
        subplot_titles=titles, horizontal_spacing=0.015, vertical_spacing=0.07,
    )  # fmt: skip
    for row, found in enumerate(searches.values(), 1):
        for column in range(1, len(SHOWN_ITERATIONS) + 1):
            drawing.add_traces(_particles(found, column - 1), rows=row, cols=column)
    drawing.update_layout(
        template=STYLE, height=110 + 240 * len(searches), showlegend=False,
        margin={"t": 60, "b": 50},
    )  # fmt: skip
    drawing.update_annotations(font_size=12)
    drawing.update_xaxes(title_text="f_t, N", row=len(searches))
    drawing.update_yaxes(title_text="τ_x, N", col=1)
    caption = "Dots: particles; cross: the exact optimum; the box is Eq. 26. Two of four inputs."
    return Figure("Fig. 4: the search of the swarm", drawing, caption, width_px=760)


def _particles(found: Search, shown: int) -> list[go.Scatter]:
    (left, low), (right, high) = found.lower[:2], found.upper[:2]
    corners = [left, right, right, left, left], [low, low, high, high, low]
    cross = {"color": RED, "size": 10, "symbol": "cross-thin", "line": {"width": 2, "color": RED}}
    dot = {"color": BLUE, "size": 5, "opacity": 0.7}
    drawn = (
        (corners, {"mode": "lines", "line": {"color": GREY, "width": 1}, "hoverinfo": "skip"}),
        (found.positions[shown].T, {"mode": "markers", "name": "particle", "marker": dot}),
        (found.optimum[:, None], {"mode": "markers", "name": "optimum", "marker": cross}),
    )
    return [go.Scatter(x=coordinates(x[0]), y=coordinates(x[1]), **style) for x, style in drawn]


def reference_states() -> Figure:
    """Fig. 5."""
    path = sampled_path(PathName.TOUR, 1000)
    titles = _POSITIONS + _VELOCITIES
    drawing = panels(titles, "t, s", panel_px=100)
    for panel, (title, column) in enumerate(zip(titles, _shown(path.tracked), strict=True), 1):
        curve(drawing, panel, path.times_s, column, title, INK)
    drawing.update_layout(showlegend=False, margin={"b": 50})
    caption = "The paper draws its path without numbers; this one is similar."
    return Figure("Fig. 5: reference of the states", drawing, caption)


def reference_path(flown: Mapping[str, Flight]) -> Figure:
    """Fig. 6: the path in space, with the flights by their names."""
    tracked = sampled_path(PathName.TOUR, 1000).tracked
    drawing = go.Figure()
    paths = {"reference": tracked} | {name: flight.states for name, flight in flown.items()}
    for (name, states), colour in zip(paths.items(), (INK, BLUE, RED, GREEN), strict=False):
        x, y, z = (coordinates(column) for column in (states[::4, X : X + 3] * (1, 1, -1)).T)
        line = {"color": colour, "width": 4 if name == "reference" else 3}
        drawing.add_scatter3d(x=x, y=y, z=z, mode="lines", name=name, line=line)
    x, y, z = (coordinates(column) for column in (tracked[[0, -1], X : X + 3] * (1, 1, -1)).T)
    drawing.add_scatter3d(
        x=x, y=y, z=z, mode="markers+text", text=["S", "D"], textposition="top center",
        showlegend=False, marker={"size": 4, "color": INK},
    )  # fmt: skip
    scene = {
        "xaxis_title": "north, m", "yaxis_title": "east, m", "zaxis_title": "height, m",
        "aspectmode": "manual", "aspectratio": {"x": 1.5, "y": 1.5, "z": 0.6},
        "camera": {"eye": {"x": 1.2, "y": 1.3, "z": 0.8}, "center": {"z": -0.2}},
    }  # fmt: skip
    drawing.update_layout(template=STYLE, height=560, scene=scene, margin={"l": 0, "b": 40})
    caption = "S start, D destination. Flown on the linear plant."
    return Figure("Fig. 6: the path", drawing, caption, width_px=560)


def _controls(number: int, name: str, flown: Flown) -> Figure:
    drawing = panels(_INPUTS, "t, s")
    for plant, flight in flown.items():
        for panel, column in enumerate(flight.inputs.T, 1):
            curve(drawing, panel, flight.times_s[:-1], column, f"{plant} plant", _COLOURS[plant])
    return Figure(f"Fig. {number}: controls, {name}", drawing, _CAPTIONS[number])


def _spreads(number: int, name: str, flown: Flown) -> Figure:
    drawing = panels(("ε",), "t, s", panel_px=300)
    for plant, flight in flown.items():
        curve(drawing, 1, flight.times_s[:-1], flight.spreads, f"{plant} plant", _COLOURS[plant])
    drawing.update_yaxes(type="log")
    return Figure(f"Fig. {number}: ε, {name}", drawing, _CAPTIONS[number])


def _positions(number: int, name: str, flown: Flown) -> Figure:
    drawing = _tracking(flown, _POSITIONS, slice(0, 4))
    return Figure(f"Fig. {number}: x, y, z, ψ, {name}", drawing, _CAPTIONS[number])


def _velocities(number: int, name: str, flown: Flown) -> Figure:
    drawing = _tracking(flown, _VELOCITIES, slice(4, 7))
    return Figure(f"Fig. {number}: u, v, w, {name}", drawing, _CAPTIONS[number])


# Number -> name of the flight on both plants, and the function that draws it
FLOWN: dict[int, tuple[str, Callable[[int, str, Flown], Figure]]] = {
    7: (UNDAMPED_FLIGHT, _controls), 8: (UNDAMPED_FLIGHT, _velocities),
    9: (UNDAMPED_FLIGHT, _positions), 10: (UNDAMPED_FLIGHT, _spreads),
    11: (DAMPED_FLIGHT, _spreads), 12: (DAMPED_FLIGHT, _controls),
    13: (DAMPED_FLIGHT, _velocities), 14: (DAMPED_FLIGHT, _positions),
    15: (FINAL_FLIGHT, _controls), 16: (FINAL_FLIGHT, _velocities),
    17: (FINAL_FLIGHT, _positions),
}  # fmt: skip


def position_error(
    drawing: go.Figure, panel: int, flight: Flight, law: str, plant: PlantKind, colour: str,
    every: int = 1,
) -> None:  # fmt: skip
    """Add the position error of every n-th step; not below 1e-9 m, for a logarithmic axis."""
    errors = np.maximum(flight.position_errors_m[::every], 1e-9)
    name = f"{law}, {plant}"
    curve(drawing, panel, flight.times_s[::every], errors, name, colour, DASHES[plant])


def _tracking(flown: Flown, titles: Sequence[str], part: slice) -> go.Figure:
    """The reference and the flights, one panel per state."""
    drawing = panels(titles, "t, s")
    first = next(iter(flown.values()))
    lines = [("reference", first.tracked, INK, "dash")]
    lines += [(f"{p} plant", flight.states, _COLOURS[p], "solid") for p, flight in flown.items()]
    for name, states, colour, dash in lines:
        for panel, column in enumerate(_shown(states)[part], 1):
            curve(drawing, panel, first.times_s, column, name, colour, dash)
    return drawing


def _shown(states: Array) -> list[Array]:
    """x, y, z, psi in degrees, u, v, w: (K,) each."""
    x, y, z = states[:, X : X + 3].T
    return [x, y, z, np.degrees(states[:, PSI]), *states[:, U : U + 3].T]
