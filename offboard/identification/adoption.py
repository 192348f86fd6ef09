"""Bounds within which identified constants are adopted, and the vehicles that follow from them."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

from offboard.identification.uncertainty import Estimate
from offboard.identification.vehicle_fit import Identified
from offboard.model.vehicle import (
    DAMPING_LIMITS,
    DELAY_LIMITS_S,
    FREQUENCY_LIMITS_RADPS,
    HOVER_THRUST_LIMITS,
    AxisResponse,
    Vehicle,
)

# Least and greatest value of each constant, whatever the vehicle file says.
BOUNDS = {
    "delay": DELAY_LIMITS_S,
    "frequency": FREQUENCY_LIMITS_RADPS,
    "damping": DAMPING_LIMITS,
    "hover thrust": HOVER_THRUST_LIMITS,
    "thrust lag": (0.0, 0.4),
    "thrust delay": (0.0, 0.5),
    "drag": (0.02, 3.0),
}
DELAY_SLACK_S = 0.4  # allowed in addition to the factor: a link may be slow
LINK_S = 0.03  # a smaller difference of delays is the vehicle's own, not the link's


def within_bounds(
    found: Identified, vehicle_file: Vehicle, factor: float
) -> tuple[Identified, list[str]]:
    """`found` without constants that are outside BOUNDS or differ from the vehicle file's by more
    than `factor`, and a sentence about each of those."""
    sentences: list[str] = []
    rejected: dict[str, Any] = {}

    def outside(what: str, value: float, expected: float, kind: str, slack: float = 0.0) -> bool:
        low, high = BOUNDS[kind]
        low = max(low, expected / factor - slack)
        high = min(high, expected * factor + slack)
        if low <= value <= high:
            return False
        sentences.append(
            f"{what} {value:.3g} contradicts the {expected:.3g} of vehicle {vehicle_file.name} "
            f"({low:.3g} to {high:.3g} allowed), not adopted"
        )
        return True

    for name in ("tilt", "yaw"):
        fit, axis = getattr(found, name), getattr(vehicle_file, name)
        if fit is None:
            continue
        assert isinstance(axis, AxisResponse)
        frequency = axis.natural_frequency_radps
        if (
            outside(f"{name} delay", fit.delay_s.value, axis.delay_s, "delay", DELAY_SLACK_S)
            or outside(
                f"{name} frequency", fit.natural_frequency_radps.value, frequency, "frequency"
            )
            or outside(f"{name} damping", fit.damping.value, axis.damping, "damping")
        ):
            rejected[name] = None
    for name, what, expected, slack in (
        ("hover_thrust", "hover thrust", vehicle_file.hover_thrust, 0.0),
        ("thrust_lag_s", "thrust lag", vehicle_file.thrust_lag_s, DELAY_SLACK_S),
        ("thrust_delay_s", "thrust delay", vehicle_file.thrust_delay_s, DELAY_SLACK_S),
        ("drag_ps", "drag", vehicle_file.drag_per_mass_ps, 0.0),
    ):
        estimate: Estimate | None = getattr(found, name)
        if estimate is not None and outside(what, estimate.value, expected, what, slack):
            rejected[name] = None
    return (replace(found, **rejected) if rejected else found), sentences


def with_link_delay(found: Identified, target: Vehicle, vehicle_file: Vehicle) -> Vehicle:
    """`target`, its delays of thrust and course increased by what the link adds to the tilt's,
    unless they were identified themselves."""
    if found.tilt is None:
        return target
    added_s = found.tilt.delay_s.value - vehicle_file.tilt.delay_s
    if added_s < LINK_S:
        return target
    update: dict[str, Any] = {}
    thrust_delay_s = vehicle_file.thrust_delay_s + added_s
    if target.thrust_delay_s < thrust_delay_s - LINK_S and found.thrust_delay_s is None:
        update["thrust_delay_s"] = thrust_delay_s
    yaw_delay_s = vehicle_file.yaw.delay_s + added_s
    if found.yaw is None and target.yaw.delay_s < yaw_delay_s - LINK_S:
        delay_s = min(yaw_delay_s, DELAY_LIMITS_S[1])
        update["yaw"] = target.yaw.model_copy(update={"delay_s": delay_s})
    return target.model_copy(update=update)


def with_added_delay(vehicle: Vehicle, added_s: float) -> Vehicle:
    """`vehicle` behind a link that adds `added_s` to each of its delays."""
    most_s = DELAY_LIMITS_S[1]

    def axis(response: AxisResponse) -> AxisResponse:
        return response.model_copy(update={"delay_s": min(response.delay_s + added_s, most_s)})

    return vehicle.model_copy(
        update={
            "tilt": axis(vehicle.tilt),
            "yaw": axis(vehicle.yaw),
            "thrust_delay_s": min(vehicle.thrust_delay_s + added_s, most_s),
        }
    )


def interpolated(before: Vehicle, after: Vehicle, share: float) -> Vehicle:
    """The vehicle whose constants are `share` of the way from `before` to `after`."""

    def between(a: float, b: float) -> float:
        return a + share * (b - a)

    def axis(a: AxisResponse, b: AxisResponse) -> AxisResponse:
        return AxisResponse(
            delay_s=between(a.delay_s, b.delay_s),
            natural_frequency_radps=between(a.natural_frequency_radps, b.natural_frequency_radps),
            damping=between(a.damping, b.damping),
        )

    drag = zip(before.drag_translation_npmps, after.drag_translation_npmps, strict=True)
    return after.model_copy(
        update={
            "tilt": axis(before.tilt, after.tilt),
            "yaw": axis(before.yaw, after.yaw),
            "hover_thrust": between(before.hover_thrust, after.hover_thrust),
            "thrust_lag_s": between(before.thrust_lag_s, after.thrust_lag_s),
            "thrust_delay_s": between(before.thrust_delay_s, after.thrust_delay_s),
            "drag_translation_npmps": tuple(between(a, b) for a, b in drag),
        }
    )


def summary(found: Identified) -> str:
    """The identified constants in one line for the user."""
    parts = []
    for name, fit in (("tilt", found.tilt), ("yaw", found.yaw)):
        if fit is not None:
            parts.append(
                f"{name} delay {1e3 * fit.delay_s.value:.0f} ms, "
                f"{fit.natural_frequency_radps.value:.1f} rad/s, damping {fit.damping.value:.2f}"
            )
    if found.hover_thrust is not None:
        parts.append(f"hover thrust {found.hover_thrust.value:.3f}")
    if found.thrust_lag_s is not None:
        parts.append(f"thrust lag {1e3 * found.thrust_lag_s.value:.0f} ms")
    if found.drag_ps is not None:
        parts.append(f"drag {found.drag_ps.value:.2f} +- {found.drag_ps.sd:.2f} 1/s")
    return "identified " + "; ".join(parts)


def log_record(found: Identified) -> tuple[float, ...]:
    """Value and sd of each constant, for the log: tilt (delay, frequency, damping), yaw, hover
    thrust, thrust lag, thrust delay, drag; NaN for what was not identified."""
    estimates: list[Estimate | None] = []
    for fit in (found.tilt, found.yaw):
        estimates += (fit.delay_s, fit.natural_frequency_radps, fit.damping) if fit else (None,) * 3
    estimates += [found.hover_thrust, found.thrust_lag_s, found.thrust_delay_s, found.drag_ps]
    numbers: list[float] = []
    for each in estimates:
        numbers += (each.value, each.sd) if each else (math.nan, math.nan)
    return tuple(numbers)
