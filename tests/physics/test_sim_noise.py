"""Normal numbers and linear processes of the simulator, and the wind made of them."""

from __future__ import annotations

import math

import numba
import numpy as np
import pytest
from scipy import stats
from scipy.integrate import quad_vec
from scipy.linalg import expm, solve_continuous_lyapunov
from scipy.signal import welch

from simulator.vehicle.noise import (
    advance_process,
    discretise,
    fill_normals,
    seed_word,
)
from simulator.vehicle.wind import Gusts, dryden


def _normals(seed: int, lane: int, steps: int, width: int) -> np.ndarray:
    out = np.empty((steps, width))
    _fill(seed_word(seed), np.uint64(lane), out)
    return out


@numba.njit
def _fill(seed, lane, out):
    for step in range(len(out)):
        fill_normals(seed, lane, step, out[step])


def _simulate(process, steps: int, seed: int) -> np.ndarray:
    """(steps, n) path that starts in the stationary distribution."""
    path = _normals(seed, 0, steps, len(process.transition))
    x = process.stationary_scale @ path[0]
    _advance(process.transition, process.scale, x, np.empty_like(x), path)
    return path


@numba.njit
def _advance(transition, scale, x, work, path):
    """Normals into states."""
    for step in range(len(path)):
        advance_process(transition, scale, 1.0, path[step], x, work)
        path[step] = x


def test_normals_are_standard_and_independent():
    values = _normals(3, 0, 7500, 4)
    assert stats.kstest(values.ravel(), "norm").pvalue > 0.01
    assert abs(stats.kurtosis(values.ravel())) < 0.1
    correlation = np.corrcoef(values.T) - np.eye(4)
    assert np.abs(correlation).max() < 4.5 / math.sqrt(len(values))
    for lag in (1, 2, 3):
        assert abs(np.mean(values[lag:] * values[:-lag])) < 4.0 / math.sqrt(values.size)


def test_discretisation_is_exact():
    """Against the definition: F = expm(A h), Q = integral of expm(A s) B B' expm(A s)' ds."""
    drift = np.array([[-0.34, 0.30, -0.78], [-0.28, -0.06, -4.5], [-0.014, 0.026, 0.008]])
    densities = np.array([0.0225, 0.097, 0.012])
    for step_s in (0.004, 0.5):
        process = discretise(drift, densities, step_s)

        def growth(s):
            half = expm(drift * s) * densities
            return half @ half.T

        covariance = quad_vec(growth, 0.0, step_s, epsrel=1e-12)[0]
        assert process.transition == pytest.approx(expm(drift * step_s), rel=1e-10, abs=1e-14)
        assert process.scale @ process.scale.T == pytest.approx(covariance, rel=1e-6, abs=1e-16)
        stationary = solve_continuous_lyapunov(drift, -np.diag(densities**2))
        found = process.stationary_scale @ process.stationary_scale.T
        assert found == pytest.approx(stationary, rel=1e-6)


GUSTS = Gusts(
    intensity_mps=2.0, vertical_ratio=0.5, length_m=10.0, vertical_length_m=4.0, speed_mps=5.0
)


@pytest.mark.parametrize(
    ("component", "state", "sd", "time_s"),
    [("along", 0, 2.0, 2.0), ("across", 1, 2.0, 2.0), ("down", 3, 1.0, 0.8)],
)
def test_dryden_spectrum_and_variance_of_a_long_run(component, state, sd, time_s):
    """MIL-F-8785C: u: 2 s^2 T / (1 + (T w)^2); v, w: s^2 T (1 + 3 (T w)^2) / (1 + (T w)^2)^2."""
    step_s = 0.05
    path = _simulate(dryden(GUSTS, step_s), 100_000, seed=2)[:, state]
    assert path.std() == pytest.approx(sd, rel=0.05)
    frequency, power = welch(path, fs=1.0 / step_s, nperseg=2000)
    band = (frequency > 0.02) & (frequency < 1.0)
    x = (2.0 * math.pi * frequency[band] * time_s) ** 2
    shape = 2.0 / (1.0 + x) if component == "along" else (1.0 + 3.0 * x) / (1.0 + x) ** 2
    expected = 2.0 * sd**2 * time_s * shape  # one-sided, per Hz
    ratio = power[band] / expected
    assert np.mean(ratio) == pytest.approx(1.0, abs=0.06)
    for part in np.array_split(ratio, 5):
        assert np.mean(part) == pytest.approx(1.0, abs=0.15)
