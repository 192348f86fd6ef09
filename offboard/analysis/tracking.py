"""Figures of the phase TRACK, collected stretch by stretch: errors, fitness, activity, truth.

Errors and motion are weighted by the time of the reference (see `weighted`): a figure depends
neither on the rate of the telemetry nor on jumps of the vehicle's clock. Sums of the paper's
fitness are over the control ticks, as in its Eq. 32.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import BPoly

from offboard.analysis.history import History
from offboard.analysis.weighted import Weighted, shares
from offboard.flight.phases import PHASE_CODES, Phase
from offboard.model.frames import (
    course_from_quaternion,
    rotation_from_quaternion,
    thrust_direction_from_quaternion,
    wrap_pi,
)

Array = NDArray[np.float64]

SKIPPED_S = 1.5  # without a decision for longer, the reference was not tracked meanwhile
_EXPLAINED = 7  # regressors of the agitation: velocity, acceleration, jerk (north, east), and 1
_FITNESS = ("e_u", "e_v", "e_w", "e_x", "e_y", "e_z", "e_psi")


class Tracking:
    """Call `add` with each stretch of a flight, then `figures`."""

    def __init__(self) -> None:
        self._position, self._velocity = Weighted(distribution=True), Weighted(distribution=True)
        self._course, self._truth, self._tilt = Weighted(), Weighted(), Weighted()
        self._roll_rate, self._pitch_rate, self._thrust = Weighted(), Weighted(), Weighted()
        self._fitness = np.zeros(len(_FITNESS))
        self._steps = np.zeros(2)  # number, sum of squares in deg2
        self._factor = np.zeros((0, _EXPLAINED + 4))  # R of a QR decomposition
        self._track_s = math.nan  # time of the reference at the newest tick
        self._before_s: dict[str, float] = {}  # newest sample of each table
        self._done_s = -math.inf  # end of the newest window
        self.tracked_s = self.skipped_s = 0.0

    def window(self, flown: History, until_s: float) -> tuple[float, float] | None:
        """First and last vehicle time of the part of TRACK that is not evaluated yet, up to
        `until_s`; None without any. The first window has at least two samples of each signal."""
        times = flown.record_time_s[_in_track(flown)]
        if len(times) < 2 or len(flown.reference) < 2:
            return None
        begin_s, end_s = max(float(times[0]), self._done_s), min(float(times[-1]), until_s)
        tables = (flown.position, flown.attitude, flown.setpoint)
        inside = (((rows[:, 0] >= begin_s) & (rows[:, 0] <= end_s)).sum() for rows in tables)
        first = self._done_s == -math.inf
        enough = min(inside) >= 2 if first else begin_s < end_s
        return (begin_s, end_s) if enough else None

    def add(self, flown: History, begin_s: float, end_s: float) -> None:
        """Evaluate a window: what is after `begin_s`, for the first window also what is at it."""
        self._done_s = end_s
        reference = Reference(flown.reference)
        clock = _Clock(flown)
        self._ticks(flown, reference, begin_s, end_s)
        position = self._between("position", flown.position, begin_s, end_s)
        times, weights = position[:, 0], shares(clock.track_s(position[:, 0]))
        error_m = np.linalg.norm(position[:, 1:4] - reference.position(times), axis=1)
        slip_mps = np.linalg.norm(position[:, 4:7] - reference.position(times, 1), axis=1)
        self._position.add(error_m, weights)
        self._velocity.add(slip_mps, weights)
        truth = self._between("truth", flown.truth, begin_s, end_s)
        error_m = np.linalg.norm(truth[:, 1:4] - reference.position(truth[:, 0]), axis=1)
        self._truth.add(error_m, shares(clock.track_s(truth[:, 0])))
        attitude = self._between("attitude", flown.attitude, begin_s, end_s)
        self._motion(reference, attitude, shares(clock.track_s(attitude[:, 0])))
        setpoint = self._between("setpoint", flown.setpoint, begin_s, end_s)
        self._thrust.add(setpoint[:, 6], shares(clock.track_s(setpoint[:, 0])))
        commanded = thrust_direction_from_quaternion(setpoint[:, 2:6])
        steps = np.degrees(np.linalg.norm(np.diff(commanded, axis=0), axis=1))
        self._steps += (len(steps), (steps**2).sum())

    def figures(self) -> dict[str, float]:
        """Figures of a Score; empty without any window."""
        if self._done_s == -math.inf:
            return {}
        fitness = {name: float(value) for name, value in zip(_FITNESS, self._fitness, strict=True)}
        count, squares = self._steps
        return {
            "rmse_position_m": self._position.rms,
            "mean_position_m": self._position.mean,
            "p95_position_m": self._position.percentile(95),
            "max_position_m": self._position.max,
            "rmse_truth_m": self._truth.rms,
            "max_truth_m": self._truth.max,
            "rmse_velocity_mps": self._velocity.rms,
            "p95_velocity_mps": self._velocity.percentile(95),
            "max_velocity_mps": self._velocity.max,
            "rmse_course_deg": self._course.rms,
            "max_course_deg": self._course.max,
            **fitness,
            "mu_e": sum(fitness.values()),
            "tracked_s": self.tracked_s,
            "thrust_sd": self._thrust.sd,
            "tilt_command_step_deg": math.sqrt(squares / count) if count else math.nan,
            "tilt_max_deg": self._tilt.max,
            "roll_rate_sd_radps": self._roll_rate.sd,
            "pitch_rate_sd_radps": self._pitch_rate.sd,
            **self._agitation(),
        }

    def _between(self, name: str, rows: Array, begin_s: float, end_s: float) -> Array:
        """Rows of a window in the order of time, each stamp once, after the last row before."""
        begin_s = self._before_s.get(name, begin_s)
        once = each_once(rows[(rows[:, 0] >= begin_s) & (rows[:, 0] <= end_s)])
        if len(once):
            self._before_s[name] = once[-1, 0]
        return once

    def _ticks(self, flown: History, reference: Reference, begin_s: float, end_s: float) -> None:
        """Time tracked, and Eqs. 31-32: velocities in the body frame, course in degrees."""
        after = flown.record_time_s > self._before_s.get("ticks", -math.inf)
        inside = (flown.record_time_s >= begin_s) & (flown.record_time_s <= end_s)
        chosen = _in_track(flown) & after & inside
        ticks = flown.record_time_s[chosen]
        if not len(ticks):
            return
        self._before_s["ticks"] = float(ticks[-1])
        track_s = flown.records["track_time_s"][chosen]
        intervals = np.diff(track_s, prepend=self._track_s)
        intervals = intervals[np.isfinite(intervals)]
        intervals = np.maximum(intervals, 0.0)  # it is flown again from its start
        flowing = intervals <= SKIPPED_S
        self.tracked_s += float(intervals[flowing].sum())
        self.skipped_s += float(intervals[~flowing].sum())
        self._track_s = float(track_s[-1])
        attitude = flown.attitude[_nearest(flown.attitude[:, 0], ticks), 1:5]
        body = rotation_from_quaternion(attitude).swapaxes(-1, -2)
        at_tick = _at(flown.position, ticks)
        slip = np.einsum("nij,nj->ni", body, reference.position(ticks, 1) - at_tick[:, 3:6])
        away = reference.position(ticks) - at_tick[:, 0:3]
        turn = np.degrees(wrap_pi(reference.course(ticks) - course_from_quaternion(attitude)))
        self._fitness += (np.column_stack((slip, away, turn)) ** 2).sum(axis=0)

    def _motion(self, reference: Reference, attitude: Array, weights: Array) -> None:
        times, quaternion = attitude[:, 0], attitude[:, 1:5]
        turn = wrap_pi(course_from_quaternion(quaternion) - reference.course(times))
        self._course.add(np.abs(np.degrees(turn)), weights)
        direction = thrust_direction_from_quaternion(quaternion)
        self._tilt.add(np.degrees(np.arccos(np.clip(direction[:, 2], -1, 1))), weights)
        self._roll_rate.add(attitude[:, 5], weights)
        self._pitch_rate.add(attitude[:, 6], weights)
        explained = [reference.position(times, order)[:, :2] for order in (1, 2, 3)]
        rows = np.hstack((*explained, np.ones((len(times), 1)), direction[:, :2], attitude[:, 5:7]))
        weighted = np.sqrt(weights)[:, None] * rows
        factor: Array = np.linalg.qr(np.vstack((self._factor, weighted)), mode="r")  # type: ignore[assignment]
        self._factor = factor

    def _agitation(self) -> dict[str, float]:
        """Motion beside that of the reference: thrust direction and rates minus their linear fit by
        the reference's velocity, acceleration and jerk. The fit needs no model of drag and lag. The
        factor R of all samples has the same residuals as the samples."""
        regressors, motion = self._factor[:, :_EXPLAINED], self._factor[:, _EXPLAINED:]
        fit, *_ = np.linalg.lstsq(regressors, motion, rcond=None)
        squares = ((motion - regressors @ fit) ** 2).sum(axis=0)
        total = (self._factor[:, _EXPLAINED - 1] ** 2).sum()  # of the weights, from the column of 1
        tilt, rate = np.sqrt(np.array([squares[:2].sum(), squares[2:].sum()]) / total)
        return {
            "tilt_agitation_deg": float(np.degrees(tilt)),
            "rate_agitation_radps": float(rate),
        }


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
        self._times, self._course = rows[:, 0], np.unwrap(rows[:, 10])
        self._curve = BPoly.from_derivatives(self._times, knots)

    def position(self, times: Array, derivative: int = 0) -> Array:
        """(N, 3) position NED in m, or a derivative of it."""
        values: Array = self._curve.derivative(derivative)(times)
        return values

    def course(self, times: Array) -> Array:
        return np.interp(times, self._times, self._course)


def each_once(rows: Array) -> Array:
    """Rows (N, columns) sorted by time (the first column), the first one of equal times."""
    _, first = np.unique(rows[:, 0], return_index=True)
    once: Array = rows[first]
    return once


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
