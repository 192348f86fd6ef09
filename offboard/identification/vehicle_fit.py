"""All constants of one vehicle that a stretch of its flight determines, each with its uncertainty.

Constants that the flight does not determine stay None, with a sentence that says why: the attitude
response needs steps, the drag needs motion, and the thrust's lag needs a thrust that varies. The
fits run in pieces of some milliseconds, so that each piece can be done between two control ticks.
"""

from __future__ import annotations

import math
from collections.abc import Generator, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, TypeVar

import numpy as np

from offboard.identification.attitude_fit import TILT, YAW, ResponseFit, fit_axis
from offboard.identification.motion_fit import (
    COARSE_SPACING_S,
    DRAG_UPPER_PS,
    Motion,
    fit_drag,
    fit_vertical,
)
from offboard.identification.trace import Trace
from offboard.identification.uncertainty import Array, Estimate
from offboard.model.vehicle import (
    DAMPING_LIMITS,
    DELAY_LIMITS_S,
    FREQUENCY_LIMITS_RADPS,
    HOVER_THRUST_LIMITS,
    Vehicle,
)

Result = TypeVar("Result")
Pieces = Generator[None, None, Result]

LEAST_SECONDS = 2.0
# Least motion: horizontal speed, rms; change of thrust, rms, as a fraction of the hover thrust
LEAST_SPEED_MPS, LEAST_THRUST_CHANGE = 0.4, 0.015
# Greatest accepted standard deviations. That of the hover thrust is relative, and large, because a
# vehicle file may be wrong by much more; then the drag would be wrong too
DRAG_SD_PS, HOVER_SD, EFFECT_SD_S = 0.2, 0.05, 0.1
DRAG_PRIOR_PS = Estimate(0.6, 0.4)
THRUST_EFFECT = ("thrust_lag_s", "thrust_delay_s", "thrust_effect_s")  # accepted together
# A link adds the same to all delays. Prior sd of the delays of yaw and thrust without the link, of
# the thrust's lag, and of the link delay while the tilt is not identified
YAW_DELAY_SD_S, THRUST_DELAY_SD_S, THRUST_LAG_SD_S, LINK_SD_S = 0.1, 0.03, 0.05, 0.15

# Greatest lag of an overdamped response if the factor allows no more; ArduCopter with ATC_INPUT_TC
# 1 has 1 s
LAG_MOST_S = 1.5
DELAY_SLACK_S = 0.4  # allowed in addition to the factor, because a link may be slow
DRAG_SLACK_PS = 0.3  # allowed in addition to the factor: a heavy vehicle may have hardly any drag
LINK_S = 0.03  # smaller differences of delays are attributed to the vehicle, not to the link
AXES = ("tilt", "yaw")
AXIS_BOUNDS = {
    "delay_s": (DELAY_LIMITS_S, DELAY_SLACK_S),
    "natural_frequency_radps": (FREQUENCY_LIMITS_RADPS, 0.0),
    "damping": (DAMPING_LIMITS, 0.0),
}
# Least and greatest value of each constant, whatever the vehicle file says; (limits, slack)
BOUNDS = {f"{axis}_{name}": AXIS_BOUNDS[name] for axis in AXES for name in AXIS_BOUNDS} | {
    "hover_thrust": (HOVER_THRUST_LIMITS, 0.0),
    "thrust_lag_s": ((0.0, 0.4), DELAY_SLACK_S),
    "thrust_delay_s": ((0.0, 0.5), DELAY_SLACK_S),
    "drag_ps": ((0.0, 3.0), DRAG_SLACK_PS),
}


def _constant(of: Any, name: str) -> Any:
    """Return the constant `name` of BOUNDS of a vehicle, or its estimate of an `Identified`."""
    axis, _, rest = name.partition("_")
    if axis not in AXES:
        return getattr(of, name)
    response = getattr(of, axis)
    return None if response is None else getattr(response, rest)


