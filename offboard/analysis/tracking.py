"""Metrics of the phase TRACK: errors, fitness, activity, truth.

Errors and motion are weighted by the time of the reference (see `Track.shares`), so that a metric
depends neither on the rate of the telemetry nor on jumps of the vehicle's clock. The paper's
fitness is a sum over the control ticks, as in its Eq. 32.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from offboard.analysis.columns import Rows, in_parts, parts
from offboard.analysis.history import History
from offboard.flight.phases import Phase
from offboard.model.frames import (
    heading_from_quaternion,
    rotation_from_quaternion,
    thrust_direction_from_quaternion,
    wrap_pi,
)

Array = NDArray[np.float64]

GAP_S = 0.5  # the reference is unknown in a longer gap between its records
SKIPPED_S = 1.5  # the reference was not tracked in a longer gap between decisions
_KNOWN = [(end, order) for end in (0, 1) for order in range(3)]  # given derivatives of a quintic
# Coefficients of s^5 .. s^0 for each of _KNOWN: the derivative of this order at s = 0 or s = 1
_QUINTIC = np.linalg.inv(
    [
        [
            math.perm(power, order) * float(end) ** max(power - order, 0)
            for power in range(5, -1, -1)
        ]
        for end, order in _KNOWN
    ]
)
_DERIVATIVES = ("position_ned_m", "velocity_ned_mps", "acceleration_ned_mps2")
_FITNESS = ("e_u", "e_v", "e_w", "e_x", "e_y", "e_z", "e_psi")


class Track:
    """The phase TRACK of a flight: the times of its control ticks, and the reference.

    `tracked_s` is the time of the reference that passed from tick to tick, `skipped_s` the time in
    gaps between decisions of more than SKIPPED_S. If the reference is repeated, the time from its
    end to its next start does not count.
    """

    def __init__(self, times: Array, track_s: Array, reference: Reference) -> None:
        self.begin_s, self.end_s = float(times[0]), float(times[-1])
        self.reference = reference
        inside = self.holds(times)
        self.times, first = np.unique(times[inside], return_index=True)
        intervals = np.maximum(np.diff(track_s[inside][first]), 0.0)
        self._passed_s: Array = np.cumsum(np.concatenate(([0.0], intervals)))
        self.tracked_s = float(intervals[intervals <= SKIPPED_S].sum())
        self.skipped_s = float(intervals[intervals > SKIPPED_S].sum())

    @classmethod
    def of(cls, flown: History) -> Track | None:
        """Return the phase TRACK of a flight; None if the reference, position, attitude or setpoint
        has fewer than two samples in it."""
        ticks = flown.records["phase"] == Phase.TRACK.code
        reference = Reference.of(flown)
        if ticks.sum() < 2 or reference is None:
            return None
        track_s = flown.records["track_time_s"][ticks].astype(np.float64)
        track = cls(flown.records["time_s"][ticks], track_s, reference)
        signals = (flown.position, flown.attitude, flown.setpoint)
        return track if all(track.holds(each["time_s"]).sum() > 1 for each in signals) else None

    def holds(self, times: Array) -> NDArray[np.bool_]:
        """Whether each of the times (N,) is in the phase."""
        inside: NDArray[np.bool_] = (times >= self.begin_s) & (times <= self.end_s)
        return inside

    def within(self, rows: Rows) -> Rows:
        """Return the rows in the phase, sorted by time, without repeated times."""
        once = each_once(rows)
        ends = self.begin_s, np.nextafter(self.end_s, math.inf)
        begin, end = np.searchsorted(once["time_s"], ends)
        return once[begin:end]

    def shares(self, times: Array) -> Array:
        """Return the weight (N,) of each sample: the time of the reference in s for which it
        stands. `times` (N,) must not decrease.

        By the trapezoidal rule a sample stands for half of the interval before it and half of the
        one after it. So a metric does not depend on how often the signal was sampled, and a gap
        counts with its length.
        """
        halves = np.diff(np.interp(times, self.times, self._passed_s))
        halves *= 0.5
        weights = np.zeros(len(times))
        weights[:-1] += halves
        weights[1:] += halves
        return weights


class Reference:
    """The reference as a function of vehicle time. Between two records it is the quintic polynomial
    that has their positions, velocities and accelerations."""

    def __init__(self, rows: Rows) -> None:
        self._rows, self._times = rows, rows["time_s"]
        self._heading = np.unwrap(rows["heading_rad"].astype(np.float64))

    @classmethod
    def of(cls, flown: History) -> Reference | None:
        """Return the recorded reference of a flight; None without two records of rising stamps."""
        newest = np.maximum.accumulate(flown.reference["time_s"])
        rows = flown.reference[np.diff(newest, prepend=-math.inf) > 0.0]
        return cls(rows) if len(rows) > 1 else None

    def position(self, times: Array, derivative: int = 0) -> Array:
        """Return the position NED (N, 3) in m at `times` (N,), or its derivative of this order."""
        begins = np.clip(np.searchsorted(self._times, times, "right"), 1, len(self._times) - 1) - 1
        length_s = self._times[begins + 1] - self._times[begins]
        share = (times - self._times[begins]) / length_s
        found = np.zeros((len(times), 3))
        for place, (end, order) in enumerate(_KNOWN):
            weight = np.polyval(np.polyder(_QUINTIC[:, place], derivative), share)
            weight *= length_s ** (order - derivative)
            found += weight[:, None] * self._rows[_DERIVATIVES[order]][begins + end]
        return found

    def errors(self, rows: Rows, column: str, derivative: int = 0) -> Array:
        """Return a column of `rows` minus the reference position or its derivative, (N, 3)."""
        errors: Array = rows[column] - self.position(rows["time_s"], derivative)
        return errors

    def heading(self, times: Array) -> Array:
        return np.interp(times, self._times, self._heading)

    def is_near(self, times: Array) -> NDArray[np.bool_]:
        """Whether each of the times (N,) is between two records that are at most GAP_S apart."""
        place = np.searchsorted(self._times, times)
        gaps_s = np.diff(self._times, prepend=-math.inf, append=math.inf)
        near: NDArray[np.bool_] = gaps_s[place] <= GAP_S
        return near


def each_once(rows: Rows) -> Rows:
    """Return the rows sorted by time, of rows with equal times only the first."""
    if (np.diff(rows["time_s"]) > 0.0).all():
        return rows
    return rows[np.unique(rows["time_s"], return_index=True)[1]]


# ---------------------------------------------------------------------- the metrics

Measure = Callable[[Rows, Reference], Array]
Measured = tuple[str, str, Measure]  # see `_named`: pattern of the names, kinds; signal


def _away(column: str, derivative: int = 0) -> Measure:
    """Return a function that computes the distance (N,) from the reference or its derivative."""
    return lambda rows, reference: np.asarray(
        np.linalg.norm(reference.errors(rows, column, derivative), axis=1)
    )


def _turned_deg(rows: Rows, reference: Reference) -> Array:
    turn = heading_from_quaternion(rows["quaternion"]) - reference.heading(rows["time_s"])
    return np.asarray(np.abs(np.degrees(wrap_pi(turn))))


def _tilted_deg(rows: Rows, _: Reference) -> Array:
    down = thrust_direction_from_quaternion(rows["quaternion"])[:, 2]
    return np.degrees(np.arccos(np.clip(down, -1.0, 1.0)))


def _rate(axis: int) -> Measure:
    return lambda rows, _: rows["rates_radps"][:, axis].astype(np.float64)


# array of History -> metrics that are computed from it
_MEASURED: dict[str, tuple[Measured, ...]] = {
    "position": (
        ("{}_position_m", "rmse mean p95 max", _away("position_ned_m")),
        ("{}_velocity_mps", "rmse p95 max", _away("velocity_ned_mps", 1)),
    ),
    "truth": (("{}_truth_m", "rmse max", _away("position_ned_m")),),
    "setpoint": (("thrust_{}", "sd", lambda rows, _: rows["thrust"].astype(np.float64)),),
    "attitude": (
        ("{}_heading_deg", "rmse max", _turned_deg),
        ("tilt_{}_deg", "max", _tilted_deg),
        ("roll_rate_{}_radps", "sd", _rate(0)),
        ("pitch_rate_{}_radps", "sd", _rate(1)),
    ),
}


def tracking_metrics(flown: History, track: Track) -> dict[str, float]:
    """Return the values of a Score that are computed from the samples in TRACK."""
    fitness = _fitness(flown, track)
    found = fitness | {"mu_e": sum(fitness.values()), "tracked_s": track.tracked_s}
    for array, measures in _MEASURED.items():
        found |= _measured(track.within(getattr(flown, array)), track, measures)
    directions = thrust_direction_from_quaternion(track.within(flown.setpoint)["quaternion"])
    steps = np.linalg.norm(np.diff(directions, axis=0), axis=1)
    if len(steps):
        found["tilt_command_step_deg"] = math.degrees(math.sqrt((steps**2).mean()))
    return found | _agitation(flown, track)


def _measured(rows: Rows, track: Track, measures: Iterable[Measured]) -> dict[str, float]:
    found: dict[str, float] = {}
    weights = track.shares(rows["time_s"])
    for pattern, kinds, measure in measures:
        found |= _named(pattern, kinds, in_parts(measure, rows, track.reference), weights)
    return found


def _fitness(flown: History, track: Track) -> dict[str, float]:
    """Return the terms of the paper's fitness, Eqs. 31-32: velocities in the body frame, heading in
    degrees."""
    ticks, reference = track.times, track.reference
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


def _agitation(flown: History, track: Track) -> dict[str, float]:
    """Return the RMS of the motion that the reference does not explain.

    It is what remains of thrust direction and body rates after a linear fit by the reference's
    velocity, acceleration and jerk. The fit needs no model of drag and lag. Residuals come from the
    factor R of a QR decomposition of the samples, updated part by part to save memory.
    """
    attitude, reference = track.within(flown.attitude), track.reference
    weights = track.shares(attitude["time_s"])
    weights /= weights.sum()
    factor: Any = np.zeros((0, 11))
    for rows, shares in zip(parts(attitude), parts(weights), strict=True):
        explained = [reference.position(rows["time_s"], order)[:, :2] for order in (1, 2, 3)]
        direction = thrust_direction_from_quaternion(rows["quaternion"])[:, :2]
        motion = direction, rows["rates_radps"][:, :2]
        samples = np.hstack((*explained, np.ones((len(rows), 1)), *motion))
        samples *= np.sqrt(shares)[:, None]
        factor = np.linalg.qr(np.vstack((factor, samples)), mode="r")
    explained, motion = factor[:, :7], factor[:, 7:]
    fit, *_ = np.linalg.lstsq(explained, motion, rcond=None)
    squares = ((motion - explained @ fit) ** 2).sum(axis=0)
    tilt, rate = np.sqrt([squares[:2].sum(), squares[2:].sum()])
    return {
        "tilt_agitation_deg": float(np.degrees(tilt)),
        "rate_agitation_radps": float(rate),
    }


def _nearest(stamps: Array, times: Array) -> NDArray[np.intp]:
    right = np.clip(np.searchsorted(stamps, times), 1, len(stamps) - 1)
    nearest: NDArray[np.intp] = right - (times - stamps[right - 1] < stamps[right] - times)
    return nearest


def _named(pattern: str, kinds: str, values: Array, weights: Array) -> dict[str, float]:
    """Return metrics of `values` (N,) with `weights` (N,) by name, which is `pattern` with each of
    `kinds` inserted. `p95` is not exceeded for 95 % of the time. Samples of weight 0 do not count;
    empty if there are no others."""
    total = float(weights.sum())
    if not total:
        return {}
    mean = float(weights @ values / total)
    square = float(np.einsum("i,i,i", weights, values, values) / total)
    found = {
        "mean": mean,
        "rmse": math.sqrt(square),
        "sd": math.sqrt(max(square - mean**2, 0.0)),
        "max": float(np.max(values, where=weights > 0.0, initial=-math.inf)),
    }
    if "p95" in kinds:
        order = np.argsort(values)
        upto_s = weights[order]
        np.cumsum(upto_s, out=upto_s)
        found["p95"] = float(values[order[np.searchsorted(upto_s, 0.95 * total)]])
    return {pattern.format(kind): found[kind] for kind in kinds.split()}
