"""Random numbers and linear stochastic processes; all randomness of the vehicle is here.

A normally distributed number is a pure function of (seed, lane, step) without a state, so that n
steps give the same bytes in one call or in several. A lane is an independent random stream. Knows
no vehicle.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from offboard.compiled import kernel

Array = NDArray[np.float64]

_SERIES_LENGTH = 20  # terms of the power series: full precision for a norm of 1 or less
_TWO_TO_MINUS_53 = 2.0**-53
_STEP_STRIDE = np.uint64(0x9E3779B97F4A7C15)
_LANE_STRIDE = np.uint64(0xD1342543DE82EF95)
_PAIR_STRIDE = np.uint64(0xA24BAED4963EE407)


@dataclass(frozen=True, slots=True)
class LinearProcess:
    """x[k+1] = transition x[k] + scale xi[k] with xi standard normal; both matrices (n, n)."""

    transition: Array
    scale: Array
    stationary_scale: Array  # (n, n): stationary_scale @ xi has the stationary covariance


def seed_word(seed: int) -> np.uint64:
    """Return the 64-bit seed of `fill_normals` for any integer seed."""
    entropy = seed if seed >= 0 else (-seed << 1) | (1 << 64)
    return np.uint64(np.random.SeedSequence(entropy).generate_state(1, np.uint64)[0])


def discretise(drift: ArrayLike, densities: ArrayLike, step_s: float) -> LinearProcess:
    """Exact discretisation of x' = A x + w (Van Loan 1978, matrix exponential of size 2n).

    `drift` (n, n) 1/s; `densities` (n,) or the noise input matrix (n, m), in units of x per root
    second. An unstable drift has no stationary covariance; its stationary scale is zero.
    """
    a = np.asarray(drift, dtype=np.float64)
    b = np.asarray(densities, dtype=np.float64)
    b = np.diag(b) if b.ndim == 1 else b
    n = len(a)
    doubled = np.block([[-a, b @ b.T], [np.zeros((n, n)), a.T]])
    exponential = _exponential(doubled * step_s)
    transition = np.ascontiguousarray(exponential[n:, n:].T)
    covariance = transition @ exponential[:n, n:]
    stable = np.all(np.linalg.eigvals(a).real < 0.0)
    stationary = _stationary_covariance(transition, covariance) if stable else np.zeros((n, n))
    return LinearProcess(transition, _square_root(covariance), _square_root(stationary))


def block_diagonal(*processes: LinearProcess) -> LinearProcess:
    """Return independent processes as one process, with their states one after the other."""
    sizes = [len(process.transition) for process in processes]
    ends = np.cumsum(sizes)
    joined = LinearProcess(*(np.zeros((ends[-1], ends[-1])) for _ in range(3)))
    for process, size, end in zip(processes, sizes, ends, strict=True):
        span = slice(end - size, end)
        joined.transition[span, span] = process.transition
        joined.scale[span, span] = process.scale
        joined.stationary_scale[span, span] = process.stationary_scale
    return joined


def _exponential(matrix: Array) -> Array:
    """Matrix exponential by scaling, power series and squaring.

    SciPy has this function, but importing it costs 27 MB and 0.1 s at every start.
    """
    halvings = max(0, math.frexp(float(np.abs(matrix).sum(axis=1).max()))[1])
    scaled = matrix / 2.0**halvings
    total = term = np.eye(len(matrix))
    for power in range(1, _SERIES_LENGTH):
        term = term @ scaled / power
        total = total + term
    return np.linalg.matrix_power(total, 2**halvings)


def _stationary_covariance(transition: Array, covariance: Array) -> Array:
    """Sum of F^k Q F^k' by doubling; converges for every stable F."""
    total, power = covariance, transition
    for _ in range(64):
        total = total + power @ total @ power.T
        power = power @ power
    return total


def _square_root(covariance: Array) -> Array:
    """Factor R with R R' = covariance, which may be singular."""
    values, vectors = np.linalg.eigh(0.5 * (covariance + covariance.T))
    return np.ascontiguousarray(vectors * np.sqrt(np.maximum(values, 0.0)))


@kernel
def _scramble(word: np.uint64) -> np.uint64:
    """Finaliser of the SplitMix64 generator (Steele, Lea, Flood 2014)."""
    word = (word ^ (word >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    word = (word ^ (word >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return word ^ (word >> np.uint64(31))


@kernel
def fill_normals(seed: np.uint64, lane: np.uint64, step: int | np.int64, out: Array) -> None:
    """Write the standard normal numbers of this lane and step to `out` (n,), by Box-Muller."""
    key = _scramble(seed + np.uint64(step) * _STEP_STRIDE + lane * _LANE_STRIDE)
    count = out.shape[0]
    for i in range(0, count, 2):
        word = _scramble(key + np.uint64(i + 1) * _PAIR_STRIDE)
        other = _scramble(word + _STEP_STRIDE)
        uniform = (np.float64(word >> np.uint64(11)) + 0.5) * _TWO_TO_MINUS_53
        angle = 2.0 * math.pi * np.float64(other >> np.uint64(11)) * _TWO_TO_MINUS_53
        radius = math.sqrt(-2.0 * math.log(uniform))
        out[i] = radius * math.cos(angle)
        if i + 1 < count:
            out[i + 1] = radius * math.sin(angle)


@kernel
def advance_process(
    transition: Array, scale: Array, gain: float, normals: Array, x: Array, work: Array
) -> None:
    """Advance a LinearProcess with states `x` (n,) by one step, in place.

    `gain` multiplies the noise; `work` (n,) is scratch.
    """
    count = transition.shape[0]
    for i in range(count):
        total = 0.0
        for j in range(count):
            total += transition[i, j] * x[j] + gain * scale[i, j] * normals[j]
        work[i] = total
    for i in range(count):
        x[i] = work[i]
