"""Counterparts of the paper's Figs. 4-17, from flights and searches. Knows no page."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from offboard.analysis.figure import (
    BLUE,
    GREEN,
    GREY,
    INK,
    RED,
    Figure,
    Trace,
    axis,
    line,
    panels,
    single,
)
from offboard.model.state import PSI, U, X
from offboard.paper.law import PAPER_STEP_S
from offboard.paper.plant import PlantKind
from offboard.paper.study.closed_loop import Flight
from offboard.paper.study.search import SHOWN_ITERATIONS, Search
from offboard.paper.trajectory import Reach

Array = NDArray[np.float64]

_INPUT_TITLES = ("f_t, N", "τ_x, N", "τ_y, N", "τ_z, N m")
_VELOCITY_TITLES = ("u, m/s", "v, m/s", "w, m/s")
_POSITION_TITLES = ("x, m", "y, m", "z, m", "ψ, °")
_COLOURS = {PlantKind.LINEAR: BLUE, PlantKind.NONLINEAR: RED}
Flown = Mapping[PlantKind, Flight]


def search_motion(searches: Sequence[Search]) -> Figure:
    """Fig. 4: the particles in [f_t, tau_x], one row per lambda, four iterations each."""
    traces: list[Trace] = []
    layout: dict[str, object] = {"height": 90 + 250 * len(searches), "showlegend": False}
    notes = []
    wide, tall = 1.0 / len(SHOWN_ITERATIONS), 1.0 / len(searches)
    for row, found in enumerate(searches):
        for column, iteration in enumerate(SHOWN_ITERATIONS):
            panel = row * len(SHOWN_ITERATIONS) + column + 1
            traces += _cloud(found, column, panel)
            left, bottom = column * wide, 1.0 - (row + 1) * tall
            number = "" if panel == 1 else str(panel)
            below = {"text": "f_t, N" if found is searches[-1] else "", "standoff": 4}
            layout[f"xaxis{number}"] = {
                "domain": [left + 0.035, left + wide - 0.01], "anchor": axis("y", panel),
                "range": _padded(found.lower[0], found.upper[0]), "title": below,
                "gridcolor": "#e4e7eb", "zeroline": False,
            }  # fmt: skip
            layout[f"yaxis{number}"] = {
                "domain": [bottom + 0.04, bottom + tall - 0.06], "anchor": axis("x", panel),
                "range": _padded(found.lower[1], found.upper[1]), "gridcolor": "#e4e7eb",
                "zeroline": False, **({"title": {"text": "τ_x, N"}} if column == 0 else {}),
            }  # fmt: skip
            notes.append(
                {
                    "text": f"{'abcd'[column]})  λ = {found.damping:g}, iteration {iteration}",
                    "x": left + 0.035, "y": bottom + tall - 0.05, "xref": "paper",
                    "yref": "paper", "showarrow": False, "xanchor": "left", "yanchor": "bottom",
                }
            )  # fmt: skip
    layout["annotations"] = notes
    caption = "Dots: particles; cross: the exact optimum; the box is Eq. 26. Two of four inputs."
    return Figure("Fig. 4: the swarm searching", traces, layout, caption)


def _cloud(found: Search, shown: int, panel: int) -> list[Trace]:
    at = {"xaxis": axis("x", panel), "yaxis": axis("y", panel), "type": "scatter"}
    corners = ([0, 1, 1, 0, 0], [0, 0, 1, 1, 0])
    edges = (found.lower, found.upper)
    return [
        {**at, "mode": "lines", "line": {"color": GREY, "width": 1}, "hoverinfo": "skip",
         "x": [float(edges[i][0]) for i in corners[0]],
         "y": [float(edges[i][1]) for i in corners[1]]},
        {**at, "mode": "markers", "name": "particle", "marker": {"color": BLUE, "size": 5,
         "opacity": 0.7}, "x": found.positions[shown, :, 0].round(9).tolist(),
         "y": found.positions[shown, :, 1].round(9).tolist()},
        {**at, "mode": "markers", "name": "optimum", "marker": {"color": RED, "size": 10,
         "symbol": "cross-thin", "line": {"width": 2, "color": RED}},
         "x": [float(found.optimum[0])], "y": [float(found.optimum[1])]},
    ]  # fmt: skip


def reference_states(way: Reach) -> Figure:
    """Fig. 5."""
    traces = [
        line(way.times_s, column, title, INK, panel=i + 1, showlegend=False)
        for i, (title, column) in enumerate(
            zip(_POSITION_TITLES + _VELOCITY_TITLES, _shown_states(way.tracked), strict=True)
        )
    ]
    layout = panels(_POSITION_TITLES + _VELOCITY_TITLES, "t, s")
    layout["height"] = 900
    return Figure(
        "Fig. 5: reference of the states", traces, layout,
        "The paper draws its path without numbers; this one is of the same kind.",
    )  # fmt: skip


def reference_path(way: Reach, flights: Mapping[str, Flight]) -> Figure:
    """Fig. 6: the path in space, and what was flown."""

    def trace(states: Array, name: str, colour: str, width: int) -> Trace:
        x, y, z = states[::4, X : X + 3].T
        return {
            "type": "scatter3d", "mode": "lines", "name": name,
            "x": x.round(3).tolist(), "y": y.round(3).tolist(), "z": (-z).round(3).tolist(),
            "line": {"color": colour, "width": width},
        }  # fmt: skip

    traces = [trace(way.tracked, "reference", INK, 4)]
    colours = (BLUE, RED, GREEN)
    for (name, flight), colour in zip(flights.items(), colours, strict=False):
        traces.append(trace(flight.states, name, colour, 3))
    ends = way.tracked[[0, -1], X : X + 3]
    traces.append(
        {
            "type": "scatter3d", "mode": "markers+text", "text": ["S", "D"], "showlegend": False,
            "x": ends[:, 0].tolist(), "y": ends[:, 1].tolist(), "z": (-ends[:, 2]).tolist(),
            "marker": {"size": 4, "color": INK}, "textposition": "top center",
        }
    )  # fmt: skip
    scene = {
        "xaxis": {"title": {"text": "north, m"}}, "yaxis": {"title": {"text": "east, m"}},
        "zaxis": {"title": {"text": "height, m"}}, "aspectmode": "manual",
        "aspectratio": {"x": 1.5, "y": 1.5, "z": 0.6},
        "camera": {"eye": {"x": 1.2, "y": 1.3, "z": 0.8}, "center": {"x": 0, "y": 0, "z": -0.2}},
    }  # fmt: skip
    return Figure(
        "Fig. 6: the path", traces, {"height": 560, "scene": scene},
        "S start, D destination. Flown on the linear plant.",
    )  # fmt: skip


def controls(title: str, flown: Flown, caption: str) -> Figure:
    """Figs. 7, 12, 15."""
    traces = [
        line(_times(flight)[:-1], flight.inputs[:, i], f"{plant} plant", _COLOURS[plant],
             panel=i + 1, showlegend=i == 0)
        for plant, flight in flown.items()
        for i in range(4)
    ]  # fmt: skip
    return Figure(title, traces, panels(_INPUT_TITLES, "t, s"), caption)


def velocities(title: str, flown: Flown, caption: str) -> Figure:
    """Figs. 8, 13, 16."""
    return _tracking(title, flown, _VELOCITY_TITLES, slice(4, 7), caption)


def positions(title: str, flown: Flown, caption: str) -> Figure:
    """Figs. 9, 14, 17."""
    return _tracking(title, flown, _POSITION_TITLES, slice(0, 4), caption)


def spreads(title: str, flown: Flown, caption: str) -> Figure:
    """Figs. 10, 11: epsilon of every solve."""
    traces = [
        line(_times(flight)[:-1], flight.spreads, f"{plant} plant", _COLOURS[plant])
        for plant, flight in flown.items()
    ]
    return Figure(title, traces, single("t, s", "ε", y={"type": "log"}), caption)


def _tracking(title: str, flown: Flown, titles: Sequence[str], part: slice, caption: str) -> Figure:
    first = next(iter(flown.values()))
    traces = [
        line(_times(first), column, "reference", INK, panel=i + 1, showlegend=i == 0, dash="dash")
        for i, column in enumerate(_shown_states(first.tracked)[part])
    ]
    for plant, flight in flown.items():
        traces += [
            line(_times(flight), column, f"{plant} plant", _COLOURS[plant], panel=i + 1,
                 showlegend=i == 0)
            for i, column in enumerate(_shown_states(flight.states)[part])
        ]  # fmt: skip
    return Figure(title, traces, panels(titles, "t, s"), caption)


def _shown_states(states: Array) -> list[Array]:
    """x, y, z, psi in degrees, u, v, w: (K,) each."""
    x, y, z = states[:, X : X + 3].T
    return [x, y, z, np.degrees(states[:, PSI]), *states[:, U : U + 3].T]


def _times(flight: Flight) -> Array:
    return PAPER_STEP_S * np.arange(len(flight.states), dtype=np.float64)


def _padded(low: float, high: float) -> list[float]:
    margin = 0.06 * (high - low)
    return [float(low - margin), float(high + margin)]
