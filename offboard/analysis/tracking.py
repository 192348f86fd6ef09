"""Metrics of the phase TRACK: errors, fitness, activity, truth.

Errors and motion are weighted by the time of the reference (see `weighted`): a metric depends
neither on the rate of the telemetry nor on jumps of the vehicle's clock. Sums of the paper's
fitness are over the control ticks, as in its Eq. 32.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import BPoly

from offboard.analysis.history import History
from offboard.analysis.weighted import Weighted, shares, weighted
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
_BLOCK = 10_000  # samples
_FITNESS = ("e_u", "e_v", "e_w", "e_x", "e_y", "e_z", "e_psi")


def window_of(flown: History) -> tuple[float, float] | None:
    """First and last vehicle time of TRACK; None where a signal has less than two samples in it."""
    times = flown.record_time_s[_in_track(flown)]
    if len(times) < 2 or len(flown.reference) < 2:
        return None
    begin_s, end_s = float(times[0]), float(times[-1])
    tables = (flown.position, flown.attitude, flown.setpoint)
    inside = (((rows[:, 0] >= begin_s) & (rows[:, 0] <= end_s)).sum() for rows in tables)
    return (begin_s, end_s) if min(inside) >= 2 else None


def passed_s(flown: History, window: tuple[float, float]) -> tuple[float, float]:
    """Time of the reference that was tracked, and that for which nothing was decided, in s."""
    track_s = flown.records["track_time_s"][_ticks(flown, window)]
    intervals = np.diff(track_s)
    intervals = np.maximum(intervals[np.isfinite(intervals)], 0.0)  # flown again from its start
    flowing = intervals <= SKIPPED_S
    return float(intervals[flowing].sum()), float(intervals[~flowing].sum())


def tracking_figures(flown: History, window: tuple[float, float]) -> dict[str, float]:
    """Values of a Score, of the samples in the window."""
    reference, clock = Reference(flown.reference), _Clock(flown)

    def of(rows: Array, values: Array) -> Weighted:
        return weighted(values, shares(clock.track_s(rows[:, 0])))

    def away(rows: Array, columns: slice, derivative: int = 0) -> Weighted:
        difference = rows[:, columns] - reference.position(rows[:, 0], derivative)
        return of(rows, np.linalg.norm(difference, axis=1))

    rows, truth, setpoint, attitude = (
        _within(each, window)
        for each in (flown.position, flown.truth, flown.setpoint, flown.attitude)
    )
    position, velocity = away(rows, slice(1, 4)), away(rows, slice(4, 7), 1)
    true = away(truth, slice(1, 4))
    commanded = thrust_direction_from_quaternion(setpoint[:, 2:6])
    steps = np.degrees(np.linalg.norm(np.diff(commanded, axis=0), axis=1))
    fitness = _fitness(flown, reference, window)
    turn = heading_from_quaternion(attitude[:, 1:5]) - reference.heading(attitude[:, 0])
    heading = of(attitude, np.abs(np.degrees(wrap_pi(turn))))
    direction = thrust_direction_from_quaternion(attitude[:, 1:5])
    tilt = of(attitude, np.degrees(np.arccos(np.clip(direction[:, 2], -1, 1))))
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
        "thrust_sd": of(setpoint, setpoint[:, 6]).sd,
        "tilt_command_step_deg": math.sqrt((steps**2).mean()) if len(steps) else math.nan,
        "tilt_max_deg": tilt.max,
        "roll_rate_sd_radps": of(attitude, attitude[:, 5]).sd,
        "pitch_rate_sd_radps": of(attitude, attitude[:, 6]).sd,
        **_agitation(reference, attitude, shares(clock.track_s(attitude[:, 0]))),
    }


def _fitness(flown: History, reference: Reference, window: tuple[float, float]) -> dict[str, float]:
    """Eqs. 31-32: velocities in the body frame, heading in degrees."""
    ticks = flown.record_time_s[_ticks(flown, window)]
    attitude = flown.attitude[_nearest(flown.attitude[:, 0], ticks), 1:5]
    body = rotation_from_quaternion(attitude).swapaxes(-1, -2)
    at_tick = _at(flown.position, ticks)
    slip = np.einsum("nij,nj->ni", body, reference.position(ticks, 1) - at_tick[:, 3:6])
    away = reference.position(ticks) - at_tick[:, 0:3]
    turn = np.degrees(wrap_pi(reference.heading(ticks) - heading_from_quaternion(attitude)))
    squares = (np.column_stack((slip, away, turn)) ** 2).sum(axis=0)
    return {name: float(value) for name, value in zip(_FITNESS, squares, strict=True)}


def _agitation(reference: Reference, attitude: Array, weights: Array) -> dict[str, float]:
    """Motion beside that of the reference: thrust direction and rates minus their linear fit by
    the reference's velocity, acceleration and jerk. The fit needs no model of drag and lag.

    The factor R of the samples has the same residuals as the samples; made of blocks, it takes
    little memory.
    """
    factor = np.zeros((0, _EXPLAINED + 4))
    for first in range(0, len(attitude), _BLOCK):
        rows, share = attitude[first : first + _BLOCK], weights[first : first + _BLOCK]
        times, direction = rows[:, 0], thrust_direction_from_quaternion(rows[:, 1:5])
        explained = [reference.position(times, order)[:, :2] for order in (1, 2, 3)]
        block = np.hstack((*explained, np.ones((len(times), 1)), direction[:, :2], rows[:, 5:7]))
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
    times = flown.record_time_s
    chosen: NDArray[np.bool_] = _in_track(flown) & (times >= window[0]) & (times <= window[1])
    return chosen


class _Clock:
    """Time of the reference that has passed until a vehicle time, by the ticks of TRACK. It stands
    still from the end of the reference to where it is flown again from its start."""

    def __init__(self, flown: History) -> None:
        chosen = _in_track(flown)
        rows = np.column_stack((flown.record_time_s, flown.records["track_time_s"]))[chosen]
        self._times, track_s = each_once(rows).T
        self._passed_s: Array = np.cumsum(np.maximum(np.diff(track_s, prepend=track_s[:1]), 0.0))

    def track_s(self, times: Array) -> Array:
        passed_s: Array = np.interp(times, self._times, self._passed_s)
        return passed_s


class Reference:
    """The reference as a function of vehicle time (N,): between two records the quintic through
    their positions, velocities and accelerations."""

    def __init__(self, rows: Array) -> None:
        newest = np.maximum.accumulate(rows[:, 0])
        rows = rows[np.concatenate(([True], rows[1:, 0] > newest[:-1]))]
        knots = np.stack((rows[:, 1:4], rows[:, 4:7], rows[:, 7:10]), axis=1)
        self._times, self._heading = rows[:, 0], np.unwrap(rows[:, 10])
        self._curve = BPoly.from_derivatives(self._times, knots)

    def position(self, times: Array, derivative: int = 0) -> Array:
        """(N, 3) position NED in m, or a derivative of it."""
        values: Array = self._curve.derivative(derivative)(times)
        return values

    def heading(self, times: Array) -> Array:
        return np.interp(times, self._times, self._heading)


def each_once(rows: Array) -> Array:
    """Rows (N, columns) sorted by time (the first column), the first one of equal times."""
    if (np.diff(rows[:, 0]) > 0.0).all():
        return rows
    _, first = np.unique(rows[:, 0], return_index=True)
    once: Array = rows[first]
    return once


def _within(rows: Array, window: tuple[float, float]) -> Array:
    """Rows of a window, sorted, each time once."""
    once = each_once(rows)
    begin, end = np.searchsorted(once[:, 0], (window[0], np.nextafter(window[1], math.inf)))
    return once[begin:end]


def _in_track(flown: History) -> NDArray[np.bool_]:
    chosen: NDArray[np.bool_] = flown.records["phase"] == PHASE_CODES[Phase.TRACK]
    return chosen


def _at(rows: Array, times: Array) -> Array:
    """Columns after the first, interpolated linearly at `times`."""
    return np.stack([np.interp(times, rows[:, 0], column) for column in rows[:, 1:].T], axis=1)


def _nearest(stamps: Array, times: Array) -> NDArray[np.intp]:
    right = np.clip(np.searchsorted(stamps, times), 1, len(stamps) - 1)
    nearest: NDArray[np.intp] = right - (times - stamps[right - 1] < stamps[right] - times)
    return nearest
