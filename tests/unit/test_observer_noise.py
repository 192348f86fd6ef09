"""Noise and drift that the observer estimates, against motions and noises made with NumPy."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
from laws import LEVEL, PX4
from numpy.typing import NDArray

from offboard.estimation.noise import START_SDS, Noise
from offboard.estimation.observer import Observer

Array = NDArray[np.float64]
UPRIGHT, STILL = (1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
DRAG = PX4.drag_per_mass_ps
VEHICLE = PX4.model_copy(
    update={
        "thrust_delay_s": 0.0,
        "thrust_lag_s": 0.0,
        "tilt": PX4.tilt.model_copy(update={"delay_s": 0.0}),
    }
)
NOISE = Noise()
FIXED_DRIFT = Noise(disturbance_limit_mps2=NOISE.disturbance_mps2)


@dataclass(frozen=True)
class Hover:
    """A level vehicle that only a disturbance moves: rows of NED at `times`."""

    times: Array
    positions: Array
    velocities: Array
    disturbances: Array


def hover(seconds: float, gap_s: float, seed: int, drift: float = 0.0, kicks: float = 0.0) -> Hover:
    """v' = d - c v, d a random walk of density `drift` (m/s^2 per root second), v kicked with
    density `kicks` (m/s per root second); per axis, steps of 1 ms."""
    rng = np.random.default_rng(seed)
    steps, root = round(seconds / 1e-3), np.sqrt(1e-3)
    disturbances = np.cumsum(drift * root * rng.standard_normal((steps, 3)), axis=0)
    pushes = 1e-3 * disturbances + kicks * root * rng.standard_normal((steps, 3))
    velocities = np.zeros((steps, 3))
    for i in range(1, steps):
        velocities[i] = (1.0 - 1e-3 * DRAG) * velocities[i - 1] + pushes[i]
    positions = 1e-3 * np.cumsum(velocities, axis=0)
    rows = slice(None, None, round(gap_s / 1e-3))
    times: Array = np.arange(0.0, steps)[rows] * 1e-3
    return Hover(times, positions[rows], velocities[rows], disturbances[rows])


def observe(
    flown: Hover,
    noise: Noise = NOISE,
    white: tuple[float, float] = (0.0, 0.0),
    adopted: bool = True,
) -> tuple[Observer, Array, Array]:
    """An observer after telemetry of `flown` with white noise on position and velocity; estimated
    positions and disturbances (N, 3)."""
    rng = np.random.default_rng(99)
    observer = Observer(VEHICLE, noise)
    observer.on_command(0.0, LEVEL)
    positions, disturbances = np.empty_like(flown.positions), np.empty_like(flown.positions)
    if adopted:
        observer.set_vehicle(VEHICLE)
    for i, time_s in enumerate(flown.times.tolist()):
        position = flown.positions[i] + white[0] * rng.standard_normal(3)
        velocity = flown.velocities[i] + white[1] * rng.standard_normal(3)
        observer.on_attitude(time_s, UPRIGHT, STILL)
        observer.on_position(time_s, tuple(position), tuple(velocity))
        state = observer.predict(time_s)
        positions[i] = state.position_ned_m
        disturbances[i] = state.disturbance_ned_mps2
    return observer, positions, disturbances


def noise_sds(observer: Observer) -> Array:
    """Noise of position (m) and reported velocity (m/s), as estimated (2,)."""
    return np.sqrt(observer.estimated.variances)


def rms(errors: Array, share: float = 0.5) -> float:
    """The RMS of the last `share` of the rows, per axis."""
    return float(np.sqrt(np.mean(errors[-round(share * len(errors)) :] ** 2)))


@pytest.mark.parametrize("gap_s", [0.008, 0.05])
def test_white_noise_is_measured_and_filtered(gap_s: float) -> None:
    """2 cm and 5 cm/s on a drifting hover, at 125 and 20 Hz: estimated within a quarter. At
    most 0.6 cm per sample at 125 Hz is left; with R as configured, 2 mm, 1 cm."""
    flown = hover(25.0, gap_s, seed=1, drift=0.1)
    observer, adapted, _ = observe(flown, white=(0.02, 0.05))
    assert noise_sds(observer)[0] == pytest.approx(0.02, rel=0.25)
    assert noise_sds(observer)[1] == pytest.approx(0.05, rel=0.25)
    if gap_s == 0.008:
        assert rms(adapted - flown.positions) < 0.006


def test_estimate_that_wanders_is_neither_noise_nor_gusts() -> None:
    """A velocity kicked as PX4's frame of reference is (0.2 m/s per root second), smooth from
    sample to sample, on two seeds: the position has no noise, and a third of the variance of the
    kicks, 0.0103 m/s, is taken for noise of the velocity."""
    for seed in (3, 4):
        observer, _, _ = observe(hover(20.0, 0.008, seed=seed, kicks=0.2))
        assert noise_sds(observer)[0] == NOISE.position_sd_m
        assert noise_sds(observer)[1] < 0.011
        floor = NOISE.disturbance_mps2
        assert observer.estimated.drift_mps2 == pytest.approx([floor, floor], rel=0.3)


def test_gusts_are_followed_faster() -> None:
    """A disturbance drifting by 0.7 m/s^2 per root second: both densities grow, the vertical one
    only once the thrust is identified, and fall afterwards. The estimated disturbance has less than
    0.7 of the error that the configured density gives."""
    flown = hover(20.0, 0.01, seed=6, drift=0.7)
    _, _, fixed = observe(flown, FIXED_DRIFT)
    early, _, _ = observe(flown, adopted=False)
    assert early.estimated.drift_mps2[1] == NOISE.disturbance_mps2
    assert early.estimated.drift_mps2[0] > 0.5
    observer, _, adapted = observe(flown)
    assert min(observer.estimated.drift_mps2) > 0.5
    assert rms(adapted - flown.disturbances) < 0.7 * rms(fixed - flown.disturbances)
    for i in range(2000):
        time_s = 20.0 + 0.01 * i
        observer.on_attitude(time_s, UPRIGHT, STILL)
        observer.on_position(time_s, tuple(flown.positions[-1]), STILL)
    assert observer.estimated.drift_mps2 == pytest.approx([0.15, 0.15])


def test_jumps_are_not_noise_and_do_not_hide_gusts() -> None:
    """Fifteen resets of the estimator's position by 2 m in 15 s of gusts."""
    flown = hover(15.0, 0.01, seed=9, drift=0.7)
    jumps = 2.0 * np.cumsum(np.arange(len(flown.times)) % 100 == 50)[:, None]
    observer, _, _ = observe(Hover(flown.times, flown.positions + jumps, *[flown.velocities] * 2))
    assert noise_sds(observer)[0] == NOISE.position_sd_m
    assert observer.estimated.drift_mps2[0] > 0.5


