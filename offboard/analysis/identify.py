"""Identifies the vehicle of a log and the noise of its estimator, and writes the vehicle file.

The flight may be that of another program, if it sent SET_ATTITUDE_TARGET with the vehicle's system
id and component id 191, as `offboard` does. The time at which it sent one is that of the telemetry
before it in the log.
"""

from __future__ import annotations

import math
import textwrap
from collections.abc import Sequence

import numpy as np
import yaml
from numpy.typing import NDArray
from scipy.integrate import cumulative_trapezoid

from offboard.analysis.history import History
from offboard.documents.errors import plain
from offboard.flight.phases import TRACKING
from offboard.identification.learner import LIFTED_OFF_S
from offboard.identification.trace import NORTH, POSITION, STAMP, VELOCITY, Trace, clean
from offboard.identification.uncertainty import Estimate
from offboard.identification.vehicle_fit import AXES, Identified, identify
from offboard.model.frames import heading_from_quaternion, thrust_direction_from_quaternion
from offboard.model.vehicle import Vehicle

Array = NDArray[np.float64]
Row = tuple[str, Estimate | None, str, str]  # name, estimate, unit, reason without one

_KEPT = (
    "mass_kg", "inertia_kgm2", "arm_m", "drag_rotation_nmpradps",
    "angular_acceleration_limit_radps2", "angular_rate_limit_radps",
)  # fmt: skip
_UNITS = {"s": "s", "radps": "rad/s", "ps": "1/s"}  # suffix of a constant's name -> unit
_KEYS = {"drag_ps": "drag_translation_npmps"}  # constant -> another key in a vehicle file
_REASONS = {"thrust_delay_s": "thrust_lag_s"}  # both are identified together, or neither is
DIGITS = 6  # significant digits of the values in a vehicle file
LINE_WIDTH = 80
IN_AIR = 2  # MAV_LANDED_STATE_IN_AIR
MEAN_OVER_S = 0.5  # time over which reported velocity and position are compared


def identify_flight(history: History, vehicle: Vehicle) -> tuple[Identified, Trace]:
    """Identify the vehicle of a log, starting from the constants of `vehicle`.

    Returns the identified constants and the part of the flight from which they were identified.
    """
    trace = _trace(history)
    return identify(trace, vehicle), trace


def _trace(history: History) -> Trace:
    """Return the part of a log in which the vehicle flew by setpoints."""
    setpoint, attitude = history.setpoint, history.attitude
    position = history.position
    commanded = thrust_direction_from_quaternion(setpoint["quaternion"])
    direction = thrust_direction_from_quaternion(attitude["quaternion"])
    thrust = setpoint["thrust"].astype(np.float64)
    if history.dialect and history.dialect.divides_by_tilt:
        thrust = thrust / np.maximum(commanded[:, 2], 0.3)
    commanded_rad, heading_rad = (
        heading_from_quaternion(rows["quaternion"]) for rows in (setpoint, attitude)
    )
    trace = clean(
        np.column_stack((setpoint["time_s"], commanded[:, :2], thrust, commanded_rad)),
        np.column_stack((attitude["time_s"], direction[:, :2], heading_rad)),
        np.column_stack(
            [position[name] for name in ("time_s", "position_ned_m", "velocity_ned_mps")]
        ),
    )
    return trace.between(*_flown(history))


def _flown(history: History) -> tuple[float, float]:
    """Return when the phases of `offboard` with setpoints in the air began and ended. In a log of
    another program it is the longest time in OFFBOARD or GUIDED between the first and the last
    setpoint, and in the air according to the land detector."""
    indices = [phase.code for phase in TRACKING]
    times = history.records["time_s"][np.isin(history.records["phase"], indices)]
    if len(times):
        return times[0] + LIFTED_OFF_S, times[-1]
    sent = history.setpoint["time_s"]
    if not (len(sent) and history.dialect and history.modes):
        return -math.inf, math.inf
    air = history.landed["time_s"][history.landed["state"] == IN_AIR]
    first_s, last_s = (air[0] + LIFTED_OFF_S, air[-1]) if len(air) else (sent[0], sent[-1])
    first_s, last_s = np.fmax(first_s, sent[0]), np.fmin(last_s, sent[-1])
    ends = [*(mode.time_s for mode in history.modes[1:]), math.inf]
    spans = [
        (float(np.fmax(mode.time_s, first_s)), float(np.fmin(end_s, last_s)))
        for mode, end_s in zip(history.modes, ends, strict=True)
        if mode.what == history.dialect.engage_mode
    ]
    return max(spans, key=lambda span: span[1] - span[0], default=(math.inf, -math.inf))


