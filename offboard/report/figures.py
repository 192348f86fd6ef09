"""The figures of a report of one flight or of several: path, timeline (phases and modes as bands,
actions of the failsafe and texts as marks), and panels.
"""

from __future__ import annotations

import html
import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import plotly.graph_objects as go

from offboard.analysis.columns import Rows
from offboard.analysis.history import Event
from offboard.analysis.page import (
    BLUE,
    BLUE_BAND,
    BROWN,
    GREEN,
    GREY,
    GREY_BAND,
    INK,
    ORANGE,
    ORANGE_BAND,
    PINK,
    PURPLE,
    RED,
    STYLE,
    SURFACE,
    Figure,
    coordinates,
    curve,
    logarithmic,
    panels,
    without_outliers,
)
from offboard.analysis.verdict import irregular
from offboard.flight.phases import Phase
from offboard.flight.record import Refusal
from offboard.mavlink.event_record import SUPERVISOR
from offboard.report.flight import Flight
from offboard.report.panels import GROUPS, LEAST_SHOWN, Curve, Panel, Points, thinned

# Colours of the flights in a figure, in an order that colour-blind people can distinguish
COLOURS = (BLUE, ORANGE, GREEN, GREY, PINK, BROWN)
DASHES = ("solid", "dash", "dot", "dashdot")
PATH_POINTS = 1500
PANEL_PX = 120
LEFT_PX = 75  # left margin, the same in all figures so that their time axes are aligned
ROW_PX = 34  # height of a row of the timeline
# Phases after an early end of the flight, drawn in orange
_ENDED_EARLY = {"hold", "stand down", "yielded", "failed", SUPERVISOR}
_CUT = "Outliers are outside the axes; double-click the figure to show them."


def side_by_side(flights: Sequence[Flight]) -> Sequence[Flight]:
    """Prepare flights for one report. A single flight keeps its vehicle time. Several get a letter
    (A, B ... Z, then numbers), a colour and a dash, and time zero is when their track begins."""
    if len(flights) == 1:
        return flights
    styles = itertools.cycle(zip(COLOURS, itertools.cycle(DASHES), strict=False))
    return [
        replace(
            flight,
            letter=chr(ord("A") + place) if place < 26 else str(place + 1),
            colour=colour,
            dash=dash,
            zero_s=flight.track_s,
        )
        for place, (flight, (colour, dash)) in enumerate(zip(flights, styles, strict=False))
    ]


def figures(flights: Sequence[Flight]) -> dict[str, Figure]:
    """Return the figures for which the logs have data, by name: path, timeline, and the groups of
    GROUPS. `flights` are those that `side_by_side` returned."""
    found = {"path": _path(flights), "timeline": _timeline(flights)}
    for name, (title, group) in GROUPS.items():
        found[name] = _panels(title, group, flights)
    return {name: figure for name, figure in found.items() if figure is not None}


# ---------------------------------------------------------------------- path


def _path(flights: Sequence[Flight]) -> Figure | None:
    longest = max(flights, key=lambda flight: len(flight.history.reference))
    lines = [
        (one.label or "estimated", one.history.position, one.colour, "solid") for one in flights
    ]
    lines.insert(1, ("reference", longest.history.reference, INK, "dash"))
    if len(flights) == 1:
        lines.insert(1, ("true (simulator)", longest.history.truth, ORANGE, "solid"))
    figure = go.Figure([_path_of(*line) for line in lines if len(line[1])])
    if not figure.data:
        return None
    places = np.concatenate([rows["position_ned_m"] for _, rows, *_ in lines])
    places = places[:, [1, 0, 2]] * [1.0, 1.0, -1.0]
    low, high = np.nanmin(places, axis=0), np.nanmax(places, axis=0)
    # One scale on all axes. None is shorter than half of the longest, so that a path along one axis
    # fits into the figure
    lengths = 1.04 * np.maximum(high - low, max(0.5 * (high - low).max(), 0.1))
    ratio = 1.4 * lengths / lengths.max()
    ends = (low + high) / 2.0 + np.outer([-0.5, 0.5], lengths)
    scene: dict[str, Any] = {
        f"{axis}axis": {"title": f"{title}, m", "nticks": 5, "range": both.tolist()}
        for axis, title, both in zip("xyz", ("east", "north", "height"), ends.T, strict=True)
    }
    scene |= {
        "aspectmode": "manual", "aspectratio": dict(zip("xyz", ratio.tolist(), strict=True)),
        "camera": {"eye": {"x": -1.5, "y": -1.8, "z": 1.0}, "center": {"x": 0, "y": 0, "z": -0.15}},
    }  # fmt: skip
    figure.update_layout(
        template=STYLE, height=520, scene=scene, margin={"l": 0, "r": 0, "t": 36, "b": 40},
        showlegend=True,
    )  # fmt: skip
    caption = "" if len(flights) == 1 else f"The reference is that of flight {longest.label}."
    return Figure("Path", figure, caption)


