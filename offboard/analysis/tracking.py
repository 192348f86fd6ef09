"""Metrics of the phase TRACK: errors, fitness, activity, truth.

Errors and motion are weighted by the time of the reference (see `_Clock`): a metric depends
neither on the rate of the telemetry nor on jumps of the vehicle's clock. Sums of the paper's
fitness are over the control ticks, as in its Eq. 32.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import PPoly

from offboard.analysis.history import History, Rows, in_parts, parts
from offboard.flight.phases import Phase
from offboard.model.frames import (
    heading_from_quaternion,
    rotation_from_quaternion,
    thrust_direction_from_quaternion,
    wrap_pi,
)

Array = NDArray[np.float64]

SKIPPED_S = 1.5  # without a decision for longer, the reference was not tracked meanwhile
_ORDERS, _POWERS = np.arange(3)[:, None], np.arange(5, -1, -1)[:, None]
# coefficients of s^5 .. s^0 from position, velocity and acceleration at s = 0, then at s = 1
_QUINTIC = np.linalg.inv(
    [
        [math.perm(power, order) * float(s) ** max(power - order, 0) for power in range(5, -1, -1)]
        for s in (0, 1)
        for order in range(3)
    ]
)
_FITNESS = ("e_u", "e_v", "e_w", "e_x", "e_y", "e_z", "e_psi")


def window_of(flown: History) -> tuple[float, float] | None:
    """First and last vehicle time of TRACK; None where a signal has less than two samples in it."""
    times = flown.records["time_s"][_in_track(flown)]
    if len(times) < 2 or len(np.unique(np.maximum.accumulate(flown.reference["time_s"]))) < 2:
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


def tracking_metrics(flown: History, window: tuple[float, float]) -> dict[str, float]:
    """Values of a Score, of the samples in the window."""
    reference, clock = Reference(flown.reference), _Clock(flown)

    def away(rows: Rows, column: str, derivative: int = 0) -> tuple[Array, Array]:
        def size(part: Rows) -> Array:
            errors = part[column] - reference.position(part["time_s"], derivative)
            return np.asarray(np.linalg.norm(errors, axis=1))

        return in_parts(size, rows), clock.shares(rows["time_s"])

    def turned_deg(part: Rows) -> Array:
        turn = heading_from_quaternion(part["quaternion"]) - reference.heading(part["time_s"])
        return np.asarray(np.abs(np.degrees(wrap_pi(turn))))

    def tilted_deg(part: Rows) -> Array:
        down = thrust_direction_from_quaternion(part["quaternion"])[:, 2]
        return np.degrees(np.arccos(np.clip(down, -1.0, 1.0)))

    fitness = _fitness(flown, reference, window)
    found = fitness | {"mu_e": sum(fitness.values()), "tracked_s": passed_s(flown, window)[0]}
    rows = _within(flown.position, window)
    found |= _named("{}_position_m", "rmse mean p95 max", *away(rows, "position_ned_m"))
    found |= _named("{}_velocity_mps", "rmse p95 max", *away(rows, "velocity_ned_mps", 1))
    rows = _within(flown.truth, window)
    found |= _named("{}_truth_m", "rmse max", *away(rows, "position_ned_m"))
    rows = _within(flown.setpoint, window)
    thrust = rows["thrust"].astype(np.float64)
    found |= _named("thrust_{}", "sd", thrust, clock.shares(rows["time_s"]))
    directions = thrust_direction_from_quaternion(rows["quaternion"])
    steps = np.linalg.norm(np.diff(directions, axis=0), axis=1)
    if len(steps):
        found["tilt_command_step_deg"] = math.degrees(math.sqrt((steps**2).mean()))
    rows = _within(flown.attitude, window)
    weights = clock.shares(rows["time_s"])
    found |= _named("{}_heading_deg", "rmse max", in_parts(turned_deg, rows), weights)
    found |= _named("tilt_{}_deg", "max", in_parts(tilted_deg, rows), weights)
    for axis, pattern in enumerate(("roll_rate_{}_radps", "pitch_rate_{}_radps")):
        found |= _named(pattern, "sd", rows["rates_radps"][:, axis].astype(np.float64), weights)
    return found | _agitation(reference, rows, weights)


def _fitness(flown: History, reference: Reference, window: tuple[float, float]) -> dict[str, float]:
    """Eqs. 31-32: velocities in the body frame, heading in degrees."""
    ticks = flown.records["time_s"][_ticks(flown, window)]
    quaternion = flown.attitude["quaternion"][_nearest(flown.attitude["time_s"], ticks)]
    body = rotation_from_quaternion(quaternion).swapaxes(-1, -2)
    stamps = flown.position["time_s"]
    position, velocity = (
        np.stack([np.interp(ticks, stamps, axis) for axis in flown.position[column].T], axis=1)
        for column in ("position_ned_m", "velocity_ned_mps")
    )
    slip = np.einsum("nij,nj->ni", body, reference.position(ticks, 1) - velocity)
    turn = np.degrees(wrap_pi(reference.heading(ticks) - heading_from_quaternion(quaternion)))
    errors = np.column_stack((slip, reference.position(ticks) - position, turn))
    return dict(zip(_FITNESS, (errors**2).sum(axis=0).tolist(), strict=True))


def _agitation(reference: Reference, attitude: Rows, weights: Array) -> dict[str, float]:
    """Motion beside that of the reference: thrust direction and rates minus their linear fit by
    the reference's velocity, acceleration and jerk. The fit needs no model of drag and lag.

    The factor R of the samples has their residuals.
    """
    factor: Any = np.zeros((0, 11))
    shares = parts(np.sqrt(weights / weights.sum())[:, None])
    for rows, share in zip(parts(attitude), shares, strict=True):
        explained = [reference.position(rows["time_s"], order)[:, :2] for order in (1, 2, 3)]
        direction = thrust_direction_from_quaternion(rows["quaternion"])[:, :2]
        motion = direction, rows["rates_radps"][:, :2]
        samples = share * np.hstack((*explained, np.ones((len(rows), 1)), *motion))
        factor = np.linalg.qr(np.vstack((factor, samples)), mode="r")
    explained, motion = factor[:, :7], factor[:, 7:]
    fit, *_ = np.linalg.lstsq(explained, motion, rcond=None)
    squares = ((motion - explained @ fit) ** 2).sum(axis=0)
    tilt, rate = np.sqrt([squares[:2].sum(), squares[2:].sum()])
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
        halves = np.diff(np.interp(times, self._times, self._passed_s))
        halves *= 0.5
        weights = np.zeros(len(times))
        weights[:-1] += halves
        weights[1:] += halves
        return weights


class Reference:
    """The reference as a function of vehicle time (N,): between two records the quintic through
    their positions, velocities and accelerations."""

    def __init__(self, rows: Rows) -> None:
        newest = np.maximum.accumulate(rows["time_s"])
        rows = rows[np.concatenate(([True], rows["time_s"][1:] > newest[:-1]))]
        self._times = rows["time_s"]
        self._heading = np.unwrap(rows["heading_rad"].astype(np.float64))
        derivatives = ("position_ned_m", "velocity_ned_mps", "acceleration_ned_mps2")
        known = np.stack([rows[name].astype(np.float64) for name in derivatives], axis=1)
        length_s = np.diff(self._times)[:, None, None]
        scaled = known[:-1] * length_s**_ORDERS, known[1:] * length_s**_ORDERS
        coefficients = _QUINTIC @ np.concatenate(scaled, axis=1) / length_s**_POWERS
        self._position = PPoly(coefficients.swapaxes(0, 1), self._times)

    def position(self, times: Array, derivative: int = 0) -> Array:
        """(N, 3) position NED in m, or a derivative of it."""
        return np.asarray(self._position(times, derivative))

    def heading(self, times: Array) -> Array:
        return np.interp(times, self._times, self._heading)


def _within(rows: Rows, window: tuple[float, float]) -> Rows:
    """Rows of a window, sorted, each time once."""
    once = each_once(rows)
    begin, end = np.searchsorted(once["time_s"], (window[0], np.nextafter(window[1], math.inf)))
    return once[begin:end]


def each_once(rows: Rows) -> Rows:
    """Rows sorted by time, the first one of equal times."""
    if (np.diff(rows["time_s"]) > 0.0).all():
        return rows
    return rows[np.unique(rows["time_s"], return_index=True)[1]]


def _in_track(flown: History) -> NDArray[np.bool_]:
    chosen: NDArray[np.bool_] = flown.records["phase"] == Phase.TRACK.code
    return chosen


def _nearest(stamps: Array, times: Array) -> NDArray[np.intp]:
    right = np.clip(np.searchsorted(stamps, times), 1, len(stamps) - 1)
    nearest: NDArray[np.intp] = right - (times - stamps[right - 1] < stamps[right] - times)
    return nearest


# ---------------------------------------------------------------------- metrics by time


def _named(pattern: str, kinds: str, values: Array, weights: Array) -> dict[str, float]:
    """Metrics of samples (N,) with the time (N,) for which each stands, by name: `pattern` with
    each of `kinds` in it. `p95` is not exceeded for 95 % of the time. Samples that stand for no
    time do not count; empty without others."""
    total = float(weights.sum())
    if not total:
        return {}
    mean = float(weights @ values / total)
    square = float(np.einsum("i,i,i", weights, values, values) / total)
    order = np.argsort(values)
    upto = np.searchsorted(np.cumsum(weights[order]), 0.95 * total)
    found = {
        "mean": mean,
        "rmse": math.sqrt(square),
        "sd": math.sqrt(max(square - mean**2, 0.0)),
        "max": float(np.max(values, where=weights > 0.0, initial=-math.inf)),
        "p95": float(values[order[upto]]),
    }
    return {pattern.format(kind): found[kind] for kind in kinds.split()}