@dataclass(frozen=True, slots=True)
class Identified:
    """Constants identified from `seconds` of flight. A constant that could not be identified is
    None, and `refusals` has the reason under the field's name.

    Delays count from the vehicle time of the newest telemetry when a command is sent to its effect.
    `thrust_effect_s`, the sum of the thrust's delay and lag, is better determined than its parts.
    """

    seconds: float
    tilt: ResponseFit | None = None
    yaw: ResponseFit | None = None
    hover_thrust: Estimate | None = None
    thrust_lag_s: Estimate | None = None
    thrust_delay_s: Estimate | None = None
    thrust_effect_s: Estimate | None = None
    drag_ps: Estimate | None = None
    refusals: Mapping[str, str] = field(default_factory=dict)

    @property
    def estimates(self) -> dict[str, Estimate | None]:
        """The estimates by the names of `BOUNDS`."""
        return {name: _constant(self, name) for name in BOUNDS}

    @property
    def supported(self) -> bool:
        """Whether anything at all was identified."""
        return any(self.estimates.values())

    def applied_to(self, vehicle: Vehicle) -> Vehicle:
        """Return `vehicle` with the identified constants; the others stay as they are."""
        found = {axis: fit.response for axis in AXES if (fit := getattr(self, axis))}
        for name in ("hover_thrust", "thrust_lag_s", "thrust_delay_s"):
            if estimate := getattr(self, name):
                found[name] = estimate.value
        if self.drag_ps:
            found["drag_translation_npmps"] = (self.drag_ps.value * vehicle.mass_kg,) * 3
        return vehicle.model_validate(vehicle.model_dump() | found)


def identify(trace: Trace, vehicle: Vehicle) -> Identified:
    """Identify every constant that a stretch of flight determines.

    Args:
        trace: commands sent, attitudes and positions received; see `Trace` for shapes and units.
        vehicle: the vehicle file's constants: gravity, the start of each search, and how the
            delays of tilt, yaw and thrust differ from each other.

    Returns:
        The constants with standard deviations, and the reasons for those that are missing. No
        flight data raises an exception.

    Example:
        found = identify(clean(commands, attitude, position), vehicle)
        better = found.applied_to(vehicle)
    """
    return completed(identify_in_pieces(trace, vehicle))


def completed(pieces: Pieces[Result]) -> Result:
    """Do all pieces at once and return the result."""
    while True:
        try:
            next(pieces)
        except StopIteration as done:
            result: Result = done.value
            return result


def identify_in_pieces(trace: Trace, vehicle: Vehicle) -> Pieces[Identified]:
    """Do `identify` in pieces, with some milliseconds of work in each."""
    refusals: dict[str, str] = {}
    seconds = trace.seconds
    if seconds < LEAST_SECONDS:
        reason = f"{seconds:.1f} s of flight, {LEAST_SECONDS:.0f} s are needed"
        names = ("tilt", "yaw", "hover_thrust", "thrust_lag_s", "drag_ps")
        return Identified(0.0, refusals=dict.fromkeys(names, reason))
    tilt = yield from fit_axis(TILT, trace, refusals)
    yield
    unknown = Estimate(vehicle.tilt.delay_s, math.inf)
    link = _of_link(tilt.delay_s if tilt else unknown, vehicle)
    yaw_delay = _with_link(vehicle.yaw.delay_s, YAW_DELAY_SD_S, link)
    yaw = yield from fit_axis(YAW, trace, refusals, yaw_delay)
    yield
    found = Identified(seconds, tilt, yaw, refusals=refusals)
    motion = Motion(trace)
    if not motion.sufficient:
        reason = f"{motion.counts} are too few"
        refusals |= dict.fromkeys(("hover_thrust", "thrust_lag_s", "drag_ps"), reason)
        return found
    known = _known_thrust(vehicle, link) | {"drag_ps": DRAG_PRIOR_PS}
    vertical = fit_vertical(motion, vehicle.gravity_mps2, vehicle.hover_thrust, **known)
    if motion.speed_mps >= LEAST_SPEED_MPS:
        yield
    hover = vertical["hover_thrust"].value
    thrust_mps2 = vehicle.gravity_mps2 / hover * _thrust(motion, vertical)
    drag = _drag(motion, thrust_mps2, DRAG_PRIOR_PS.value, refusals)
    if drag is not None:
        yield
        known["drag_ps"] = _known_drag(drag.value, drag.sd)
        vertical = fit_vertical(motion, vehicle.gravity_mps2, hover, **known)
    return replace(found, drag_ps=drag, **_accepted_vertical(motion, vertical, refusals))


def _thrust(motion: Motion, vertical: dict[str, Estimate]) -> Array:
    return motion.thrust(vertical["thrust_delay_s"].value, vertical["thrust_lag_s"].value)


