"""Metrics of the phase TRACK: errors, fitness, activity, truth.

Errors and motion are weighted by the time of the reference (see `weighted`): a metric depends
neither on the rate of the telemetry nor on jumps of the vehicle's clock. Sums of the paper's
fitness are over the control ticks, as in its Eq. 32.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from offboard.analysis.history import History
from offboard.analysis.samples import Rows, Weighted, blocks, each_once, weighted
from offboard.flight.phases import PHASE_CODES, Phase
from offboard.model.frames import (
    heading_from_quaternion,
    rotation_from_quaternion,
    thrust_direction_from_quaternion,
    wrap_pi,
)

Array = NDArray[np.float64]

SKIPPED_S = 1.5  # without a decision for longer, the reference was not tracked meanwhile
_EXPLAINED = 7  # regressors of the agitation: velocity, acceleration, jerk (north, east), and 1
_FITNESS = ("e_u", "e_v", "e_w", "e_x", "e_y", "e_z", "e_psi")


def window_of(flown: History) -> tuple[float, float] | None:
    """First and last vehicle time of TRACK; None where a signal has less than two samples in it."""
    times = flown.records["time_s"][_in_track(flown)]
    if len(times) < 2 or len(flown.reference) < 2:
        return None
    begin_s, end_s = float(times[0]), float(times[-1])
    stamps = (rows["time_s"] for rows in (flown.position, flown.attitude, flown.setpoint))
    inside = (((each >= begin_s) & (each <= end_s)).sum() for each in stamps)
    return (begin_s, end_s) if min(inside) >= 2 else None


def passed_s(flown: History, window: tuple[float, float]) -> tuple[float, float]:
    """Time of the reference that was tracked, and that for which nothing was decided, in s."""
    track_s = flown.records["track_time_s"][_ticks(flown, window)].astype(np.float64)
    intervals = np.diff(track_s)
    intervals = np.maximum(intervals[np.isfinite(intervals)], 0.0)  # flown again from its start
    flowing = intervals <= SKIPPED_S
    return float(intervals[flowing].sum()), float(intervals[~flowing].sum())


def tracking_figures(flown: History, window: tuple[float, float]) -> dict[str, float]:
    """Values of a Score, of the samples in the window."""
    reference, clock = Reference(flown.reference), _Clock(flown)

    def away(rows: Rows, column: str, weights: Array, derivative: int = 0) -> Weighted:
        def distance(part: Rows) -> Any:
            expected = reference.position(part["time_s"], derivative)
            return np.linalg.norm(part[column] - expected, axis=1)

        return weighted(_in_blocks(distance, rows), weights)

    def turned_deg(part: Rows) -> Any:
        turn = heading_from_quaternion(part["quaternion"]) - reference.heading(part["time_s"])
        return np.abs(np.degrees(wrap_pi(turn)))

    def tilt_deg(part: Rows) -> Any:
        direction = thrust_direction_from_quaternion(part["quaternion"])
        return np.degrees(np.arccos(np.clip(direction[:, 2], -1.0, 1.0)))

    fitness = _fitness(flown, reference, window)
    # one array after the other: each may be a copy of hours of telemetry
    rows = _within(flown.position, window)
    weights = clock.shares(rows["time_s"])
    position = away(rows, "position_ned_m", weights)
    velocity = away(rows, "velocity_ned_mps", weights, 1)
    rows = _within(flown.truth, window)
    true = away(rows, "position_ned_m", clock.shares(rows["time_s"]))
    rows = _within(flown.setpoint, window)
    commanded = thrust_direction_from_quaternion(rows["quaternion"])
    steps = np.degrees(np.linalg.norm(np.diff(commanded, axis=0), axis=1))
    thrust = weighted(rows["thrust"].astype(np.float64), clock.shares(rows["time_s"]))
    rows = _within(flown.attitude, window)
    weights = clock.shares(rows["time_s"])
    heading = weighted(_in_blocks(turned_deg, rows), weights)
    roll_rate, pitch_rate = (
        weighted(rows["rates_radps"][:, axis].astype(np.float64), weights).sd for axis in (0, 1)
    )
    return {
        "rmse_position_m": position.rms,
        "mean_position_m": position.mean,
        "p95_position_m": position.p95,
        "max_position_m": position.max,
        "rmse_truth_m": true.rms,
        "max_truth_m": true.max,
        "rmse_velocity_mps": velocity.rms,
        "p95_velocity_mps": velocity.p95,
        "max_velocity_mps": velocity.max,
        "rmse_heading_deg": heading.rms,
        "max_heading_deg": heading.max,
        **fitness,
        "mu_e": sum(fitness.values()),
        "tracked_s": passed_s(flown, window)[0],
        "thrust_sd": thrust.sd,
        "tilt_command_step_deg": math.sqrt((steps**2).mean()) if len(steps) else math.nan,
        "tilt_max_deg": weighted(_in_blocks(tilt_deg, rows), weights).max,
        "roll_rate_sd_radps": roll_rate,
        "pitch_rate_sd_radps": pitch_rate,
        **_agitation(reference, rows, weights),
    }


def _fitness(flown: History, reference: Reference, window: tuple[float, float]) -> dict[str, float]:
    """Eqs. 31-32: velocities in the body frame, heading in degrees."""
    ticks = flown.records["time_s"][_ticks(flown, window)]
    quaternion = flown.attitude["quaternion"][_nearest(flown.attitude["time_s"], ticks)]
    position, velocity = (
        _at(flown.position, column, ticks) for column in ("position_ned_m", "velocity_ned_mps")
    )
    squares = np.zeros(len(_FITNESS))
    for part in blocks(len(ticks)):
        body = rotation_from_quaternion(quaternion[part]).swapaxes(-1, -2)
        slip = np.einsum("nij,nj->ni", body, reference.position(ticks[part], 1) - velocity[part])
        away = reference.position(ticks[part]) - position[part]
        turn = reference.heading(ticks[part]) - heading_from_quaternion(quaternion[part])
        errors = np.column_stack((slip, away, np.degrees(wrap_pi(turn))))
        squares += (errors**2).sum(axis=0)
    return {name: float(value) for name, value in zip(_FITNESS, squares, strict=True)}


def _agitation(reference: Reference, attitude: Rows, weights: Array) -> dict[str, float]:
    """Motion beside that of the reference: thrust direction and rates minus their linear fit by
    the reference's velocity, acceleration and jerk. The fit needs no model of drag and lag.

    The factor R of the samples has the same residuals as the samples; made of blocks, it takes
    little memory.
    """
    factor = np.zeros((0, _EXPLAINED + 4))
    for part in blocks(len(attitude)):
        rows, share = attitude[part], weights[part]
        times, direction = rows["time_s"], thrust_direction_from_quaternion(rows["quaternion"])
        explained = [reference.position(times, order)[:, :2] for order in (1, 2, 3)]
        block = np.hstack(
            (*explained, np.ones((len(times), 1)), direction[:, :2], rows["rates_radps"][:, :2])
        )
        stacked = np.vstack((factor, np.sqrt(share)[:, None] * block))
        factor = np.linalg.qr(stacked, mode="r")  # type: ignore[assignment]
    regressors, motion = factor[:, :_EXPLAINED], factor[:, _EXPLAINED:]
    fit, *_ = np.linalg.lstsq(regressors, motion, rcond=None)
    squares = ((motion - regressors @ fit) ** 2).sum(axis=0)
    total = (factor[:, _EXPLAINED - 1] ** 2).sum()  # of the weights, from the column of 1
    tilt, rate = np.sqrt(np.array([squares[:2].sum(), squares[2:].sum()]) / total)
    return {
        "tilt_agitation_deg": float(np.degrees(tilt)),
        "rate_agitation_radps": float(rate),
    }


def _ticks(flown: History, window: tuple[float, float]) -> NDArray[np.bool_]:
    """The ticks of TRACK in the window."""
    times = flown.records["time_s"]
    chosen: NDArray[np.bool_] = _in_track(flown) & (times >= window[0]) & (times <= window[1])
    return chosen


class _Clock:
    """Time of the reference that has passed until a vehicle time, by the ticks of TRACK. It stands
    still from the end of the reference to where it is flown again from its start."""

    def __init__(self, flown: History) -> None:
        chosen = _in_track(flown)
        self._times, first = np.unique(flown.records["time_s"][chosen], return_index=True)
        track_s = flown.records["track_time_s"][chosen][first].astype(np.float64)
        self._passed_s: Array = np.cumsum(np.maximum(np.diff(track_s, prepend=track_s[:1]), 0.0))

    def shares(self, times: Array) -> Array:
        """Time (N,) in s for which each sample stands; `times` (N,) must not decrease.

        Between two samples a signal is taken to change linearly: each stands for half of the
        interval before it and half of the one after it (the trapezoidal rule). So a metric does not
        depend on how often the signal was sampled, and a gap counts with its length.
        """
        weights = np.zeros(len(times))
        for part in blocks(len(times)):
            passed_s = np.interp(times[part.start : part.stop + 1], self._times, self._passed_s)
            halves = 0.5 * np.diff(passed_s)
            weights[part.start : part.start + len(halves)] += halves
            weights[part.start + 1 : part.start + 1 + len(halves)] += halves
        return weights


class Reference:
    """The reference as a function of vehicle time (N,): between two records the quintic through
    their positions, velocities and accelerations."""

    def __init__(self, rows: Rows) -> None:
        newest = np.maximum.accumulate(rows["time_s"])
        self._rows = rows[np.concatenate(([True], rows["time_s"][1:] > newest[:-1]))]
        self._heading = np.unwrap(self._rows["heading_rad"].astype(np.float64))

    def position(self, times: Array, derivative: int = 0) -> Array:
        """(N, 3) position NED in m, or a derivative of it."""
        stamps = self._rows["time_s"]
        before = np.clip(np.searchsorted(stamps, times, "right") - 1, 0, len(stamps) - 2)
        first, last = self._rows[before], self._rows[before + 1]
        length_s = (last["time_s"] - first["time_s"])[:, None]
        share = (times[:, None] - first["time_s"][:, None]) / length_s
        begin, end = (
            (
                each["position_ned_m"].astype(np.float64),
                length_s * each["velocity_ned_mps"],
                length_s**2 * each["acceleration_ned_mps2"],
            )
            for each in (first, last)
        )
        away = end[0] - begin[0] - begin[1] - 0.5 * begin[2]  # of the end from the start's parabola
        turn, bend = end[1] - begin[1] - begin[2], end[2] - begin[2]
        coefficients: list[Array] = [
            begin[0],
            begin[1],
            0.5 * begin[2],
            10.0 * away - 4.0 * turn + 0.5 * bend,
            -15.0 * away + 7.0 * turn - bend,
            6.0 * away - 3.0 * turn + 0.5 * bend,
        ]
        for _ in range(derivative):
            coefficients = [power * each for power, each in enumerate(coefficients)][1:]
        values: Array = sum(each * share**power for power, each in enumerate(coefficients))
        return np.asarray(values / length_s**derivative)

    def heading(self, times: Array) -> Array:
        return np.interp(times, self._rows["time_s"], self._heading)


def _within(rows: Rows, window: tuple[float, float]) -> Rows:
    """Rows of a window, sorted, each time once."""
    once = each_once(rows)
    begin, end = np.searchsorted(once["time_s"], (window[0], np.nextafter(window[1], math.inf)))
    return once[begin:end]


def _in_blocks(signal: Callable[[Rows], Any], rows: Rows) -> Array:
    values = np.empty(len(rows))
    for part in blocks(len(rows)):
        values[part] = signal(rows[part])
    return values


def _in_track(flown: History) -> NDArray[np.bool_]:
    chosen: NDArray[np.bool_] = flown.records["phase"] == PHASE_CODES[Phase.TRACK]
    return chosen


def _at(rows: Rows, column: str, times: Array) -> Array:
    """The column (N, 3), interpolated linearly at `times`."""
    axes = rows[column].T
    return np.stack([np.interp(times, rows["time_s"], axis) for axis in axes], axis=1)


def _nearest(stamps: Array, times: Array) -> NDArray[np.intp]:
    right = np.clip(np.searchsorted(stamps, times), 1, len(stamps) - 1)
    nearest: NDArray[np.intp] = right - (times - stamps[right - 1] < stamps[right] - times)
    return nearest
