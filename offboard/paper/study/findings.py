"""Figures that the paper has not: gap by lambda, horizon, both laws flown, integral, limits, peers.

Knows no page.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from offboard.analysis.figure import (
    BLUE,
    GREY,
    INK,
    PALETTE,
    RED,
    Figure,
    Trace,
    legend_beside,
    line,
    numbers,
    panels,
    single,
)
from offboard.paper.law import PAPER_STEP_S
from offboard.paper.plant import PlantKind
from offboard.paper.study.closed_loop import Flight, LawName, Summary
from offboard.paper.study.extensions import LIMITS, limited_states
from offboard.paper.study.horizon import LONGEST, Modes
from offboard.paper.study.peers import DIRECT, Heat
from offboard.paper.study.tables import MISS

_DASH = {PlantKind.LINEAR: "solid", PlantKind.NONLINEAR: "dot"}
_LAW_COLOURS = {LawName.ONE_STEP: RED, LawName.COST_TO_GO: BLUE}
_QUANTILES = (0.5, 0.9, 0.99)
_LEAST_GAP = 1e-17


def gap_by_damping(flown: Mapping[tuple[PlantKind, float], Sequence[Summary]]) -> Figure:
    """What Table 2 could not say: how far from the optimum, by lambda, beside epsilon."""
    linear = sorted(
        (damping, flights) for (plant, damping), flights in flown.items() if plant == "linear"
    )
    dampings = [damping for damping, _ in linear]
    gaps = [np.concatenate([flight.gaps for flight in flights]) for _, flights in linear]
    traces: list[Trace] = []
    for quantile, colour in zip(_QUANTILES, (BLUE, PALETTE[3], RED), strict=True):
        values = [max(float(np.quantile(gap, quantile)), _LEAST_GAP) for gap in gaps]
        name = "gap, median" if quantile == 0.5 else f"gap, {100 * quantile:.0f} %"
        traces.append(line(dampings, values, name, colour, mode="lines+markers"))
    epsilon = [
        float(np.mean([flight.spreads.mean() for flight in flights])) for _, flights in linear
    ]
    traces.append(
        line(dampings, epsilon, "ε, mean", GREY, panel=2, mode="lines+markers", dash="dash")
    )
    missed = [100 * float(np.mean(gap > MISS)) for gap in gaps]
    traces.append(line(dampings, missed, "missed, %", INK, panel=3, mode="lines+markers"))
    layout = panels(("gap to J*", "ε", "missed > 1e-6, %"), "λ")
    layout["yaxis"]["type"] = layout["yaxis2"]["type"] = "log"
    caption = (
        "ε falls with λ without end; the gap has its minimum between 0.5 and 0.8. Gaps below "
        "1e-17 are drawn there."
    )
    return Figure("Gap to the exact optimum, by λ", traces, layout, caption)


def horizon(modes: Sequence[Modes]) -> Figure:
    """Slowest time constant over N."""
    by_name = {mode.name: mode.time_constant_s for mode in modes}
    steps = list(range(1, LONGEST + 1))
    traces = [
        line(steps, [by_name[f"N = {n}"] for n in steps], "N steps, Eqs. 33-35", BLUE,
             mode="lines+markers"),
        line([1, LONGEST], [by_name["N = ∞"]] * 2, "N = ∞", INK, dash="dash"),
        line([1], [by_name["cost-to-go, Eqs. 33-35"]], "one step + cost-to-go", RED,
             mode="markers", marker={"size": 11, "color": RED, "symbol": "diamond"}),
    ]  # fmt: skip
    return Figure(
        "Slowest time constant of the closed loop",
        traces,
        single("horizon N, steps of 0.1 s", "slowest time constant, s", y={"type": "log"}),
        "Computed from the model. One step with the cost-to-go is as fast as any horizon.",
    )


def both_laws(
    offsets: Mapping[tuple[LawName, PlantKind], Flight],
    tours: Mapping[tuple[LawName, PlantKind], Flight],
    modes: Sequence[Modes],
) -> Figure:
    """The closed loop flown: 1 m off at hover, and the tour; error against time."""
    traces: list[Trace] = []
    for panel, flown in enumerate((offsets, tours), start=1):
        for (law, plant), flight in flown.items():
            errors = np.maximum(flight.position_errors_m, 1e-9)
            times = PAPER_STEP_S * np.arange(len(errors))
            traces.append(
                line(times, errors, f"{law}, {plant}", _LAW_COLOURS[law], panel=panel,
                     dash=_DASH[plant], showlegend=panel == 1)
            )  # fmt: skip
    slow = next(mode.time_constant_s for mode in modes if mode.name == "one step, Eqs. 33-35")
    times = np.linspace(0.0, 100.0, 50)
    traces.append(
        line(times, np.exp(-times / slow), f"model: e^(-t / {slow:.1f} s)", GREY,
             dash="dash")
    )  # fmt: skip
    layout = panels(("1 m off at hover: error, m", "tour: position error, m"), "t, s")
    for number in ("", "2"):
        layout[f"yaxis{number}"].update({"type": "log", "range": [-5, 0.7]})
    layout |= {"height": 640, "legend": legend_beside()}
    return Figure(
        "One step and cost-to-go, flown", traces, layout,
        "Same weights (Eqs. 33-35), same swarm, same box; the cost-to-go also gets a reference "
        "that the model can follow.",
    )  # fmt: skip


def integral(flown: Mapping[tuple[str, str, PlantKind], Flight]) -> Figure:
    """Error against time with wind and with weak thrust."""
    cases = list(dict.fromkeys(case for _, case, _ in flown))
    laws = list(dict.fromkeys(law for law, _, _ in flown))
    traces = []
    for (law, case, plant), flight in flown.items():
        errors = np.maximum(flight.position_errors_m[::5], 1e-9)
        times = 5 * PAPER_STEP_S * np.arange(len(errors))
        panel = cases.index(case) + 1
        traces.append(
            line(times, errors, f"{law}, {plant}", PALETTE[laws.index(law)], panel=panel,
                 dash=_DASH[plant], showlegend=panel == 1)
        )  # fmt: skip
    layout = panels([f"{case}: error, m" for case in cases], "t, s")
    for number in range(len(cases)):
        layout[f"yaxis{number + 1 if number else ''}"].update({"type": "log", "range": [-6, 1.5]})
    layout |= {"height": 640, "legend": legend_beside()}
    return Figure(
        "Integral term", traces, layout, "Hover from the reference's start; error against time."
    )


def limits(flown: Mapping[tuple[str, PlantKind], Flight]) -> Figure:
    """Limited states, with and without limits, and the limits."""
    shown = ("tilt_rad", "tilt_rate_radps", "speed_mps")
    traces = []
    for (name, plant), flight in flown.items():
        reached = limited_states(flight, plant)
        times = PAPER_STEP_S * np.arange(len(flight.states))
        for panel, key in enumerate(shown, start=1):
            traces.append(
                line(times, reached[key], f"{name}, {plant}", RED if name == "free" else BLUE,
                     panel=panel, dash=_DASH[plant], showlegend=panel == 1)
            )  # fmt: skip
    for panel, key in enumerate(shown, start=1):
        limit = float(getattr(LIMITS, key))
        traces.append(
            line([0, 100], [limit, limit], "limit", INK, panel=panel, dash="dash",
                 showlegend=panel == 1)
        )  # fmt: skip
    layout = panels(("tilt, rad", "tilt rate, rad/s", "speed per axis, m/s"), "t, s")
    return Figure(
        "State limits", traces, layout,
        "The limits narrow the box of every search; nothing is penalised, nothing exceeded.",
    )  # fmt: skip


def peers(heats: Sequence[Heat]) -> Figure:
    """Gap against time, one curve per solver, its points the budgets."""
    traces: list[Trace] = []
    for i, name in enumerate(dict.fromkeys(heat.solver for heat in heats)):
        own = [heat for heat in heats if heat.solver == name]
        traces.append(
            {
                "type": "scatter", "mode": "markers" if name in DIRECT else "lines+markers",
                "name": name, "x": numbers([1e3 * heat.time_s for heat in own]),
                "y": numbers([heat.gap_median for heat in own]),
                "text": [f"{heat.budget} evaluations" for heat in own],
                "line": {"color": PALETTE[i % len(PALETTE)], "width": 3 if "this" in name else 1.4},
                "marker": {"color": PALETTE[i % len(PALETTE)], "size": 8,
                           "symbol": "star" if name in DIRECT else "circle"},
            }
        )  # fmt: skip
    layout = single(
        "time for one solve, ms", "gap to J*, median",
        x={"type": "log"}, y={"type": "log"}, height=520,
        legend=legend_beside(),
    )  # fmt: skip
    budgets = ", ".join(str(n) for n in sorted({heat.budget for heat in heats}))
    return Figure(
        "The swarm among its peers", traces, layout,
        f"Points: {budgets} evaluations of J. Down and left is better; 1e-17 stands for rounding.",
    )  # fmt: skip