def identify_drag(trace: Trace, vehicle: Vehicle) -> Identified:
    """Identify the drag alone, with the other constants of `vehicle`. This takes some milliseconds
    for 25 s of flight."""
    motion, found = _coarse_motion(trace), Identified(trace.seconds)
    if motion is None:
        return found
    thrust = motion.thrust(vehicle.thrust_delay_s, vehicle.thrust_lag_s)
    thrust_mps2, start_ps = vehicle.thrust_max_mps2 * thrust, vehicle.drag_per_mass_ps
    return replace(found, drag_ps=_drag(motion, thrust_mps2, start_ps, {}))


def identify_thrust(trace: Trace, vehicle: Vehicle, delay: Estimate, file: Vehicle) -> Identified:
    """Identify delay and lag of the thrust alone, with the drag of `vehicle`. The hover thrust is
    fitted too, but not returned. `delay` is that of the tilt, which shows by how much the link
    increases the delays of the vehicle `file`."""
    motion, found = _coarse_motion(trace), Identified(trace.seconds)
    if motion is None:
        return found
    known = _known_thrust(file, _of_link(delay, file))
    known["drag_ps"] = _known_drag(vehicle.drag_per_mass_ps)
    vertical = fit_vertical(motion, vehicle.gravity_mps2, vehicle.hover_thrust, **known)
    return replace(found, **_accepted_vertical(motion, vertical, {}) | {"hover_thrust": None})


def _coarse_motion(trace: Trace) -> Motion | None:
    """Return the motion of a stretch of flight, or None if it is too short for a fit."""
    if trace.seconds < LEAST_SECONDS:
        return None
    motion = Motion(trace, COARSE_SPACING_S)
    return motion if motion.sufficient else None


def _known_thrust(vehicle_file: Vehicle, link: Estimate) -> dict[str, Estimate]:
    return {
        "delay_s": _with_link(vehicle_file.thrust_delay_s, THRUST_DELAY_SD_S, link),
        "lag_s": Estimate(vehicle_file.thrust_lag_s, THRUST_LAG_SD_S),
    }


def _known_drag(drag_ps: float, sd_ps: float = 0.0) -> Estimate:
    return Estimate(drag_ps, max(sd_ps, 0.2 * drag_ps, 0.05))


def _of_link(delay: Estimate, vehicle_file: Vehicle) -> Estimate:
    """Return the delay that the link adds to those of the vehicle file, from the tilt's `delay`."""
    sd_s = delay.sd if delay.known else LINK_SD_S
    return Estimate(delay.value - vehicle_file.tilt.delay_s, sd_s)


def _with_link(delay_s: float, own_sd_s: float, link: Estimate) -> Estimate:
    return Estimate(max(delay_s + link.value, 0.0), math.hypot(own_sd_s, link.sd))


def _drag(
    motion: Motion, thrust_mps2: Array, start_ps: float, refusals: dict[str, str]
) -> Estimate | None:
    """Return the drag, or None and the reason in `refusals`, for example if the vehicle moved too
    slowly."""
    speed_mps = motion.speed_mps
    if speed_mps < LEAST_SPEED_MPS:
        refusals["drag_ps"] = (
            f"horizontal speed {speed_mps:.2f} m/s rms, {LEAST_SPEED_MPS} m/s are needed: "
            "drag needs motion"
        )
        return None
    drag = fit_drag(motion, thrust_mps2, start_ps)
    if not 1e-3 < drag.value < 0.99 * DRAG_UPPER_PS:
        refusals["drag_ps"] = f"the drag is at the limit of the search, {drag.value:.3g} 1/s"
    elif not drag.sd <= DRAG_SD_PS:
        refusals["drag_ps"] = f"the drag is uncertain: sd {drag.sd:.2g} 1/s, limit {DRAG_SD_PS}"
    else:
        return drag
    return None


def _accepted_vertical(
    motion: Motion, fit: dict[str, Estimate], refusals: dict[str, str]
) -> dict[str, Any]:
    """Return hover thrust, thrust lag and thrust delay, by name, if they are certain enough."""
    accepted: dict[str, Any] = {}
    hover, effect = fit["hover_thrust"], fit["thrust_effect_s"]
    if 0.02 < hover.value < 0.95 and hover.sd <= HOVER_SD * hover.value:
        accepted["hover_thrust"] = hover
    else:
        refusals["hover_thrust"] = (
            f"the hover thrust {hover.value:.3g} is uncertain: sd {hover.sd:.2g}"
        )
    moved = float(np.std(_thrust(motion, fit))) / hover.value
    if moved < LEAST_THRUST_CHANGE:
        refusals["thrust_lag_s"] = (
            f"the thrust changed by {100.0 * moved:.1f} % rms, {100.0 * LEAST_THRUST_CHANGE:.1f} % "
            "are needed: its lag shows in a climb"
        )
    elif not effect.sd <= EFFECT_SD_S:
        refusals["thrust_lag_s"] = (
            f"delay and lag of the thrust are uncertain: sd {effect.sd:.2g} s, "
            f"limit {EFFECT_SD_S} s"
        )
    else:
        accepted |= {name: fit[name] for name in THRUST_EFFECT}
    return accepted