def _path_of(name: str, rows: Rows, colour: str, dash: str) -> go.Scatter3d:
    chosen = rows[np.linspace(0, len(rows) - 1, min(len(rows), PATH_POINTS)).astype(int)]
    north, east, down = chosen["position_ned_m"].T
    return go.Scatter3d(  # east, north, up, because plotly's axes are right-handed
        x=coordinates(east), y=coordinates(north), z=coordinates(-down), mode="lines",
        name=html.escape(name), line={"color": colour, "width": 4, "dash": dash},
    )  # fmt: skip


# ---------------------------------------------------------------------- timeline


@dataclass(frozen=True, slots=True)
class Entry:
    """A band from `begin_s` to `end_s` with a label, or a mark at `begin_s`. `text` is shown when
    the user points at it."""

    row: str
    begin_s: float
    text: str
    end_s: float = math.nan
    label: str = ""
    colour: str = ""


def bands(flight: Flight) -> list[Entry]:
    """Return phases of offboard and modes of the vehicle; the mode in which it follows setpoints is
    blue."""
    found = [
        Entry("phase", begin_s, event.what, end_s, event.phase, _colour(event.phase))
        for event, begin_s, end_s in phases(flight)
    ]
    dialect = flight.history.dialect
    for event, begin_s, end_s in spans(flight.history.modes, flight):
        colour = BLUE_BAND if dialect and event.what == dialect.engage_mode else GREY_BAND
        text = f"mode {event.what}"
        found.append(Entry("mode", begin_s, text, end_s, event.what, colour))
    return found


def marks(flight: Flight) -> list[Entry]:
    """Return phases of an early end, setpoints not sent, and texts of controller and vehicle."""
    flown = flight.history
    found = [Entry("failsafe", event.time_s, event.what) for event in irregular(flown.phases)]
    refused = flown.records["refused"].astype(int)
    for row in refused.nonzero()[0].tolist():
        why = ", ".join(
            flag.name.lower().replace("_", " ") for flag in Refusal(int(refused[row])) if flag.name
        )
        found.append(
            Entry("failsafe", float(flown.records["time_s"][row]), f"setpoint not sent: {why}")
        )
    texts = (*flown.announcements, *flown.vehicle_messages)
    found += [Entry("texts", event.time_s, f"{event.who}: {event.what}") for event in texts]
    return [mark for mark in found if math.isfinite(mark.begin_s)]


def phases(flight: Flight) -> list[tuple[Event, float, float]]:
    """Return the spans of the phases; after them that of the supervisor, if it took over."""
    said = [event for event in flight.history.announcements if event.cause == SUPERVISOR]
    took_over = [replace(event, phase=SUPERVISOR) for event in said[:1]]
    return spans([*flight.history.phases, *took_over], flight)


def spans(events: Sequence[Event], flight: Flight) -> list[tuple[Event, float, float]]:
    """Return each event with its begin and its end, which is the begin of the next event. An event
    before the first telemetry begins with the first sample."""
    begins = [flight.begin_s if math.isnan(e.time_s) else e.time_s for e in events]
    ends = [*begins[1:], flight.end_s]
    rows = zip(events, begins, ends, strict=False)  # without events there is one end too many
    return [(event, begin_s, max(end_s, begin_s)) for event, begin_s, end_s in rows]


def _colour(phase: str) -> str:
    if phase == Phase.TRACK.value:
        return BLUE_BAND
    return ORANGE_BAND if phase in _ENDED_EARLY else GREY_BAND


def _timeline(flights: Sequence[Flight]) -> Figure | None:
    figure = go.Figure()
    rows: list[str] = []
    for one in flights:
        prefix = f"{one.letter} " if one.letter else ""
        entries = [*bands(one), *marks(one)]
        if one.label:  # of several flights, show only the rows that differ most
            entries = [each for each in entries if each.row in ("phase", "failsafe")]
        for row in dict.fromkeys(each.row for each in entries):
            rows.append(prefix + row)
            trace = _bands if row in ("phase", "mode") else _marks
            figure.add_trace(trace([e for e in entries if e.row == row], rows[-1], one.zero_s))
    if not rows:
        return None
    figure.update_layout(
        template=STYLE, height=110 + ROW_PX * len(rows), barmode="overlay", showlegend=False,
        bargap=0.12, uniformtext={"mode": "hide", "minsize": 10},
        margin={"l": LEFT_PX, "t": 40, "b": 50},
    )  # fmt: skip
    figure.update_yaxes(
        categoryorder="array", categoryarray=rows[::-1], fixedrange=True, showgrid=False,
        range=[-0.6, len(rows) - 0.4], automargin=False,
    )  # fmt: skip
    figure.update_xaxes(title_text=_axis_title(flights), range=_extent(flights))
    return Figure("Timeline", figure, "Point at a band or a mark to read its text.")


