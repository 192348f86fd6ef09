"""How tilt and course answer their commands in a stretch of flight, or why it does not show.

A sentence for each answer withheld goes into the caller's `refusals`, under the axis's name. Knows
a trace and no vehicle.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from offboard.identification.response_fit import Estimate, ResponseFit, commanded_rms, fit_response
from offboard.identification.response_search import LOWER, UPPER
from offboard.identification.trace import (
    COURSE,
    NORTH,
    SENT_AT,
    SENT_COURSE,
    SENT_NORTH,
    STAMP,
    Trace,
)

Array = NDArray[np.float64]

# Least excitation: below it there is nothing to see.
TILT_MOVED_RAD, COURSE_MOVED_RAD = 0.004, 0.008
# Greatest standard deviation that is still an answer.
TILT_SDS, YAW_SDS = (0.01, 0.15, 0.15), (0.04, 0.15, 0.2)  # delay s, frequency relative, damping
EXPLAINED = 0.6  # least share of the commanded motion that the response must account for


def tilt_of(trace: Trace, refusals: dict[str, str]) -> ResponseFit | None:
    """Both components of the thrust direction at once."""
    signals = trace.attitude[:, NORTH : NORTH + 2]
    commands = trace.commands[:, SENT_NORTH : SENT_NORTH + 2]
    return _response(trace, _Axis("tilt", TILT_MOVED_RAD, TILT_SDS), signals, commands, refusals)


def yaw_of(trace: Trace, delay: Estimate, refusals: dict[str, str]) -> ResponseFit | None:
    """The course; `delay` is what is known of its delay beforehand."""
    signals = np.unwrap(trace.attitude[:, COURSE])[:, None]
    commands = np.unwrap(trace.commands[:, SENT_COURSE])[:, None]
    axis = _Axis("yaw", COURSE_MOVED_RAD, YAW_SDS, delay)
    return _response(trace, axis, signals, commands, refusals)


@dataclass(frozen=True, slots=True)
class _Axis:
    """What is asked of the fit of one axis: least motion, greatest uncertainties; and its delay as
    known beforehand."""

    name: str
    moved_rad: float
    sds: tuple[float, float, float]
    delay: Estimate | None = None


def _response(
    trace: Trace, axis: _Axis, signals: Array, commands: Array, refusals: dict[str, str]
) -> ResponseFit | None:
    times, sent_at = trace.attitude[:, STAMP], trace.commands[:, SENT_AT]
    if len(times) < 50 or len(sent_at) < 3:
        refusals[axis.name] = f"{len(times)} attitudes and {len(sent_at)} commands are too few"
        return None
    moved = commanded_rms(times, sent_at, commands)
    if moved < axis.moved_rad:
        refusals[axis.name] = (
            f"its command moved by {1e3 * moved:.1f} mrad rms, "
            f"{1e3 * axis.moved_rad:.0f} are needed: fly steps"
        )
        return None
    fit = fit_response(times, signals, sent_at, commands, axis.delay)
    if (refusal := _refusal(fit, axis.sds)) is not None:
        refusals[axis.name] = refusal
        return None
    return fit


def _refusal(fit: ResponseFit, limits: tuple[float, float, float]) -> str | None:
    """Why a fit is no answer, or None."""
    if fit.residual_rms > (1.0 - EXPLAINED) * fit.commanded_rms:
        return (
            f"it does not follow its command: {1e3 * fit.residual_rms:.1f} mrad rms are left of "
            f"{1e3 * fit.commanded_rms:.1f} commanded"
        )
    scales = (1.0, fit.natural_frequency_radps.value, 1.0)
    names = ("delay in s", "natural frequency in rad/s", "damping")
    estimates = (fit.delay_s, fit.natural_frequency_radps, fit.damping)
    for index, (name, estimate) in enumerate(zip(names, estimates, strict=True)):
        margin = 1e-3 * (UPPER[index] - LOWER[index])
        low = index > 0 and estimate.value < LOWER[index] + margin
        if low or estimate.value > UPPER[index] - margin:
            return f"its {name} ends at the edge of its range, {estimate.value:.3g}"
        limit = limits[index] * scales[index]
        if not estimate.sd <= limit:
            return f"its {name} is uncertain by {estimate.sd:.2g} (limit {limit:.2g}): fly steps"
    return None
