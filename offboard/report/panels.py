"""The panels of a report: a table of curves over vehicle time, in groups."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from offboard.analysis.history import History
from offboard.analysis.page import BLUE, GREEN, INK, ORANGE, PINK, PURPLE
from offboard.analysis.tracking import Reference, each_once
from offboard.model.frames import euler_from_quaternion

Array = NDArray[np.float64]
Points = tuple[Array, ...]  # times and values (N,), and standard deviations (N,) if there are any
Source = Callable[[History], Points]

BINS = 1500  # per curve, see `thinned`
LEAST_SHOWN = 1e-16  # smaller values, such as 0, are drawn here on a logarithmic axis
ESTIMATED, TRUE, COMMANDED = "estimated", "true (simulator)", "commanded"
AXES = (("north", GREEN, "solid"), ("east", PINK, "dash"), ("down", INK, "dot"))


@dataclass(frozen=True, slots=True)
class Curve:
    """A curve of one flight. `main`: whether it is drawn also in a report of several flights.
    `style`: "line", "steps" or "dots"; dots may have error bars of one standard deviation."""

    name: str
    source: Source
    colour: str
    style: str = "line"
    main: bool = True
    dash: str = "solid"


@dataclass(frozen=True, slots=True)
class Panel:
    title: str
    curves: tuple[Curve, ...]
    logarithmic: bool = False
    caption: str = ""


# ---------------------------------------------------------------------- sources


def _column(array: str, column: str, scale: float = 1.0, axis: int | None = None) -> Source:
    def samples(flown: History) -> Points:
        rows = getattr(flown, array)
        values = rows[column] if axis is None else rows[column][:, axis]
        return rows["time_s"], scale * values

    return samples


def _away(array: str, axis: int | None = None) -> Source:
    """Distance from the reference, or its component along an axis; NaN without a reference."""

    def samples(flown: History) -> Points:
        rows, reference = each_once(getattr(flown, array)), Reference.of(flown)
        if reference is None:
            return np.zeros(0), np.zeros(0)
        errors = reference.errors(rows, "position_ned_m")
        errors[~reference.is_near(rows["time_s"])] = np.nan
        values = np.linalg.norm(errors, axis=1) if axis is None else errors[:, axis]
        return rows["time_s"], np.asarray(values)

    return samples


def _speed(flown: History) -> Points:
    speed = np.linalg.norm(flown.position["velocity_ned_mps"], axis=1)
    return flown.position["time_s"], np.asarray(speed)


def _euler_deg(array: str, axis: int) -> Source:
    """Roll, pitch or heading, rounded to 1e-4 deg, with a gap where the angle wraps."""

    def samples(flown: History) -> Points:
        rows = getattr(flown, array)
        radians = np.asarray(euler_from_quaternion(rows["quaternion"])[..., axis], np.float64)
        angles = np.asarray(np.round(np.degrees(radians), 4), np.float64)
        angles[1:][np.abs(np.diff(angles)) > 180.0] = np.nan
        return rows["time_s"], angles

    return samples


def _intervals_ms(flown: History) -> Points:
    stamps = np.unique(flown.position["time_s"])
    return stamps[1:], 1e3 * np.diff(stamps)


def _identified(constant: str, scale: float = 1.0) -> Source:
    def samples(flown: History) -> Points:
        times, estimates = flown.estimates(constant)
        value, sd = scale * estimates.T
        return times, value, sd

    return samples


# ---------------------------------------------------------------------- the table

_TILT, _YAW = "tilt_natural_frequency_radps", "yaw_natural_frequency_radps"
GROUPS: dict[str, tuple[str, tuple[Panel, ...]]] = {
    "tracking": ("Tracking", (
        Panel("distance from the reference, m", (
            Curve(ESTIMATED, _away("position"), BLUE),
            Curve(TRUE, _away("truth"), ORANGE, main=False),
        ), caption="The reference is known from the climb to the landing."),
        Panel("estimated error by axis, m", tuple(
            Curve(name, _away("position", axis), colour, main=False, dash=dash)
            for axis, (name, colour, dash) in enumerate(AXES)
        )),
        Panel("height, m", (
            Curve(ESTIMATED, _column("position", "position_ned_m", -1.0, axis=2), BLUE),
            Curve(TRUE, _column("truth", "position_ned_m", -1.0, axis=2), ORANGE, main=False),
            Curve("reference", _column("reference", "position_ned_m", -1.0, axis=2), INK,
                  main=False, dash="dash"),
        )),
        Panel("speed, m/s", (Curve(ESTIMATED, _speed, BLUE),)),
    )),
    "attitude": ("Attitude commanded and flown", tuple(
        Panel(f"{title}, deg", (
            Curve(COMMANDED, _euler_deg("commanded", axis), ORANGE, "steps", main=False),
            Curve(ESTIMATED, _euler_deg("attitude", axis), BLUE),
        ))
        for axis, title in enumerate(("roll", "pitch", "heading"))
    )),
    "thrust": ("Thrust and battery", (
        Panel("thrust, 0 to 1", (
            Curve(COMMANDED, _column("commanded", "thrust"), ORANGE, "steps"),
            Curve("hover thrust, estimated", _column("records", "hover_thrust"), INK, main=False,
                  dash="dash"),
        )),
        Panel("battery, %", (Curve("remaining", _column("battery", "remaining"), BLUE, "steps"),)),
        Panel("battery, V", (
            Curve("voltage", _column("battery", "voltage_mv", 1e-3), BLUE, "steps"),
        )),
    )),
    "decisions": ("Decisions", (
        Panel("gap: cost above the exact optimum", (
            Curve("gap", _column("records", "gap"), BLUE, "dots"),
        ), logarithmic=True, caption="Zero is drawn at 1e-16. Only decisions that were sent as "
              "certified have a gap."),
        Panel("spread of the swarm (ε, Eq. 29)", (
            Curve("spread", _column("records", "spread"), BLUE, "dots"),
        ), logarithmic=True),
        Panel("solve time, ms", (
            Curve("solve time", _column("records", "solve_time_s", 1e3), BLUE, "dots"),
        )),
    )),
    "link": ("Link", (
        Panel("age and delay, ms", (
            Curve("telemetry at its setpoint", _column("records", "age_s", 1e3), BLUE, "dots"),
            Curve("delay of the link (TIMESYNC)", _column("link_delay", "delay_s", 1e3),
                  ORANGE, main=False),
            Curve("telemetry in to setpoint out (host time)",
                  _column("records", "answer_s", 1e3), GREEN, "dots", main=False),
        )),
        Panel("interval between positions, ms", (
            Curve("positions", _intervals_ms, BLUE, "dots"),
        )),
    )),
    "identification": ("Identified and estimated", (
        Panel("identified delay, ms", (
            Curve("tilt", _identified("tilt_delay_s", 1e3), BLUE, "dots"),
            Curve("yaw", _identified("yaw_delay_s", 1e3), ORANGE, "dots", main=False),
        ), caption="Bars: one standard deviation."),
        Panel("identified natural frequency, rad/s", (
            Curve("tilt", _identified(_TILT), BLUE, "dots"),
            Curve("yaw", _identified(_YAW), ORANGE, "dots", main=False),
        )),
        Panel("hover thrust, 0 to 1", (
            Curve("identified", _identified("hover_thrust"), INK, "dots"),
            Curve(ESTIMATED, _column("records", "hover_thrust"), PURPLE, main=False),
        )),
        Panel("identified drag, 1/s", (Curve("drag", _identified("drag_ps"), BLUE, "dots"),)),
        Panel("estimated disturbance, m/s²", tuple(
            Curve(name, _column("records", f"disturbance_{name}_mps2"), colour, main=False,
                  dash=dash)
            for name, colour, dash in AXES
        )),
    )),
}  # fmt: skip


def thinned(values: Array, bins: int = BINS) -> NDArray[np.intp]:
    """Return the indices of the `values` (N,) to draw.

    These are all, if there are few. Else the values are divided into bins of equally many samples,
    and from each bin the least, the greatest and the first value that is not finite are drawn. The
    last of these is a gap of the curve.
    """
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
