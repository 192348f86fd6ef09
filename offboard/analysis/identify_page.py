"""The page of an identification: the constants, and how well they reproduce the flight."""

from __future__ import annotations

import html
import math

import numpy as np
from numpy.typing import NDArray

from offboard.analysis import page as shell
from offboard.analysis.figure import BLUE, GREY, RED, Figure, line, panels
from offboard.analysis.identify import rows
from offboard.identification.estimator_noise import EstimatorNoise
from offboard.identification.motion_fit import Motion, predicted_velocity
from offboard.identification.response import second_order
from offboard.identification.trace import (
    COURSE,
    NORTH,
    SENT_AT,
    SENT_COURSE,
    SENT_NORTH,
    STAMP,
    Trace,
)
from offboard.identification.vehicle_fit import Identified
from offboard.model.vehicle import AxisResponse, Vehicle

Array = NDArray[np.float64]

SHOWN_S = 20.0  # of the flight, its last part: more cannot be seen


def page(flight: str, found: Identified, trace: Trace, believed: Vehicle) -> str:
    """One self-contained HTML document; `flight` is the name of the log."""
    vehicle = found.applied_to(believed)
    last = trace.between(max(trace.begin_s, trace.end_s - SHOWN_S), trace.end_s)
    flown = not math.isnan(trace.begin_s) and len(trace.commands) > 0
    figures = [_tilt(last, vehicle), _yaw(last, vehicle)] if flown else []
    if len(trace.commands) and len(last.position) > 2:
        figures.append(_motion(last, vehicle))
    drawn = [shell.drawing(f"figure_{n}", figure) for n, figure in enumerate(figures)]
    title = f"Identified from {found.seconds:.1f} s of {flight}"
    constants = f"<article>{_table(found)}{_noise(found.noise)}</article>"
    body = f"<h1>{html.escape(title)}</h1>{constants}{''.join(drawn)}"
    return shell.document(title, body)


def _table(found: Identified) -> str:
    body = []
    for what, estimate, unit, why in rows(found):
        if estimate is None:
            cells = f'<td class="text long" colspan="3">not identified: {html.escape(why)}</td>'
        else:
            cells = (
                f"<td>{estimate.value:.4g}</td>"
                f'<td>{estimate.sd:.2g}</td><td class="text">{unit}</td>'
            )
        body.append(f'<tr><td class="text">{what}</td>{cells}</tr>')
    text = ' class="text"'
    head = f"<th{text}>constant</th><th>value</th><th>sd</th><th{text}>unit</th>"
    return shell.table(head, body)


def _noise(noise: EstimatorNoise | None) -> str:
    if noise is None:
        return ""
    return shell.notes(
        [
            f"The estimator, sample to sample: position {1e3 * noise.position_m:.2g} mm, "
            f"velocity {1e3 * noise.velocity_mps:.2g} mm/s, attitude "
            f"{1e3 * noise.attitude_rad:.2g} mrad. Its velocity contradicts its position by "
            f"{noise.velocity_contradiction_mps:.2g} m/s over half a second."
        ]
    )


def _tilt(trace: Trace, vehicle: Vehicle) -> Figure:
    measured = trace.attitude[:, NORTH : NORTH + 2]
    sent = trace.commands[:, SENT_NORTH : SENT_NORTH + 2]
    names = ("thrust direction north", "thrust direction east")
    return _response("Tilt", names, trace, measured, sent, vehicle.tilt, 1.0)


def _yaw(trace: Trace, vehicle: Vehicle) -> Figure:
    measured = np.unwrap(trace.attitude[:, COURSE])[:, None]
    sent = np.unwrap(trace.commands[:, SENT_COURSE])[:, None]
    names = ("course, deg",)
    return _response("Course", names, trace, measured, sent, vehicle.yaw, math.degrees(1.0))


def _response(
    title: str,
    names: tuple[str, ...],
    trace: Trace,
    measured: Array,
    sent: Array,
    response: AxisResponse,
    scale: float,
) -> Figure:
    times, sent_at = trace.attitude[:, STAMP], trace.commands[:, SENT_AT]
    fitted = second_order(
        times,
        sent_at,
        sent,
        response.delay_s,
        response.natural_frequency_radps,
        response.damping,
    )
    shown = sent_at >= times[0]
    traces = []
    for axis in range(measured.shape[1]):
        panel, legend = axis + 1, {"showlegend": axis == 0}
        steps = {"line": {"color": GREY, "width": 1.0, "shape": "hv"}, **legend}
        traces += [
            line(sent_at[shown], scale * sent[shown, axis], "commanded", GREY, panel=panel) | steps,
            line(times, scale * measured[:, axis], "estimated", BLUE, panel=panel, **legend),
            line(times, scale * fitted[:, axis], "response", RED, panel=panel, **legend),
        ]
    return Figure(
        title,
        traces,
        panels(names, "vehicle time, s"),
        "The response should lie on what was estimated.",
    )


def _motion(trace: Trace, vehicle: Vehicle) -> Figure:
    motion = Motion(trace)
    names = ("north, m/s", "east, m/s", "down, m/s")
    traces = []
    with_drag = predicted_velocity(motion, vehicle)
    measured = np.gradient(motion.positions, motion.times, axis=1)
    for axis in range(3):
        legend = {"showlegend": axis == 0}
        traces += [
            line(
                motion.times,
                measured[axis],
                "position, differentiated",
                BLUE,
                panel=axis + 1,
                **legend,
            ),
            line(
                motion.times,
                with_drag[axis],
                "thrust, attitude and drag",
                RED,
                panel=axis + 1,
                **legend,
            ),
        ]
    return Figure(
        "Motion",
        traces,
        panels(names, "vehicle time, s"),
        "Velocity from thrust, attitude and drag alone drifts slowly with what the estimator's "
        "attitude is wrong by; it must not swing with the velocity.",
    )
