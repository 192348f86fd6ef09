"""One vehicle's constants from a stretch of its flight, each with its uncertainty or a refusal.

`identify` is a pure function of a `Trace`, and `stages` the same in pieces of some milliseconds, so
that one can be done between two ticks. What the flight does not support is not guessed: the value
stays None and a sentence says why. A hover without noise shows no attitude loop, drag needs motion,
thrust lag a thrust that varies. Knows no clock, no file and no MAVLink.
"""

from __future__ import annotations

import math
from collections.abc import Generator, Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from offboard.control.estimator_noise import SLOWNESS_S, EstimatorNoise, noise_of
from offboard.control.motion_fit import (
    DRAG_UPPER,
    Motion,
    VerticalFit,
    VerticalPrior,
    fit_drag,
    fit_vertical,
)
from offboard.control.response_fit import Estimate, ResponseFit, commanded_rms, fit_response
from offboard.control.response_search import LOWER, UPPER
from offboard.control.trace import (
    COURSE,
    NORTH,
    SENT_AT,
    SENT_COURSE,
    SENT_NORTH,
    STAMP,
    Trace,
)
from offboard.model.vehicle import AxisResponse, Vehicle

__all__ = [
    "Estimate",
    "EstimatorNoise",
    "Identified",
    "ResponseFit",
    "identify",
    "identify_drag",
    "identify_tilt",
    "stages",
    "warm_up",
]

Array = NDArray[np.float64]

# Least excitation: below it there is nothing to see.
TILT_MOVED_RAD, COURSE_MOVED_RAD = 0.004, 0.008
SPEED_MPS, THRUST_MOVED = 0.4, 0.015
# Greatest standard deviation that is still an answer.
TILT_SDS, YAW_SDS = (0.01, 0.15, 0.15), (0.04, 0.15, 0.2)  # delay s, frequency relative, damping
DRAG_SD_PS, HOVER_SD, EFFECT_SD_S = 0.2, 0.02, 0.03
EXPLAINED = 0.6  # least share of the commanded motion that the response must account for
DRAG_BEFOREHAND = Estimate(0.6, 0.4)
# A link adds the same to all delays. How far the rest of them, relative to the tilt's, and the
# thrust's lag are from the vehicle file's, s; and the link itself while the tilt is not known.
YAW_DELAY_SD_S, THRUST_DELAY_SD_S, THRUST_LAG_SD_S, LINK_SD_S = 0.1, 0.03, 0.05, 0.15


@dataclass(frozen=True, slots=True)
class Identified:
    """What one flight says of its vehicle; None with a sentence in `refusals` where it is silent.

    Delays run from the vehicle time of the newest telemetry when a command is sent to its effect.
    """

    seconds: float
    tilt: ResponseFit | None = None
    yaw: ResponseFit | None = None
    hover_thrust: Estimate | None = None
    thrust_lag_s: Estimate | None = None
    thrust_delay_s: Estimate | None = None
    drag_ps: Estimate | None = None
    noise: EstimatorNoise | None = None
    refusals: Mapping[str, str] = field(default_factory=dict)

    @property
    def supported(self) -> bool:
        """Whether anything at all was identified."""
        found = (self.tilt, self.yaw, self.hover_thrust, self.thrust_lag_s, self.drag_ps)
        return any(each is not None for each in found)

    def applied_to(self, vehicle: Vehicle) -> Vehicle:
        """`vehicle` with what was identified; the rest as it was."""
        found: dict[str, object] = {}
        for name, fit in (("tilt", self.tilt), ("yaw", self.yaw)):
            if fit is not None:
                found[name] = AxisResponse(
                    delay_s=fit.delay_s.value,
                    natural_frequency_radps=fit.natural_frequency_radps.value,
                    damping=fit.damping.value,
                )
        for name, estimate in (
            ("hover_thrust", self.hover_thrust),
            ("thrust_lag_s", self.thrust_lag_s),
            ("thrust_delay_s", self.thrust_delay_s),
        ):
            if estimate is not None:
                found[name] = estimate.value
        if self.drag_ps is not None:
            found["drag_translation_npmps"] = (self.drag_ps.value * vehicle.mass_kg,) * 3
        return vehicle.model_validate(vehicle.model_dump() | found)


