"""An identification in a report: the constants, and how well they reproduce the flight."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from offboard.analysis.identify import constants, estimator_noise
from offboard.analysis.page import BLUE, GREY, RED, Figure, curve, panels
from offboard.identification.attitude_fit import tilt_signals, yaw_signals
from offboard.identification.response import second_order
from offboard.identification.trace import Trace
from offboard.identification.vehicle_fit import Identified
from offboard.model.vehicle import AxisResponse, Vehicle

Array = NDArray[np.float64]

SHOWN_S = 20.0  # the figures show the end of the flight; a longer part is too dense to read


def fits(found: Identified, trace: Trace, prior: Vehicle) -> dict[str, Any]:
    """Return what the page shows of an identification: the constants, and how well they reproduce
    the end of the flight.

    Args:
        found: the identified constants.
        trace: the part of the log from which they were identified.
        prior: the vehicle before the identification; it supplies the other constants.
    """
    vehicle = found.applied_to(prior)
    last = trace.between(max(trace.begin_s, trace.end_s - SHOWN_S), trace.end_s)
    flown = not math.isnan(trace.begin_s) and len(trace.commands) > 0
    figures = []
    if flown:
        axes = ("thrust direction north", "thrust direction east")
        figures = [
            _response("Tilt", axes, tilt_signals(last), vehicle.tilt),
            _response("Heading", ("heading, deg",), yaw_signals(last), vehicle.yaw, 180 / math.pi),
        ]
    return {
        "title": f"Identified from {found.seconds:.1f} s",
        "rows": [row for rows in constants(found).values() for row in rows],
        "noise": _noise(trace) if found.seconds else "",
        "figures": figures,
    }


def _noise(trace: Trace) -> str:
    position_m, velocity_mps, attitude_rad, differ_mps = estimator_noise(trace)
    return (
        f"Noise of the autopilot's estimate from sample to sample: position {1e3 * position_m:.2g} "
        f"mm, velocity {1e3 * velocity_mps:.2g} mm/s, attitude {1e3 * attitude_rad:.2g} mrad. Over "
        f"half a second its velocity and the change of its position differ by {differ_mps:.2g} m/s."
    )


def _response(
    title: str,
    titles: tuple[str, ...],
    signals: tuple[Array, Array, Array, Array],
    response: AxisResponse,
    scale: float = 1.0,
) -> Figure:
    """Draw commanded, estimated and modelled signals multiplied by `scale`, one panel per axis."""
    times, measured, sent_at, sent = signals
    constants = response.delay_s, response.natural_frequency_radps, response.damping
    modelled = second_order(times, sent_at, sent, *constants)
    shown = sent_at >= times[0]
    figure = panels(titles, "vehicle time, s")
    for axis in range(len(titles)):
        commanded, steps = scale * sent[shown, axis], {"width": 1.0, "shape": "hv"}
        curve(figure, axis + 1, sent_at[shown], commanded, "commanded", GREY, line=steps)
        curve(figure, axis + 1, times, scale * measured[:, axis], "estimated", BLUE)
        curve(figure, axis + 1, times, scale * modelled[:, axis], "identified response", RED)
    caption = "The identified response should coincide with the autopilot's estimate."
    return Figure(title, figure, caption)
