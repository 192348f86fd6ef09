"""What of an identification may be taken over, how it is told, and the vehicles on the way there.

Pure functions of vehicle and identification: bounds, the share of a slow link, blends, words.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

from offboard.identification.response_fit import Estimate
from offboard.identification.stages import Identified
from offboard.model.vehicle import AxisResponse, Vehicle

# Least and greatest value, and what a delay may differ by whatever the factor.
BOUNDS = {
    "delay": (0.0, 0.5),
    "frequency": (2.0, 45.0),
    "damping": (0.2, 2.5),
    "hover thrust": (0.1, 0.8),
    "thrust lag": (0.0, 0.25),
    "thrust delay": (0.0, 0.5),
    "drag": (0.02, 3.0),
}
LINK_S = 0.03  # a smaller difference of delays is the vehicle's
DELAY_SLACK_S = 0.4  # a link may be slow


def with_link(found: Identified, target: Vehicle, believed: Vehicle) -> Vehicle:
    """What a slow link adds to the tilt's delay it adds to those of thrust and course: they follow
    it while they have not been identified themselves."""
    if found.tilt is None:
        return target
    added_s = found.tilt.delay_s.value - believed.tilt.delay_s
    if added_s < LINK_S:
        return target
    update: dict[str, Any] = {}
    if target.thrust_delay_s < believed.thrust_delay_s + added_s - LINK_S and (
        found.thrust_delay_s is None
    ):
        update["thrust_delay_s"] = believed.thrust_delay_s + added_s
    if found.yaw is None and target.yaw.delay_s < believed.yaw.delay_s + added_s - LINK_S:
        delay_s = min(believed.yaw.delay_s + added_s, BOUNDS["delay"][1])
        update["yaw"] = target.yaw.model_copy(update={"delay_s": delay_s})
    return target.model_copy(update=update)


def later(vehicle: Vehicle, added_s: float) -> Vehicle:
    """The vehicle behind a link that adds to every delay."""
    most_s = BOUNDS["delay"][1]

    def axis(response: AxisResponse) -> AxisResponse:
        return response.model_copy(update={"delay_s": min(response.delay_s + added_s, most_s)})

    return vehicle.model_copy(
        update={
            "tilt": axis(vehicle.tilt),
            "yaw": axis(vehicle.yaw),
            "thrust_delay_s": min(vehicle.thrust_delay_s + added_s, most_s),
        }
    )


def bounded(found: Identified, believed: Vehicle, factor: float) -> tuple[Identified, list[str]]:
    """Without what is out of bounds or too far from what was believed; sentences say which."""
    sentences: list[str] = []
    refused: dict[str, Any] = {}

    def outside(what: str, value: float, near: float, kind: str, slack: float = 0.0) -> bool:
        low, high = BOUNDS[kind]
        low = max(low, near / factor - slack)
        high = min(high, near * factor + slack)
        if low <= value <= high:
            return False
        sentences.append(
            f"{what} {value:.3g} contradicts the vehicle file's {near:.3g} "
            f"({low:.3g} .. {high:.3g} allowed), not taken over"
        )
        return True

    for name in ("tilt", "yaw"):
        fit, axis = getattr(found, name), getattr(believed, name)
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
            refused[name] = None
    for name, what, near, slack in (
        ("hover_thrust", "hover thrust", believed.hover_thrust, 0.0),
        ("thrust_lag_s", "thrust lag", believed.thrust_lag_s, DELAY_SLACK_S),
        ("thrust_delay_s", "thrust delay", believed.thrust_delay_s, DELAY_SLACK_S),
        ("drag_ps", "drag", believed.drag_per_mass_ps, 0.0),
    ):
        estimate: Estimate | None = getattr(found, name)
        if estimate is not None and outside(what, estimate.value, near, what, slack):
            refused[name] = None
    if refused:
        found = replace(found, **refused)
    return found, sentences


def told(found: Identified) -> str:
    """What was taken over, in one line."""
    said = []
    for name, fit in (("tilt", found.tilt), ("yaw", found.yaw)):
        if fit is not None:
            said.append(
                f"{name} {1e3 * fit.delay_s.value:.0f} ms {fit.natural_frequency_radps.value:.1f} "
                f"rad/s {fit.damping.value:.2f}"
            )
    if found.hover_thrust is not None:
        said.append(f"hover thrust {found.hover_thrust.value:.3f}")
    if found.thrust_lag_s is not None:
        said.append(f"lag {1e3 * found.thrust_lag_s.value:.0f} ms")
    if found.drag_ps is not None:
        said.append(f"drag {found.drag_ps.value:.2f} +- {found.drag_ps.sd:.2f} 1/s")
    return "identified " + ", ".join(said)


def record_of(found: Identified) -> tuple[float, ...]:
    """Value and sd of tilt (delay, frequency, damping), yaw, hover thrust, lag, thrust delay,
    drag; NaN where nothing was identified."""
    estimates: list[Estimate | None] = []
    for fit in (found.tilt, found.yaw):
        estimates += (fit.delay_s, fit.natural_frequency_radps, fit.damping) if fit else (None,) * 3
    estimates += [found.hover_thrust, found.thrust_lag_s, found.thrust_delay_s, found.drag_ps]
    numbers: list[float] = []
    for each in estimates:
        numbers += (each.value, each.sd) if each else (math.nan, math.nan)
    return tuple(numbers)


def mixed(before: Vehicle, after: Vehicle, share: float) -> Vehicle:
    """A vehicle between two, constant by constant."""

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
