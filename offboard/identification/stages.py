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

from offboard.identification.axis_identification import tilt_of, yaw_of
from offboard.identification.estimator_noise import EstimatorNoise, noise_of
from offboard.identification.motion import Motion
from offboard.identification.motion_fit import (
    DRAG_UPPER,
    VerticalFit,
    VerticalPrior,
    fit_drag,
    fit_vertical,
)
from offboard.identification.response_fit import Estimate, ResponseFit
from offboard.identification.trace import Trace
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
SPEED_MPS, THRUST_MOVED = 0.4, 0.015
# Greatest standard deviation that is still an answer.
DRAG_SD_PS, HOVER_SD, EFFECT_SD_S = 0.2, 0.02, 0.03
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
    tilt = tilt_of(trace, refusals)
    yield
    link = _link(tilt, vehicle)
    yaw = yaw_of(trace, _shifted(vehicle.yaw.delay_s, YAW_DELAY_SD_S, link), refusals)
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
    return Identified(seconds, tilt=tilt_of(trace, refusals), refusals=refusals)


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


def _drag(motion: Motion, thrust_mps2: Array, refusals: dict[str, str]) -> Estimate | None:
    speed_mps = motion.speed_mps
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
