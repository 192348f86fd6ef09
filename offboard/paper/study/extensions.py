"""Two extensions that the paper's conclusions propose: an integral term and limits on the state.

Each is the same law with one more setting and flies beside the unchanged law.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from offboard.analysis.figure import BLUE, INK, PALETTE, RED, Figure, curve, panels
from offboard.model.state import PHI, PSI, P, U, V, W
from offboard.paper.integral import IntegralSettings
from offboard.paper.law import PaperSettings
from offboard.paper.plant import PlantKind
from offboard.paper.state_limits import StateLimits
from offboard.paper.study.closed_loop import Flight, FlightTask
from offboard.paper.study.figures import DASHES, position_error
from offboard.paper.study.page import Row, Table
from offboard.paper.trajectory import PathName

Array = NDArray[np.float64]

# The time constant of Eq. 33's position weights, 39 s, leaves no bandwidth for an integral
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
MARGIN = 0.05  # on the nonlinear plant, for what the linear model neglects
_STEADY_STEPS, _LAST_STEPS = 1500, 100

Steady = Mapping[tuple[str, str, PlantKind], Flight]
Limited = Mapping[tuple[str, PlantKind], Flight]


def steady_tasks() -> dict[tuple[str, str, PlantKind], FlightTask]:
    """(law, case, plant) -> a hover of 150 s in wind or with weak thrust."""
    return {
        (law, case, plant): FlightTask(
            settings, plant, PathName.HOVER, steps=_STEADY_STEPS, **disturbance
        )
        for law, settings in LAWS.items()
        for case, disturbance in CASES.items()
        for plant in PlantKind
    }


def steady_error_m(flight: Flight) -> float:
    """Mean distance from the reference over the last 10 s."""
    return float(flight.position_errors_m[-_LAST_STEPS:].mean())


def integral_table(flown: Steady) -> Table:
    """Steady and greatest position errors."""
    rows: list[Row] = [
        {
            "case": case,
            "plant": str(plant),
            "law": law,
            "steady_m": steady_error_m(flight),
            "greatest_m": float(flight.position_errors_m.max()),
        }
        for (law, case, plant), flight in sorted(flown.items(), key=lambda item: item[0][1:])
    ]
    columns = {
        "case": "hover, 150 s", "plant": "plant", "law": "law",
        "steady_m": "steady position error, m", "greatest_m": "greatest, m",
    }  # fmt: skip
    notes = (
        "Flown by the controller paper_integral. With the position weights of Eq. 33 the integral "
        "would have a time constant of 79 s at best; hence the raised weights, which alone leave "
        "a steady error.",
    )
    return Table("Integral term", columns, rows, notes)


def integral_figure(flown: Steady) -> Figure:
    """Position error over time in wind and with weak thrust."""
    drawing = panels([f"{case}: position error, m" for case in CASES], "t, s", panel_px=240)
    for (law, case, plant), flight in flown.items():
        panel, colour = list(CASES).index(case) + 1, PALETTE[list(LAWS).index(law)]
        position_error(drawing, panel, flight, law, plant, colour, every=5)
    drawing.update_yaxes(type="log", range=[-6, 1.5])
    return Figure("Integral term", drawing, "Hover; every flight starts on the reference.")


def limit_tasks() -> dict[tuple[str, PlantKind], FlightTask]:
    """(free or limited, plant) -> the path of Figs. 5-6."""
    margins = {PlantKind.LINEAR: 0.0, PlantKind.NONLINEAR: MARGIN}
    return {
        (name, plant): FlightTask(PaperSettings(limits=limits), plant)
        for plant in PlantKind
        for name, limits in (
            ("free", None),
            ("limited", LIMITS.model_copy(update={"margin": margins[plant]})),
        )
    }


def limited_states(flight: Flight, plant: PlantKind) -> dict[str, Array]:
    """Field of `StateLimits` -> greatest magnitude of the states that it limits, (K + 1,)."""
    states = flight.states
    north, east = states[:, U], states[:, V]
    course = states[:, PSI] if plant is PlantKind.NONLINEAR else np.zeros(len(states))
    along = np.cos(course) * north + np.sin(course) * east
    across = np.cos(course) * east - np.sin(course) * north
    return {
        "tilt_rad": np.abs(states[:, PHI:PSI]).max(axis=1),
        "tilt_rate_radps": np.abs(states[:, P : P + 2]).max(axis=1),
        "yaw_rate_radps": np.abs(states[:, P + 2]),
        "speed_mps": np.maximum(np.abs(along), np.abs(across)),
        "climb_mps": np.abs(states[:, W]),
    }


def limits_table(flown: Limited) -> Table:
    """The greatest value of each limited state, and the number of samples above its limit."""
    rows: list[Row] = []
    for (name, plant), flight in flown.items():
        for key, values in limited_states(flight, plant).items():
            limit = float(getattr(LIMITS, key))
            rows.append(
                {
                    "plant": str(plant),
                    "law": name,
                    "state": key,
                    "limit": limit,
                    "greatest": float(values.max()),
                    "samples_over": int(np.sum(values > limit * (1 + 1e-9))),
                    "samples": len(values),
                }
            )
    columns = {
        "plant": "plant", "law": "law", "state": "state", "limit": "limit",
        "greatest": "greatest", "samples_over": "samples over the limit", "samples": "of",
    }  # fmt: skip
    notes = (
        "Flown by the controller paper_limited. On the linear plant the limits hold exactly, by "
        "construction; on the nonlinear one a margin of 5 % covers what the model neglects. The "
        "reference requires more than the limits allow, so the tracking error grows.",
    )
    return Table("State limits", columns, rows, notes)


def limits_figure(flown: Limited) -> Figure:
    """Limited states, with and without limits, and the limits."""
    shown = {
        "tilt_rad": "tilt, rad", "tilt_rate_radps": "tilt rate, rad/s",
        "speed_mps": "speed per axis, m/s",
    }  # fmt: skip
    drawing = panels(list(shown.values()), "t, s")
    for (name, plant), flight in flown.items():
        reached, colour = limited_states(flight, plant), RED if name == "free" else BLUE
        for panel, key in enumerate(shown, 1):
            law = f"{name}, {plant}"
            curve(drawing, panel, flight.times_s, reached[key], law, colour, DASHES[plant])
    for panel, key in enumerate(shown, 1):
        curve(drawing, panel, [0, 100], [getattr(LIMITS, key)] * 2, "limit", INK, "dash")
    caption = "The limits narrow the box of every search; no cost is added, no limit is exceeded."
    return Figure("State limits", drawing, caption)
