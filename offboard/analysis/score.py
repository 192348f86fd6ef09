"""The figures of one flight, computed from its History.

Tracking, activity and telemetry are scored during the phase TRACK, setpoints from the first one to
the landing, decisions over the whole flight. A figure that the log does not hold is NaN.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, field, fields

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import BPoly

from offboard.analysis import link_figures
from offboard.analysis.history import History
from offboard.flight.phases import PHASE_CODES, Phase
from offboard.model.frames import (
    course_from_quaternion,
    rotation_from_quaternion,
    thrust_direction_from_quaternion,
    wrap_pi,
)

Array = NDArray[np.float64]
NAN = math.nan


def _figure(meaning: str, unit: str = "") -> float:
    value: float = field(default=NAN, metadata={"meaning": meaning, "unit": unit})
    return value


@dataclass(frozen=True, slots=True)
class Score:
    """All figures of a flight, by the names that --require takes.

    Errors are relative to the reference, during the phase TRACK: `position` as the vehicle
    estimates it (LOCAL_POSITION_NED), `truth` as it is in the simulator (HIL_STATE_QUATERNION or
    SIM_STATE). Times are vehicle time. A figure that the log does not hold is NaN.

    Example, with the pytest fixture `fly`:

        assert fly(reference="hover").score.rmse_position_m < 0.05
    """

    rmse_position_m: float = _figure("position error, RMSE", "m")
    mean_position_m: float = _figure("position error, mean", "m")
    p95_position_m: float = _figure("position error, 95th percentile", "m")
    max_position_m: float = _figure("position error, maximum", "m")
    rmse_truth_m: float = _figure("true position error, RMSE", "m")
    max_truth_m: float = _figure("true position error, maximum", "m")
    rmse_velocity_mps: float = _figure("velocity error, RMSE", "m/s")
    p95_velocity_mps: float = _figure("velocity error, 95th percentile", "m/s")
    max_velocity_mps: float = _figure("velocity error, maximum", "m/s")
    rmse_course_deg: float = _figure("course error, RMSE", "deg")
    max_course_deg: float = _figure("course error, maximum", "deg")
    mu_e: float = _figure("fitness of the paper, Eq. 31")
    e_u: float = _figure("Eq. 32, body velocity u", "m2/s2")
    e_v: float = _figure("Eq. 32, body velocity v", "m2/s2")
    e_w: float = _figure("Eq. 32, body velocity w", "m2/s2")
    e_x: float = _figure("Eq. 32, north", "m2")
    e_y: float = _figure("Eq. 32, east", "m2")
    e_z: float = _figure("Eq. 32, down", "m2")
    e_psi: float = _figure("Eq. 32, course", "deg2")
    tracked_s: float = _figure("time scored", "s")
    thrust_sd: float = _figure("commanded thrust (0 .. 1), sd")
    tilt_command_step_deg: float = _figure("commanded tilt, RMS of its steps", "deg")
    tilt_max_deg: float = _figure("tilt, maximum", "deg")
    tilt_agitation_deg: float = _figure("tilt beside the reference's, RMS", "deg")
    rate_agitation_radps: float = _figure("rates beside the reference's, RMS", "rad/s")
    roll_rate_sd_radps: float = _figure("roll rate, sd", "rad/s")
    pitch_rate_sd_radps: float = _figure("pitch rate, sd", "rad/s")
    setpoint_hz: float = _figure("setpoints sent", "Hz")
    setpoint_gap_max_s: float = _figure("longest gap of setpoints", "s")
    setpoint_gap_wall_max_s: float = _figure("longest gap of setpoints, wall time", "s")
    lateness_p99_ms: float = _figure("telemetry to setpoint, 99th perc.", "ms")
    lateness_max_ms: float = _figure("telemetry to setpoint, maximum", "ms")
    missed_ticks: float = _figure("control periods without telemetry")
    solve_time_p50_ms: float = _figure("time of a decision, median", "ms")
    solve_time_p99_ms: float = _figure("time of a decision, 99th perc.", "ms")
    gap_median: float = _figure("cost above the exact optimum, median")
    gap_max: float = _figure("cost above the optimum, maximum")
    spread_median: float = _figure("epsilon of Eq. 29, median")
    at_bound_share: float = _figure("share of decisions at a bound")
    cut_short_share: float = _figure("share of decisions cut by deadline")
    position_hz: float = _figure("LOCAL_POSITION_NED received", "Hz")
    attitude_hz: float = _figure("ATTITUDE_QUATERNION received", "Hz")
    position_gap_max_s: float = _figure("longest gap of positions", "s")
    stale_share: float = _figure("share of repeated or late positions")
    link_delay_p50_ms: float = _figure("age of telemetry at its setpoint", "ms")
    link_delay_p99_ms: float = _figure("age of telemetry, 99th perc.", "ms")
    delay_ms: float = _figure("identified delay to the effect", "ms")
    delay_sd_ms: float = _figure("identified delay, sd", "ms")
    hover_thrust: float = _figure("hover thrust, estimated at the end")
    flight_s: float = _figure("from arming to the end of the log", "s")

    def figures(self) -> dict[str, float]:
        return asdict(self)


FIGURES = {figure.name: figure.metadata for figure in fields(Score)}


def score(history: History) -> Score:
    """Compute all figures of a flight from its arrays."""
    values: dict[str, float] = {}
    window = _window(history)
    if window is not None:
        reference = _Reference(history.reference)
        values |= _tracking(history, reference, *window)
        values |= _fitness(history, reference, *window)
        values |= _activity(history, reference, *window)
        values |= _truth(history, reference, *window)
        values["tracked_s"] = window[1] - window[0]
        values |= link_figures.telemetry(history, *window)
    values |= link_figures.setpoints(history)
    values |= link_figures.delay(history)
    values |= _decisions(history)
    return Score(**values)


def _window(history: History) -> tuple[float, float] | None:
    """First and last vehicle time of the phase TRACK; None with fewer than two samples."""
    track = float(PHASE_CODES[Phase.TRACK])
    times = [
        time_s
        for time_s, record in zip(history.record_time_s, history.records, strict=True)
        if record.phase == track
    ]
    if len(times) < 2 or len(history.reference) < 2:
        return None
    seen = (history.position, history.attitude, history.setpoint)
    heard = all(len(_between(rows, times[0], times[-1])) > 1 for rows in seen)
    return (times[0], times[-1]) if heard else None


def _between(rows: Array, begin_s: float, end_s: float) -> Array:
    inside: Array = rows[(rows[:, 0] >= begin_s) & (rows[:, 0] <= end_s)]
    return inside


class _Reference:
    """The reference as a function of vehicle time (N,): between two records the quintic through
    their positions, velocities and accelerations."""

    def __init__(self, rows: Array) -> None:
        newest = np.maximum.accumulate(rows[:, 0])
        rows = rows[np.concatenate(([True], rows[1:, 0] > newest[:-1]))]
        knots = np.stack((rows[:, 1:4], rows[:, 4:7], rows[:, 7:10]), axis=1)
        self._times, self._course = rows[:, 0], np.unwrap(rows[:, 10])
        self._curve = BPoly.from_derivatives(self._times, knots)

    def position(self, times: Array, derivative: int = 0) -> Array:
        """(N, 3) position NED in m, or a derivative of it."""
        values: Array = self._curve.derivative(derivative)(times)
        return values

    def course(self, times: Array) -> Array:
        return np.interp(times, self._times, self._course)


def _tracking(
    history: History, reference: _Reference, begin_s: float, end_s: float
) -> dict[str, float]:
    position = link_figures.each_once(_between(history.position, begin_s, end_s))
    times = position[:, 0]
    error_m = np.linalg.norm(position[:, 1:4] - reference.position(times), axis=1)
    slip_mps = np.linalg.norm(position[:, 4:7] - reference.position(times, 1), axis=1)
    attitude = _between(history.attitude, begin_s, end_s)
    course = reference.course(attitude[:, 0])
    turn = np.degrees(wrap_pi(course_from_quaternion(attitude[:, 1:5]) - course))
    return {
        "rmse_position_m": _rms(error_m),
        "mean_position_m": float(error_m.mean()),
        "p95_position_m": float(np.percentile(error_m, 95)),
        "max_position_m": float(error_m.max()),
        "rmse_velocity_mps": _rms(slip_mps),
        "p95_velocity_mps": float(np.percentile(slip_mps, 95)),
        "max_velocity_mps": float(slip_mps.max()),
        "rmse_course_deg": _rms(turn),
        "max_course_deg": float(np.abs(turn).max(initial=0.0)),
    }


def _fitness(
    history: History, reference: _Reference, begin_s: float, end_s: float
) -> dict[str, float]:
    """Eqs. 31-32 at the control ticks: velocities in the body frame, course in degrees."""
    ticks = history.record_time_s[
        (history.record_time_s >= begin_s) & (history.record_time_s <= end_s)
    ]
    attitude = history.attitude[_nearest(history.attitude[:, 0], ticks), 1:5]
    body = rotation_from_quaternion(attitude).swapaxes(-1, -2)
    flown = _at(history.position, ticks)
    slip = np.einsum("nij,nj->ni", body, reference.position(ticks, 1) - flown[:, 3:6])
    away = reference.position(ticks) - flown[:, 0:3]
    turn = np.degrees(wrap_pi(reference.course(ticks) - course_from_quaternion(attitude)))
    columns = (*slip.T, *away.T, turn)
    names = ("e_u", "e_v", "e_w", "e_x", "e_y", "e_z", "e_psi")
    parts = {name: float((column**2).sum()) for name, column in zip(names, columns, strict=True)}
    return parts | {"mu_e": sum(parts.values())}


def _truth(
    history: History, reference: _Reference, begin_s: float, end_s: float
) -> dict[str, float]:
    truth = _between(history.truth, begin_s, end_s)
    if not len(truth):
        return {}
    error_m = np.linalg.norm(truth[:, 1:4] - reference.position(truth[:, 0]), axis=1)
    return {"rmse_truth_m": _rms(error_m), "max_truth_m": float(error_m.max())}


def _activity(
    history: History, reference: _Reference, begin_s: float, end_s: float
) -> dict[str, float]:
    setpoint = _between(history.setpoint, begin_s, end_s)
    attitude = _between(history.attitude, begin_s, end_s)
    commanded = thrust_direction_from_quaternion(setpoint[:, 2:6])
    steps = np.degrees(np.linalg.norm(np.diff(commanded, axis=0), axis=1))
    down = thrust_direction_from_quaternion(attitude[:, 1:5])[:, 2]
    return _agitation(reference, attitude) | {
        "thrust_sd": float(setpoint[:, 6].std()),
        "tilt_command_step_deg": _rms(steps),
        "tilt_max_deg": float(np.degrees(np.arccos(np.clip(down, -1, 1))).max(initial=0.0)),
        "roll_rate_sd_radps": float(attitude[:, 5].std()),
        "pitch_rate_sd_radps": float(attitude[:, 6].std()),
    }


def _agitation(reference: _Reference, attitude: Array) -> dict[str, float]:
    """Motion beside that of the reference: thrust direction and rates minus their linear fit by the
    reference's velocity, acceleration and jerk. The fit needs no model of drag and lag."""
    times = attitude[:, 0]
    explained = [reference.position(times, order)[:, :2] for order in (1, 2, 3)]
    regressors = np.hstack((*explained, np.ones((len(times), 1))))
    direction = thrust_direction_from_quaternion(attitude[:, 1:5])[:, :2]
    motion = np.hstack((direction, attitude[:, 5:7]))
    fit, *_ = np.linalg.lstsq(regressors, motion, rcond=None)
    rest = motion - regressors @ fit
    return {
        "tilt_agitation_deg": float(np.degrees(np.sqrt((rest[:, :2] ** 2).sum(axis=1).mean()))),
        "rate_agitation_radps": float(np.sqrt((rest[:, 2:] ** 2).sum(axis=1).mean())),
    }