def _bands(bands: Sequence[Entry], row: str, zero_s: float) -> go.Bar:
    return go.Bar(
        orientation="h", y=[row] * len(bands),
        base=[round(band.begin_s - zero_s, 3) for band in bands],
        x=[round(band.end_s - band.begin_s, 3) for band in bands],
        text=[html.escape(band.label) for band in bands],
        hovertext=[html.escape(f"{b.begin_s:.2f} s: {b.text}") for b in bands],
        hoverinfo="text", textposition="inside", insidetextanchor="middle", textangle=0,
        textfont={"color": INK, "size": 12},
        marker={"color": [b.colour for b in bands], "line": {"color": SURFACE, "width": 1.5}},
    )  # fmt: skip


def _marks(marks: Sequence[Entry], row: str, zero_s: float) -> go.Scatter:
    failsafe = marks[0].row == "failsafe"
    return go.Scatter(
        cliponaxis=False, mode="markers", x=[round(mark.begin_s - zero_s, 3) for mark in marks],
        y=[row] * len(marks), hoverinfo="text",
        hovertext=[html.escape(f"{mark.begin_s:.2f} s: {mark.text}") for mark in marks],
        marker={
            "size": 11 if failsafe else 8, "color": RED if failsafe else PURPLE,
            "symbol": "triangle-down" if failsafe else "circle-open", "line": {"width": 2},
        },
    )  # fmt: skip


# ---------------------------------------------------------------------- panels


def _panels(title: str, group: Sequence[Panel], flights: Sequence[Flight]) -> Figure | None:
    """Draw a group of panels with the curves for which the flights have data."""
    shown = [(panel, curves) for panel in group if (curves := _known(panel, flights))]
    if not shown:
        return None
    figure = panels([panel.title for panel, _ in shown], _axis_title(flights), PANEL_PX)
    captions, cut = [], False
    for place, (panel, curves) in enumerate(shown, 1):
        alone = len(curves) == 1 and not curves[0][0].label
        for one, each, samples in curves:
            _draw(figure, place, each, samples, one, named=not alone)
        values = np.concatenate([samples[1] for _, _, samples in curves])
        captions += [panel.caption] if panel.caption else []
        if panel.logarithmic:
            figure.update_yaxes(logarithmic(values), row=place)
        elif inner := without_outliers(values):
            figure.update_yaxes(range=inner, row=place)
            cut = True
    if not flights[0].label:
        figure.update_layout(shapes=_phase_shapes(flights[0]))
    figure.update_xaxes(range=_extent(flights))
    figure.update_yaxes(automargin=False, exponentformat="e")
    figure.update_layout(margin_l=LEFT_PX)
    return Figure(title, figure, " ".join(captions + [_CUT] * cut))


def _known(panel: Panel, flights: Sequence[Flight]) -> list[tuple[Flight, Curve, Points]]:
    """Return the curves of a panel that have values; of several flights only the main curves."""
    shown = ((one, each) for one in flights for each in panel.curves if each.main or not one.label)
    found = []
    for one, each in shown:
        times, values, *sd = each.source(one.history)
        if np.isfinite(values).any():
            least = LEAST_SHOWN if panel.logarithmic else -math.inf
            found.append((one, each, (times, np.maximum(values, least), *sd)))
    return found


def _draw(
    figure: go.Figure, place: int, each: Curve, points: Points, one: Flight, *, named: bool
) -> None:
    times, values, *sd = points
    chosen = thinned(values)
    name, colour, dash = each.name, each.colour, each.dash
    if one.label:
        name, colour, dash = one.label, one.colour, one.dash
    more: dict[str, Any] = {} if named else {"showlegend": False}
    if each.style == "steps":
        more["line"] = {"shape": "hv", "width": 1.1}
    elif each.style == "dots":
        more |= {"mode": "markers", "marker": {"color": colour, "size": 7 if sd else 4}}
    if sd:
        bars = coordinates(sd[0][chosen])
        more["error_y"] = {"type": "data", "array": bars, "color": colour, "thickness": 1.5}
    times = times[chosen] - one.zero_s
    curve(figure, place, times, values[chosen], html.escape(name), colour, dash, **more)


def _phase_shapes(flight: Flight) -> list[dict[str, Any]]:
    """Return a band for the phase TRACK, and a line at the begin of each phase."""
    shapes: list[dict[str, Any]] = []
    for event, begin_s, end_s in phases(flight):
        place = {"xref": "x", "yref": "paper", "x0": begin_s, "y0": 0, "y1": 1, "layer": "below"}
        line = {"color": GREY, "width": 1}
        if math.isfinite(event.time_s):
            shapes.append({"type": "line", "x1": begin_s, "opacity": 0.4, "line": line} | place)
        if event.phase == "track":
            band = {"fillcolor": BLUE_BAND, "opacity": 0.35, "line": {"width": 0}}
            shapes.append({"type": "rect", "x1": end_s} | place | band)
    return shapes


def _axis_title(flights: Sequence[Flight]) -> str:
    return "time since the track began, s" if len(flights) > 1 else "vehicle time, s"


def _extent(flights: Sequence[Flight]) -> list[float]:
    """Return the times of the first and the last sample of all flights."""
    begin = min(one.begin_s - one.zero_s for one in flights)
    end = max(one.end_s - one.zero_s for one in flights)
    return [round(begin, 2), round(end, 2)]