def identify(trace: Trace, vehicle: Vehicle) -> Identified:
    """Everything that `trace` supports. `vehicle` gives gravity, where a search begins, and how
    the delays of its axes differ. Never raises for what a flight may hold."""
    work = stages(trace, vehicle)
    while True:
        try:
            next(work)
        except StopIteration as done:
            found: Identified = done.value
            return found


def stages(trace: Trace, vehicle: Vehicle) -> Generator[None, None, Identified]:
    """`identify`, a piece at each step."""
    refusals: dict[str, str] = {}
    seconds = trace.end_s - trace.begin_s
    if not seconds >= 2.0:
        said = f"{max(seconds, 0.0) if seconds == seconds else 0.0:.1f} s of flight, 2 s are needed"
        names = ("tilt", "yaw", "hover_thrust", "thrust_lag_s", "drag_ps", "noise")
        return Identified(0.0, refusals=dict.fromkeys(names, said))
    tilt = _tilt(trace, refusals)
    yield
    link = _link(tilt, vehicle)
    yaw = _yaw(trace, _shifted(vehicle.yaw.delay_s, YAW_DELAY_SD_S, link), refusals)
    yield
    motion = Motion(trace)
    if not motion.usable:
        said = f"{len(motion.times)} positions and {len(trace.commands)} commands are too few"
        refusals |= dict.fromkeys(("hover_thrust", "thrust_lag_s", "drag_ps"), said)
        return Identified(seconds, tilt, yaw, refusals=refusals)
    prior = VerticalPrior(
        vehicle.hover_thrust,
        _shifted(vehicle.thrust_delay_s, THRUST_DELAY_SD_S, link),
        Estimate(vehicle.thrust_lag_s, THRUST_LAG_SD_S),
        DRAG_BEFOREHAND,
    )
    vertical = fit_vertical(motion, vehicle.gravity_mps2, prior)
    yield
    thrust = motion.thrust(vertical.thrust_delay_s.value, vertical.thrust_lag_s.value)
    thrust_mps2 = vehicle.gravity_mps2 / vertical.hover_thrust.value * thrust
    drag = _drag(motion, thrust_mps2, refusals)
    if drag is not None:
        yield
        drag_ps = Estimate(drag.value, max(drag.sd, 0.2 * drag.value, 0.05))
        prior = replace(prior, hover_thrust=vertical.hover_thrust.value, drag_ps=drag_ps)
        vertical = fit_vertical(motion, vehicle.gravity_mps2, prior)
    hover_thrust, lag_s, delay_s = _vertical(motion, vertical, refusals)
    return Identified(
        seconds=seconds,
        tilt=tilt,
        yaw=yaw,
        hover_thrust=hover_thrust,
        thrust_lag_s=lag_s,
        thrust_delay_s=delay_s,
        drag_ps=drag,
        noise=noise_of(trace),
        refusals=refusals,
    )


def _link(tilt: ResponseFit | None, vehicle: Vehicle) -> Estimate:
    """What is added to the delays of the vehicle file, by the tilt's account."""
    if tilt is None:
        return Estimate(0.0, LINK_SD_S)
    return Estimate(tilt.delay_s.value - vehicle.tilt.delay_s, tilt.delay_s.sd)


def _shifted(delay_s: float, own_sd_s: float, link: Estimate) -> Estimate:
    return Estimate(max(delay_s + link.value, 0.0), math.hypot(own_sd_s, link.sd))


def identify_drag(trace: Trace, vehicle: Vehicle) -> Identified:
    """The drag alone, the rest of `vehicle` taken for granted: some milliseconds for 20 s of
    flight."""
    refusals: dict[str, str] = {}
    seconds = trace.end_s - trace.begin_s
    drag = None
    if seconds >= 2.0 and (motion := Motion(trace)).usable:
        thrust = motion.thrust(vehicle.thrust_delay_s, vehicle.thrust_lag_s)
        drag = _drag(motion, vehicle.thrust_max_mps2 * thrust, refusals)
    else:
        refusals["drag_ps"] = "too few positions and commands"
    return Identified(seconds, drag_ps=drag, refusals=refusals)