def _decisions(history: History) -> dict[str, float]:
    records = history.records
    if not records:
        return {}

    def column(name: str) -> Array:
        values: Array = np.array([getattr(record, name) for record in records])
        finite: Array = values[np.isfinite(values)]
        return finite

    late_ms, solve_ms = 1e3 * column("lateness_s"), 1e3 * column("solve_time_s")
    gap, spread = column("gap"), column("spread")
    return {
        "lateness_p99_ms": _percentile(late_ms, 99),
        "lateness_max_ms": _percentile(late_ms, 100),
        "missed_ticks": float(column("missed_ticks").sum()),
        "solve_time_p50_ms": _percentile(solve_ms, 50),
        "solve_time_p99_ms": _percentile(solve_ms, 99),
        "gap_median": _percentile(gap, 50),
        "gap_max": _percentile(gap, 100),
        "spread_median": _percentile(spread, 50),
        "at_bound_share": float(column("at_bound").mean()),
        "cut_short_share": float(column("cut_short").mean()),
        "hover_thrust": records[-1].hover_thrust,
    }


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2))) if len(values) else NAN


def _percentile(values: Array, share: float) -> float:
    return float(np.percentile(values, share)) if len(values) else NAN


def _at(rows: Array, times: Array) -> Array:
    """Columns after the first, interpolated linearly at `times`."""
    return np.stack([np.interp(times, rows[:, 0], column) for column in rows[:, 1:].T], axis=1)


def _nearest(stamps: Array, times: Array) -> NDArray[np.intp]:
    right = np.clip(np.searchsorted(stamps, times), 1, len(stamps) - 1)
    nearest: NDArray[np.intp] = right - (times - stamps[right - 1] < stamps[right] - times)
    return nearest