# ---------------------------------------------------------------------- bounds and texts


def within_bounds(
    found: Identified, vehicle_file: Vehicle, factor: float
) -> tuple[Identified, list[str]]:
    """Return `found` without constants that are outside BOUNDS or differ from the vehicle file's by
    more than `factor`, and a sentence about each of these."""
    sentences: list[str] = []
    rejected: dict[str, Any] = {}
    for name, estimate in found.estimates.items():
        axis = name.partition("_")[0]
        field = axis if axis in AXES else name
        if estimate is None or field in rejected:
            continue
        (least, greatest), slack = BOUNDS[name]
        of_drag = name == "drag_ps"
        expected = vehicle_file.drag_per_mass_ps if of_drag else _constant(vehicle_file, name)
        low = max(least, expected / factor - slack)
        high = min(greatest, expected * factor + slack)
        response = getattr(found, axis) if axis in AXES else None
        if response and response.overdamped and not name.endswith("delay_s"):
            # hardly more than the ratio of frequency and damping is determined
            file = getattr(vehicle_file, axis)
            name, estimate = f"{axis}_lag_s", response.lag_s
            expected = 2.0 * file.damping / file.natural_frequency_radps
            low, high = 0.0, max(LAG_MOST_S, expected * factor)
        if not low <= estimate.value <= high:
            rejected[field] = None
            sentences.append(
                f"{_in_words(name)} {estimate.value:.3g} contradicts the {expected:.3g} of vehicle "
                f"{vehicle_file.name} ({low:.3g} to {high:.3g} allowed), not adopted"
            )
    return replace(found, **rejected), sentences


def _in_words(name: str) -> str:
    """Return `tilt frequency` for `tilt_natural_frequency_radps`, for example."""
    return " ".join(word for word in name.split("_") if word not in ("natural", "radps", "s", "ps"))


def with_link_delay(
    found: Identified, target: Vehicle, vehicle_file: Vehicle, *, thrust_known: bool
) -> Vehicle:
    """Return `target` with its delays of thrust and yaw increased by the delay that the link adds
    to the tilt, unless they were identified themselves. `thrust_known`: whether that of the thrust
    was."""
    if found.tilt is None:
        return target
    added_s = found.tilt.delay_s.value - vehicle_file.tilt.delay_s
    if added_s < LINK_S:
        return target
    later, update = vehicle_file.later_by(added_s), dict[str, Any]()
    if not thrust_known and target.thrust_delay_s < later.thrust_delay_s - LINK_S:
        update["thrust_delay_s"] = later.thrust_delay_s
    if found.yaw is None and target.yaw.delay_s < later.yaw.delay_s - LINK_S:
        update["yaw"] = target.yaw.model_copy(update={"delay_s": later.yaw.delay_s})
    return target.model_copy(update=update)


def summary(found: Identified) -> str:
    """Return the identified constants in one line for the user."""
    parts = []
    for name, fit in (("tilt", found.tilt), ("yaw", found.yaw)):
        if fit is not None:
            parts.append(
                f"{name} delay {1e3 * fit.delay_s.value:.0f} +- {1e3 * fit.delay_s.sd:.0f} ms, "
                f"{fit.natural_frequency_radps.value:.1f} rad/s, damping {fit.damping.value:.2f}"
            )
    if found.hover_thrust is not None:
        parts.append(f"hover thrust {found.hover_thrust.value:.3f}")
    if found.thrust_lag_s is not None and found.thrust_delay_s is not None:
        lag_ms, delay_ms = 1e3 * found.thrust_lag_s.value, 1e3 * found.thrust_delay_s.value
        parts.append(f"thrust lag {lag_ms:.0f} ms, delay {delay_ms:.0f} ms")
    if found.drag_ps is not None:
        parts.append(f"drag {found.drag_ps.value:.2f} +- {found.drag_ps.sd:.2f} 1/s")
    return "identified " + "; ".join(parts)