def test_estimates_are_bounded_and_cleared_by_a_reset() -> None:
    noise = replace(NOISE, disturbance_limit_mps2=0.4)
    observer, _, _ = observe(hover(15.0, 0.01, seed=10, drift=2.0), noise, (0.05, 0.0))
    assert noise_sds(observer)[0] > 0.03
    assert max(observer.estimated.drift_mps2) <= 0.4
    observer.reset()
    assert noise_sds(observer) == pytest.approx(START_SDS)
    assert observer.estimated.drift_mps2 == pytest.approx([0.15, 0.15])


def test_positions_that_an_attitude_has_overtaken_leave_the_noise_finite() -> None:
    """Two of them arrive after a newer attitude: the state has the same time at both."""
    observer = Observer(VEHICLE, NOISE)
    observer.on_command(0.0, LEVEL)
    for i in range(200):
        time_s = 0.04 * i
        observer.on_attitude(time_s + 0.05, UPRIGHT, STILL)
        observer.on_position(time_s, (1e-4 * (i % 3), 0.0, -2.0), STILL)
        observer.on_position(time_s + 0.02, (1e-4 * (i % 2), 0.0, -2.0), STILL)
    assert np.isfinite(noise_sds(observer)).all()
    assert np.isfinite(observer.predict(8.0).position_ned_m).all()
