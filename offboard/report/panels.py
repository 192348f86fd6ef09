"""What the panels of a report show: curves of one flight over vehicle time, in groups."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from offboard.analysis.history import History, Rows
from offboard.analysis.page import BLUE, GREEN, INK, ORANGE, PINK, PURPLE
from offboard.analysis.tracking import Reference, each_once
from offboard.model.frames import euler_from_quaternion

Array = NDArray[np.float64]

BINS = 1500  # of a curve, see `thinned`
REFERENCE_GAP_S = 0.5  # without a record of the reference for longer there is none
LEAST_SHOWN = 1e-16  # of a logarithmic axis: zero is drawn there
ESTIMATED, TRUE, COMMANDED = "estimated", "true (simulator)", "commanded"


@dataclass(frozen=True, slots=True)
class Curve:
    """Values (N,) at vehicle times (N,). `main` curves are also drawn where several flights share a
    panel. `style`: "line", "steps" or "dots"; dots may have a standard deviation `sd` (N,)."""

    name: str
    times: Array
    values: Array
    colour: str
    style: str = "line"
    main: bool = True
    dash: str = "solid"
    sd: Array | None = None


@dataclass(frozen=True, slots=True)
class Panel:
    title: str
    curves: tuple[Curve, ...]
    logarithmic: bool = False

    def shown(self) -> Panel | None:
        """The panel with the curves that have values; None without any."""
        curves = tuple(curve for curve in self.curves if np.isfinite(curve.values).any())
        return Panel(self.title, curves, self.logarithmic) if curves else None


def tracking(flown: History) -> tuple[Panel, ...]:
    """Distances from the reference, height and speed."""
    flights = {ESTIMATED: flown.position, TRUE: flown.truth}
    away = {name: _away(flown, each_once(rows)) for name, rows in flights.items() if len(rows)}
    colours = {ESTIMATED: BLUE, TRUE: ORANGE}
    errors = tuple(
        Curve(name, times, np.linalg.norm(errors, axis=1), colours[name], main=name == ESTIMATED)
        for name, (times, errors) in away.items()
    )
    times, by_axis = away.get(ESTIMATED, (np.zeros(0), np.zeros((0, 3))))
    components = tuple(
        Curve(axis, times, by_axis[:, column], colour, main=False, dash=dash)
        for column, (axis, (colour, dash)) in enumerate(_AXES.items())
    )
    heights = tuple(
        Curve(name, rows["time_s"], _height_m(rows), colours[name], main=name == ESTIMATED)
        for name, rows in flights.items()
        if len(rows)
    )
    reference = Curve(
        "reference",
        flown.reference["time_s"],
        _height_m(flown.reference),
        INK,
        main=False,
        dash="dash",
    )
    speed = np.linalg.norm(flown.position["velocity_ned_mps"], axis=1)
    return (
        Panel("distance from the reference, m", errors),
        Panel("estimated error by axis, m", components),
        Panel("height, m", (*heights, reference)),
        Panel("speed, m/s", (Curve(ESTIMATED, flown.position["time_s"], speed, BLUE),)),
    )


def attitude(flown: History) -> tuple[Panel, ...]:
    """Roll, pitch and heading, commanded and flown."""
    sent = _euler_deg(flown.setpoint["quaternion"])
    estimated = _euler_deg(flown.attitude["quaternion"])
    return tuple(
        Panel(
            f"{title}, deg",
            (
                Curve(COMMANDED, flown.setpoint["time_s"], sent[:, axis], ORANGE, "steps", False),
                Curve(ESTIMATED, flown.attitude["time_s"], estimated[:, axis], BLUE),
            ),
        )
        for axis, title in enumerate(("roll", "pitch", "heading"))
    )


def thrust(flown: History) -> tuple[Panel, ...]:
    """Thrust commanded, the hover thrust that the observer estimates, and the battery."""
    commanded = Curve(
        COMMANDED, flown.setpoint["time_s"], flown.setpoint["thrust"], ORANGE, "steps"
    )
    hover = _recorded(
        flown, "hover_thrust", "hover thrust, estimated", INK, main=False, dash="dash"
    )
    times, battery = flown.battery["time_s"], flown.battery
    remaining = Curve("remaining", times, battery["remaining"], BLUE, "steps")
    voltage = Curve("voltage", times, 1e-3 * battery["voltage_mv"], BLUE, "steps")
    return (
        Panel("thrust, 0 to 1", (commanded, hover)),
        Panel("battery, %", (remaining,)),
        Panel("battery, V", (voltage,)),
    )


def decisions(flown: History) -> tuple[Panel, ...]:
    """Certificate and time of the decisions."""

    def floored(name: str, label: str) -> Curve:
        curve = _recorded(flown, name, label, BLUE, "dots")
        return Curve(label, curve.times, np.maximum(curve.values, LEAST_SHOWN), BLUE, "dots")

    return (
        Panel("gap: cost above the exact optimum", (floored("gap", "gap"),), logarithmic=True),
        Panel("spread of the swarm (ε, Eq. 29)", (floored("spread", "spread"),), logarithmic=True),
        Panel(
            "solve time, ms", (_recorded(flown, "solve_time_s", "solve time", BLUE, "dots", 1e3),)
        ),
    )


def link(flown: History) -> tuple[Panel, ...]:
    """Ages and delays of the link, and intervals of telemetry."""
    delay = Curve(
        "delay of the link (TIMESYNC)", flown.link_delay["time_s"],
        1e3 * flown.link_delay["delay_s"], ORANGE, main=False,
    )  # fmt: skip
    age = _recorded(flown, "age_s", "telemetry at its setpoint", BLUE, "dots", 1e3)
    late = _recorded(
        flown,
        "answer_s",
        "telemetry in to setpoint out (host time)",
        GREEN,
        "dots",
        1e3,
        main=False,
    )
    stamps = np.unique(flown.position["time_s"])
    gaps = Curve("positions", stamps[1:], 1e3 * np.diff(stamps), BLUE, "dots")
    return (
        Panel("age and delay, ms", (age, delay, late)),
        Panel("interval between positions, ms", (gaps,)),
    )


def identification(flown: History) -> tuple[Panel, ...]:
    """What was identified, with its standard deviation, and what the observer estimates."""

    def found(
        constant: str, name: str, colour: str, scale: float = 1.0, main: bool = True
    ) -> Curve:
        values = flown.identified[constant]
        known = np.isfinite(values[:, 0])
        value, sd = scale * values[known].T
        times = flown.identified["time_s"][known]
        return Curve(name, times, value, colour, "dots", main, sd=sd)

    hover = _recorded(flown, "hover_thrust", ESTIMATED, PURPLE, main=False)
    disturbance = tuple(
        _recorded(flown, f"disturbance_{axis}_mps2", axis, colour, main=False, dash=dash)
        for axis, (colour, dash) in _AXES.items()
    )
    return (
        Panel(
            "identified delay, ms",
            (
                found("tilt_delay_s", "tilt", BLUE, 1e3),
                found("yaw_delay_s", "yaw", ORANGE, 1e3, main=False),
            ),
        ),
        Panel(
            "identified natural frequency, rad/s",
            (
                found("tilt_natural_frequency_radps", "tilt", BLUE),
                found("yaw_natural_frequency_radps", "yaw", ORANGE, main=False),
            ),
        ),
        Panel("hover thrust, 0 to 1", (found("hover_thrust", "identified", INK), hover)),
        Panel("identified drag, 1/s", (found("drag_ps", "drag", BLUE),)),
        Panel("estimated disturbance, m/s²", disturbance),
    )


GROUPS: dict[str, tuple[str, Callable[[History], tuple[Panel, ...]]]] = {
    "tracking": ("Tracking", tracking),
    "attitude": ("Attitude commanded and flown", attitude),
    "thrust": ("Thrust and battery", thrust),
    "decisions": ("Decisions", decisions),
    "link": ("Link", link),
    "identification": ("Identified and estimated", identification),
}
_AXES = {"north": (GREEN, "solid"), "east": (PINK, "dash"), "down": (INK, "dot")}


def thinned(values: Array, bins: int = BINS) -> NDArray[np.intp]:
    """Indices of `values` (N,) to draw: all, or the least and the greatest of each bin of equally
    many samples, and its first value that is not finite, which is a gap of the curve."""
    count = len(values)
    if count <= 2 * bins:
        return np.arange(count)
    edges = np.linspace(0, count, bins + 1).astype(np.intp)[:-1]
    of_bin = np.repeat(np.arange(bins), np.diff(np.append(edges, count)))
    known = np.isfinite(values)
    order = np.lexsort((values, ~known, of_bin))  # in each bin: finite ones first, ascending
    finite = np.add.reduceat(known, edges)
    least, greatest = order[edges], order[edges + np.maximum(finite, 1) - 1]
    gaps = order[(edges + finite)[finite < np.diff(np.append(edges, count))]]
    return np.unique(np.concatenate(([0, count - 1], least, greatest, gaps)))


def near_reference(flown: History, times: Array) -> NDArray[np.bool_]:
    """Whether a record of the reference is near each of the times (N,)."""
    stamps = np.sort(flown.reference["time_s"])
    place = np.searchsorted(stamps, times)
    inside = (place > 0) & (place < len(stamps))
    before, after = np.clip(place - 1, 0, None), np.clip(place, None, len(stamps) - 1)
    near: NDArray[np.bool_] = inside & (stamps[after] - stamps[before] <= REFERENCE_GAP_S)
    return near


def _away(flown: History, rows: Rows) -> tuple[Array, Array]:
    """Times (N,), and position minus reference (N, 3) in m where there is a reference."""
    if len(np.unique(flown.reference["time_s"])) < 2:
        return np.zeros(0), np.zeros((0, 3))
    times = rows["time_s"]
    near = near_reference(flown, times)
    errors = np.full((len(rows), 3), np.nan)
    errors[near] = rows["position_ned_m"][near] - Reference(flown.reference).position(times[near])
    return times, errors


def _height_m(rows: Rows) -> Array:
    return np.asarray(-rows["position_ned_m"][:, 2])


def _euler_deg(quaternions: Array) -> Array:
    """Roll, pitch and heading to 1e-4 deg, with a gap where one of them wraps."""
    angles: Array = np.degrees(euler_from_quaternion(quaternions))
    angles = np.asarray(np.round(angles, 4), np.float64)
    angles[1:][np.abs(np.diff(angles, axis=0)) > 180.0] = np.nan
    return angles


def _recorded(
    flown: History, field: str, name: str, colour: str, style: str = "line", scale: float = 1.0,
    *, main: bool = True, dash: str = "solid",
) -> Curve:  # fmt: skip
    values = scale * flown.records[field]
    return Curve(name, flown.records["time_s"], values, colour, style, main, dash)
