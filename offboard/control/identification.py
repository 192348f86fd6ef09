"""One vehicle's constants from a stretch of its flight, each with its uncertainty or a refusal.

`identify` is a pure function of a `Trace`; it takes some milliseconds for ten seconds of flight, so
that it can be called between two ticks. What the flight does not support is not guessed: the value
stays None and a sentence says why. A hover without noise shows no attitude loop, drag needs motion,
thrust lag a thrust that varies. Knows no clock, no file and no MAVLink.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from offboard.control.motion_fit import DRAG_UPPER, Motion, VerticalFit, fit_drag, fit_vertical
from offboard.control.response_fit import (
    LOWER,
    UPPER,
    Estimate,
    ResponseFit,
    commanded_rms,
    fit_response,
)
from offboard.control.trace import (
    COURSE,
    NORTH,
    POSITION,
    SENT_AT,
    SENT_COURSE,
    SENT_NORTH,
    STAMP,
    Trace,
)
from offboard.control.trace import VELOCITY as REPORTED_VELOCITY
from offboard.model.vehicle import AxisResponse, Vehicle

__all__ = [
    "Estimate",
    "EstimatorNoise",
    "Identified",
    "ResponseFit",
    "identify",
    "identify_drag",
    "warm_up",
]

Array = NDArray[np.float64]

# Least excitation: below it there is nothing to see.
TILT_MOVED_RAD, COURSE_MOVED_RAD = 0.004, 0.008
SPEED_MPS, THRUST_MOVED = 0.4, 0.015
# Greatest standard deviation that is still an answer.
TILT_SDS, YAW_SDS = (0.02, 0.1, 0.15), (0.04, 0.15, 0.2)  # delay s, frequency relative, damping
DRAG_SD_PS, HOVER_SD, EFFECT_SD_S = 0.2, 0.02, 0.015
EXPLAINED = 0.6  # least share of the commanded motion that the response must account for
DRAG_BEFOREHAND = Estimate(0.6, 0.4)
SLOWNESS_S = 0.5  # over which a velocity is judged


@dataclass(frozen=True, slots=True)
class EstimatorNoise:
    """Standard deviations: from sample to sample of position (m), reported velocity (m/s) and
    thrust direction (rad); and the part of the reported velocity that is not the derivative of the
    reported position, as means over half a second."""

    position_m: float
    velocity_mps: float
    attitude_rad: float
    velocity_contradiction_mps: float


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
    """Everything that `trace` supports. `vehicle` gives gravity and where a search begins; nothing
    of it comes back as identified. Never raises for what a flight may hold."""
    refusals: dict[str, str] = {}
    seconds = trace.end_s - trace.begin_s
    if not seconds >= 2.0:
        said = f"{max(seconds, 0.0) if seconds == seconds else 0.0:.1f} s of flight, 2 s are needed"
        names = ("tilt", "yaw", "hover_thrust", "thrust_lag_s", "drag_ps", "noise")
        return Identified(0.0, refusals=dict.fromkeys(names, said))
    tilt = _tilt(trace, refusals)
    yaw = _yaw(trace, refusals)
    motion = Motion(trace)
    if not motion.usable:
        said = f"{len(motion.times)} positions and {len(trace.commands)} commands are too few"
        refusals |= dict.fromkeys(("hover_thrust", "thrust_lag_s", "drag_ps"), said)
        return Identified(seconds, tilt, yaw, refusals=refusals)
    vertical = fit_vertical(motion, vehicle.gravity_mps2, DRAG_BEFOREHAND, vehicle.hover_thrust)
    thrust = motion.thrust(vertical.thrust_delay_s.value, vertical.thrust_lag_s.value)
    thrust_mps2 = vehicle.gravity_mps2 / vertical.hover_thrust.value * thrust
    drag = _drag(motion, thrust_mps2, refusals)
    if drag is not None:
        beforehand = Estimate(drag.value, max(drag.sd, 0.2 * drag.value, 0.05))
        hover = vertical.hover_thrust.value
        vertical = fit_vertical(motion, vehicle.gravity_mps2, beforehand, hover)
    hover_thrust, lag_s, delay_s = _vertical(motion, vertical, refusals)
    return Identified(
        seconds=seconds,
        tilt=tilt,
        yaw=yaw,
        hover_thrust=hover_thrust,
        thrust_lag_s=lag_s,
        thrust_delay_s=delay_s,
        drag_ps=drag,
        noise=_noise(trace),
        refusals=refusals,
    )


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


def _yaw(trace: Trace, refusals: dict[str, str]) -> ResponseFit | None:
    signals = np.unwrap(trace.attitude[:, COURSE])[:, None]
    commands = np.unwrap(trace.commands[:, SENT_COURSE])[:, None]
    axis = _Axis("yaw", COURSE_MOVED_RAD, YAW_SDS)
    return _response(trace, axis, signals, commands, refusals)


@dataclass(frozen=True, slots=True)
class _Axis:
    """What is asked of the fit of one axis: least motion, greatest uncertainties."""

    name: str
    moved_rad: float
    sds: tuple[float, float, float]


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
    fit = fit_response(times, signals, sent_at, commands)
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


def _noise(trace: Trace) -> EstimatorNoise:
    velocity = trace.position[:, REPORTED_VELOCITY]
    return EstimatorNoise(
        position_m=_white_sd(trace.position[:, STAMP], trace.position[:, POSITION]),
        velocity_mps=_white_sd(trace.position[:, STAMP], velocity),
        attitude_rad=_white_sd(trace.attitude[:, STAMP], trace.attitude[:, NORTH : NORTH + 2]),
        velocity_contradiction_mps=_contradiction(trace),
    )


def _white_sd(stamps: Array, signals: Array) -> float:
    """What differs from sample to sample, (N, axes): each against the cubic through its two
    neighbours on either side, which any motion follows; median, so that jumps do not count."""
    if len(signals) < 10:
        return math.nan
    away = np.stack([stamps[i : len(stamps) - 4 + i] - stamps[2:-2] for i in (0, 1, 3, 4)])
    weights = np.ones_like(away)
    for i in range(4):
        for j in range(4):
            if i != j:
                weights[i] *= away[j] / (away[j] - away[i])
    around = np.stack([signals[i : len(signals) - 4 + i] for i in (0, 1, 3, 4)])
    surprise = signals[2:-2] - np.einsum("kn,kna->na", weights, around)
    white = surprise / np.sqrt(1.0 + np.sum(weights**2, axis=0))[:, None]
    return float(np.median(np.abs(white))) / 0.6745  # of a normal distribution


def _contradiction(trace: Trace) -> float:
    """Mean reported velocity less the mean velocity of the reported position, over SLOWNESS_S."""
    stamps = trace.position[:, STAMP]
    starts = np.arange(stamps[0], stamps[-1] - SLOWNESS_S, SLOWNESS_S)
    if len(starts) < 2:
        return math.nan
    differences = []
    for axis in range(3):
        position, velocity = trace.position[:, 1 + axis], trace.position[:, 4 + axis]
        travelled = np.concatenate(
            ([0.0], np.cumsum(0.5 * (velocity[1:] + velocity[:-1]) * np.diff(stamps)))
        )
        gap = travelled - position
        differences.append(
            np.interp(starts + SLOWNESS_S, stamps, gap) - np.interp(starts, stamps, gap)
        )
    return float(np.std(differences) / SLOWNESS_S)