def constants(found: Identified) -> dict[str, list[Row]]:
    """Return every constant that can be identified, by its key in a vehicle file: its name, its
    estimate or None, its unit, and the reason why it was not identified."""
    by_key: dict[str, list[Row]] = {}
    for constant, estimate in found.estimates.items():
        *words, last = constant.split("_")
        name = " ".join(words if last in _UNITS else (*words, last))
        key = words[0] if words[0] in AXES else constant
        reason = found.refusals.get(_REASONS.get(key, key), "")
        row = name, estimate, _UNITS.get(last, ""), reason
        by_key.setdefault(_KEYS.get(key, key), []).append(row)
    return by_key


def vehicle_file(found: Identified, prior: Vehicle, flight: str) -> str:
    """Return a vehicle file (YAML) from an identification. `flight` names the log.

    Identified constants have their standard deviation as a comment. The other constants are those
    of `prior`; the comment says why they were not identified.
    """
    comments = dict.fromkeys(_KEPT, "not identifiable from telemetry")
    comments |= {key: _comment(rows) for key, rows in constants(found).items()}
    if found.drag_ps:
        comments["drag_translation_npmps"] += " times the mass"
    lines = [f"# Identified from {found.seconds:.0f} s of {flight}; +- is one standard deviation."]
    for key, value in plain(found.applied_to(prior).model_dump(mode="json"), DIGITS).items():
        flow = None if isinstance(value, dict | list) else False
        text = yaml.safe_dump(
            {key: value}, default_flow_style=flow, sort_keys=False, width=math.inf
        )
        lines.append(_line(text.rstrip(), comments.get(key, "")))
    return "\n".join(lines) + "\n"


def _comment(rows: Sequence[Row]) -> str:
    """Return the standard deviations of the constants of one key, or why there are none."""
    known = [(estimate.sd, unit) for _, estimate, unit, _ in rows if estimate]
    if not known:
        return f"not identified: {rows[0][-1]}"
    return "+- " + ", ".join(f"{sd:.2g} {unit}".rstrip() for sd, unit in known)


def _line(entry: str, comment: str) -> str:
    """Return an entry followed by its comment; the comment is above it if the line is too long."""
    line = f"{entry}  # {comment}" if comment else entry
    if len(line) <= LINE_WIDTH:
        return line
    above = textwrap.wrap(
        comment, LINE_WIDTH, initial_indent="# ", subsequent_indent="# ", break_long_words=False
    )
    return "\n".join([*above, entry])


# ---------------------------------------------------------------------- estimator's noise


def estimator_noise(trace: Trace) -> tuple[float, float, float, float]:
    """Return the noise of the vehicle's estimator as four standard deviations.

    The first three are the white noise of position (m), velocity (m/s) and thrust direction (rad).
    The fourth is that of the reported velocity minus the derivative of the reported position (m/s),
    both averaged over MEAN_OVER_S. A value is NaN if the trace is too short for it."""
    stamps, velocity = trace.position[:, STAMP], trace.position[:, VELOCITY]
    direction = trace.attitude[:, NORTH : NORTH + 2]
    return (
        _white_sd(stamps, trace.position[:, POSITION]),
        _white_sd(stamps, velocity),
        _white_sd(trace.attitude[:, STAMP], direction),
        _velocity_contradiction(trace),
    )


def _white_sd(stamps: Array, signals: Array) -> float:
    """Return the sd of the white noise in `signals` (N, axes).

    The noise of a sample is its difference from the cubic through its two neighbours on either
    side, which follows the motion. The sd is computed from the median, which ignores jumps.
    """
    if len(signals) < 10:
        return math.nan
    away = np.stack([stamps[i : len(stamps) - 4 + i] - stamps[2:-2] for i in (0, 1, 3, 4)])
    weights = np.ones_like(away)
    for i in range(4):
        for j in range(4):
            if i != j:
                weights[i] *= away[j] / (away[j] - away[i])
    around = np.stack([signals[i : len(signals) - 4 + i] for i in (0, 1, 3, 4)])
    residual = signals[2:-2] - np.einsum("kn,kna->na", weights, around)
    white = residual / np.sqrt(1.0 + np.sum(weights**2, axis=0))[:, None]
    return float(np.median(np.abs(white))) / 0.6745  # median / sd of a normal distribution


def _velocity_contradiction(trace: Trace) -> float:
    stamps = trace.position[:, STAMP]
    travelled = cumulative_trapezoid(trace.position[:, VELOCITY], stamps, axis=0, initial=0.0)
    apart = travelled - trace.position[:, POSITION]
    ends = np.arange(stamps[0], stamps[-1], MEAN_OVER_S)
    if len(ends) < 3:
        return math.nan
    changes = np.diff([np.interp(ends, stamps, axis) for axis in apart.T])
    return float(np.std(changes) / MEAN_OVER_S)