def identify_tilt(trace: Trace) -> Identified:
    """The tilt alone."""
    refusals: dict[str, str] = {}
    seconds = trace.end_s - trace.begin_s
    return Identified(seconds, tilt=_tilt(trace, refusals), refusals=refusals)


def warm_up(vehicle: Vehicle) -> None:
    """Call every compiled path once."""
    times = np.arange(0.0, 4.0, 0.01)
    swing = 0.05 * np.sin(3.0 * times)
    level = np.zeros_like(times)
    attitude = np.column_stack((times, swing, swing, swing))
    position = np.column_stack((times, *(swing,) * 3, *(level,) * 3))
    sent = slice(None, None, 10)
    thrust = np.full_like(times, vehicle.hover_thrust)
    commands = np.column_stack((times, swing, swing, thrust, swing))[sent]
    identify(Trace(commands, attitude, position), vehicle)


def _tilt(trace: Trace, refusals: dict[str, str]) -> ResponseFit | None:
    signals = trace.attitude[:, NORTH : NORTH + 2]
    commands = trace.commands[:, SENT_NORTH : SENT_NORTH + 2]
    return _response(trace, _Axis("tilt", TILT_MOVED_RAD, TILT_SDS), signals, commands, refusals)


def _yaw(trace: Trace, delay: Estimate, refusals: dict[str, str]) -> ResponseFit | None:
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


def _drag(motion: Motion, thrust_mps2: Array, refusals: dict[str, str]) -> Estimate | None:
    speed_mps = _speed_rms(motion)
    if speed_mps < SPEED_MPS:
        refusals["drag_ps"] = (
            f"{speed_mps:.2f} m/s rms over ground, {SPEED_MPS} are needed: drag needs motion"
        )
        return None
    drag = fit_drag(motion, thrust_mps2)
    if not 1e-3 < drag.value < 0.99 * DRAG_UPPER:
        refusals["drag_ps"] = f"the drag ends at the edge of its range, {drag.value:.3g} 1/s"
    elif not drag.sd <= DRAG_SD_PS:
        refusals["drag_ps"] = f"the drag is uncertain by {drag.sd:.2g} 1/s (limit {DRAG_SD_PS})"
    else:
        return drag
    return None


def _vertical(
    motion: Motion, fit: VerticalFit, refusals: dict[str, str]
) -> tuple[Estimate | None, Estimate | None, Estimate | None]:
    """Hover thrust, thrust lag and thrust delay."""
    hover: Estimate | None = fit.hover_thrust
    if not 0.02 < fit.hover_thrust.value < 0.95 or not (
        fit.hover_thrust.sd <= HOVER_SD * fit.hover_thrust.value
    ):
        hover = None
        refusals["hover_thrust"] = (
            f"the hover thrust {fit.hover_thrust.value:.3g} is uncertain by "
            f"{fit.hover_thrust.sd:.2g}"
        )
    thrust = motion.thrust(fit.thrust_delay_s.value, fit.thrust_lag_s.value)
    moved = float(np.std(thrust)) / fit.hover_thrust.value
    if moved < THRUST_MOVED:
        refusals["thrust_lag_s"] = (
            f"the thrust moved by {100.0 * moved:.1f} % rms, {100.0 * THRUST_MOVED:.1f} are "
            "needed: its lag needs a climb that varies"
        )
    elif not fit.thrust_effect_s.sd <= EFFECT_SD_S:
        refusals["thrust_lag_s"] = (
            f"delay and lag of the thrust are uncertain by {fit.thrust_effect_s.sd:.2g} s "
            f"(limit {EFFECT_SD_S})"
        )
    else:
        return hover, fit.thrust_lag_s, fit.thrust_delay_s
    return hover, None, None


def _speed_rms(motion: Motion) -> float:
    """Horizontal, from positions SLOWNESS_S apart."""
    later = motion.times + SLOWNESS_S
    within = later <= motion.times[-1]
    if not within.any():
        return 0.0
    moved = [
        np.interp(later[within], motion.times, along) - along[within]
        for along in motion.positions[:2]
    ]
    return float(np.sqrt(np.mean(np.sum(np.square(moved), axis=0)))) / SLOWNESS_S
