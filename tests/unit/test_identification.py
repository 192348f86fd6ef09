"""Identification against SciPy's simulation of the same equations, with noise, and its refusals."""

from __future__ import annotations

import math
from functools import cache

import numpy as np
import pytest
from attitude_plant import Plant, Truth
from laws import PX4, G
from scipy import signal
from scipy.linalg import expm

from offboard.analysis.identify import estimator_noise
from offboard.identification import attitude_fit
from offboard.identification.attitude_fit import ResponseFit
from offboard.identification.motion_fit import (
    ACCELERATION_MPS,
    WANDER_M,
    WANDER_S,
    PositionFilter,
)
from offboard.identification.trace import Rows, Trace, clean
from offboard.identification.uncertainty import Estimate
from offboard.identification.vehicle_fit import completed, identify
from offboard.model.command import Command
from offboard.model.vehicle import AxisResponse

VEHICLE_FILE = PX4.model_copy(
    update={"hover_thrust": 0.42, "drag_translation_npmps": (0.6, 0.6, 0.6), "thrust_lag_s": 0.0}
)
FINE_S = 1e-3


def simulated(commands, sent_at, delay_s, frequency, damping, times):
    """The second-order response by SciPy's linear simulation on a grid of 1 ms."""
    grid = np.arange(0.0, times[-1] + 0.01, FINE_S)
    rows = np.searchsorted(sent_at + delay_s, grid + 1e-9, side="right") - 1
    held = np.where(rows < 0, 0.0, commands[np.maximum(rows, 0)])
    system = [frequency**2], [1.0, 2.0 * damping * frequency, frequency**2]
    numerator, denominator, _ = signal.cont2discrete(system, FINE_S)  # zero-order hold
    return np.interp(times, grid, signal.lfilter(numerator[0], denominator, held))


def steps(seed):
    """Random steps, at rest for the first half second."""
    generator = np.random.default_rng(seed)
    values = 0.035 * generator.choice([-1.0, 0.0, 1.0], 60)
    values[:5] = 0.0
    return np.arange(60) * 0.1, values


def fit_response(*measured, delay: Estimate | None = None, wanders=False) -> ResponseFit:
    problem = attitude_fit.ResponseProblem(*measured, wanders=wanders)
    return completed(attitude_fit.fit_response(problem, delay))


def test_innovations_are_white_with_unit_variance():
    """The simulated speed, disturbance and rate of the wander are driven by noise of the densities
    that the filter assumes."""
    generator = np.random.default_rng(11)
    step_s, count, drag = 0.02, 20000, 0.7
    rate = 1.0 / WANDER_S
    rates = [[0.0, 1.0, 0.0, 1.0], [0.0, -drag, 1.0, 0.0], [0.0] * 4, [0.0, 0.0, 0.0, -rate]]
    drift = expm(np.array(rates) * step_s)
    driven = np.array([0.0, ACCELERATION_MPS, 0.5, rate * WANDER_M]) * math.sqrt(step_s)
    kicks = generator.normal(size=(count, 4)) * driven
    state, positions = np.zeros(4), np.empty(count)
    for i in range(count):
        positions[i] = state[0] + 0.01 * generator.normal()
        state = drift @ state + kicks[i]
    times = step_s * np.arange(count)
    position_filter = PositionFilter(times, drag, 0.01, (0.5, 1.0))
    white = position_filter.innovations(positions[None], np.zeros((1, count)), drag)[0, 200:]
    assert np.mean(white**2) == pytest.approx(1.0, abs=0.03)
    assert abs(np.mean(white[1:] * white[:-1])) < 0.02


def rms_in_sds(fits: list[ResponseFit], true) -> np.ndarray:
    """RMS errors of delay, frequency and damping (3,), each in its own standard deviations."""
    found = [(fit.delay_s, fit.natural_frequency_radps, fit.damping) for fit in fits]
    away = [[(each.value - t) / each.sd for each, t in zip(f, true, strict=True)] for f in found]
    return np.sqrt(np.mean(np.square(away), axis=0))


def test_standard_deviations_agree_with_repeated_fits():
    """With noise that is autocorrelated over 0.2 s, as an estimator's is, errors divided by their
    sd have an RMS near 1."""
    (sent_at, values), fits = steps(6), []
    times, true = np.arange(0.3, 5.9, 0.01), (0.05, 11.0, 0.6)
    exact = simulated(values, sent_at, *true, times)
    for seed in range(40):
        white = np.random.default_rng(seed).normal(size=len(times) + 200)
        related = signal.lfilter([math.sqrt(1.0 - 0.95**2)], [1.0, -0.95], white)[200:]
        noisy = (exact + 0.002 * related)[:, None]
        fits.append(fit_response(times, noisy, sent_at, values[:, None]))
    rms = rms_in_sds(fits, true)
    assert ((rms > 0.5) & (rms < 1.8)).all(), rms


def test_standard_deviations_allow_for_a_wandering_heading():
    """Sixty records of 5.4 s with one double step, as in the phase EXCITE; the heading's error
    walks as PX4's, 16 mrad per root second. The residuals alone give 40 % of the delay's sd."""
    true, sent_at = (0.15, 3.1, 0.4), np.arange(0.0, 5.4, 0.1)
    values = 0.07 * np.where((sent_at >= 1.0) & (sent_at < 5.0), 1.0, 0.0)
    values[(sent_at >= 2.0) & (sent_at < 4.0)] = -0.07
    times, fits = np.arange(0.0, 5.4, 0.02), []
    exact = simulated(values, sent_at, *true, times)
    for seed in range(60):
        walk, white = np.random.default_rng(seed).normal(size=(2, len(times)))
        errors = np.cumsum(walk) * 0.016 * math.sqrt(0.02) + 0.001 * white
        heading = (exact + errors)[:, None]
        fits.append(fit_response(times, heading, sent_at, values[:, None], wanders=True))
    rms = rms_in_sds(fits, true)
    assert ((rms > 0.7) & (rms < 1.5)).all(), rms


def test_prior_delay_is_weighted_by_its_uncertainty():
    """An uncertain prior changes nothing; a certain one is adopted and improves the frequency."""
    sent_at, values = steps(5)
    times = np.arange(0.3, 5.9, 0.01)
    noise = 0.004 * np.random.default_rng(1).normal(size=len(times))
    signals = (simulated(values, sent_at, 0.123, 7.0, 1.2, times) + noise)[:, None]
    alone, uncertain, certain = (
        fit_response(times, signals, sent_at, values[:, None], delay=delay)
        for delay in (None, Estimate(0.3, 10.0), Estimate(0.123, 1e-5))
    )
    assert uncertain.delay_s.value == pytest.approx(alone.delay_s.value, abs=1e-6)
    assert uncertain.delay_s.sd == pytest.approx(alone.delay_s.sd, rel=1e-3)
    assert certain.delay_s.value == pytest.approx(0.123, abs=1e-4)
    assert certain.delay_s.sd < 1e-4
    wrong = [abs(each.natural_frequency_radps.value - 7.0) for each in (alone, certain)]
    assert wrong[1] < 0.7 * wrong[0]


@cache
def flown(
    *, tilt=0.25, heading=0.1, thrust_step=0.06, hover=0.5, drag=0.8, noise=0.0, seconds=12.0
) -> Trace:
    """Telemetry of the plant of `attitude_plant`, swinging under open-loop commands."""
    true = PX4.model_copy(
        update={
            "drag_translation_npmps": (drag,) * 3,
            "thrust_delay_s": 0.02,
            "thrust_lag_s": 0.05,
            "tilt": AxisResponse(delay_s=0.06, natural_frequency_radps=12.0, damping=0.7),
            "yaw": AxisResponse(delay_s=0.1, natural_frequency_radps=4.0, damping=0.6),
        }
    )
    sent_at, generator = np.arange(0.0, seconds, 0.1), np.random.default_rng(1)
    swing = tilt * np.sin(1.6 * sent_at), tilt * np.cos(2.3 * sent_at)
    tilts = [each + 0.1 * tilt * generator.choice([-1, 0, 1], len(sent_at)) for each in swing]
    thrust = hover * (1.0 + thrust_step * np.sign(np.sin(2.0 * sent_at)))
    headings = heading * np.sign(np.sin(1.1 * sent_at))
    commands = np.column_stack((sent_at, *tilts, thrust, headings))
    plant, rows = Plant(Truth(true)), []
    for _, north, east, share, heading_rad in commands:
        down = math.sqrt(1.0 - north**2 - east**2)
        plant.command(Command(G * share / hover, (north, east, down), heading_rad))
        for _ in range(10):
            rows.append((plant.time_s, *plant.x))
            plant.advance(0.01)
    seen = np.array(rows)
    seen[:, 1:4] += noise * generator.normal(size=(len(seen), 3))
    seen[:, 7:9] += 0.2 * noise * generator.normal(size=(len(seen), 2))
    whole = Trace(commands, seen[:, [0, 7, 8, 12]], seen[:, :7])
    return whole.between(0.5, seconds)  # the commands before 0.5 s are kept


def test_every_constant_is_identified():
    found = identify(flown(noise=0.001), VEHICLE_FILE)
    assert not found.refusals
    values = {name: each.value for name, each in found.estimates.items() if each is not None}
    effect_s = values.pop("thrust_lag_s") + values.pop("thrust_delay_s")
    assert effect_s == pytest.approx(0.07, abs=0.015)
    expected = {
        "tilt_delay_s": pytest.approx(0.06, abs=0.002),
        "tilt_natural_frequency_radps": pytest.approx(12.0, rel=0.02),
        "tilt_damping": pytest.approx(0.7, abs=0.02),
        "yaw_delay_s": pytest.approx(0.1, abs=0.01),
        "yaw_natural_frequency_radps": pytest.approx(4.0, rel=0.03),
        "yaw_damping": pytest.approx(0.6, abs=0.03),
        "hover_thrust": pytest.approx(0.5, rel=0.01),
        "drag_ps": pytest.approx(0.8, rel=0.05),
    }
    assert values == expected
    applied = found.applied_to(VEHICLE_FILE)
    assert applied.drag_per_mass_ps == pytest.approx(values["drag_ps"])
    assert applied.tilt.damping == values["tilt_damping"]


def test_velocity_that_contradicts_positions_is_measured() -> None:
    """The reported velocity is wrong by up to 0.4 m/s for seconds."""
    true, told_mps = flown(), []
    for wrong_mps in (0.0, 0.4):
        position = true.position.copy()
        position[:, 4:7] += wrong_mps * np.sin(1.5 * position[:, :1])
        told_mps.append(estimator_noise(Trace(true.commands, true.attitude, position))[-1])
    assert told_mps[0] < 0.002
    assert 0.2 < told_mps[1] < 0.4


def test_undetermined_constants_are_refused():
    """Hovering without steps determines the hover thrust alone."""
    found = identify(flown(tilt=0.0, heading=0.0, thrust_step=0.0), VEHICLE_FILE)
    for name, words in (
        ("tilt", "changed by only 0.0 mrad rms"),
        ("yaw", "changed by only 0.0 mrad rms"),
        ("thrust_lag_s", "the thrust changed by 0.0 %"),
        ("drag_ps", "drag needs motion"),
    ):
        assert words in found.refusals[name]
        assert getattr(found, name) is None
    assert found.hover_thrust is not None
    assert found.hover_thrust.value == pytest.approx(0.5, rel=0.005)
    hover = {"hover_thrust": found.hover_thrust.value}
    assert found.applied_to(VEHICLE_FILE) == VEHICLE_FILE.model_copy(update=hover)
    short = identify(flown(seconds=2.0), VEHICLE_FILE)
    assert "1.5 s of flight, 2 s are needed" in short.refusals["tilt"]


def test_hover_thrust_with_an_sd_of_two_percent_is_used():
    """A vehicle file may be wrong by far more, and the drag is fitted with the hover thrust."""
    found = identify(flown(noise=0.6, seconds=3.5), VEHICLE_FILE).hover_thrust
    assert found is not None
    assert 0.02 < found.sd / found.value < 0.05
    assert found.value == pytest.approx(0.5, rel=0.03)


def test_newest_rows_are_kept_and_cleaned():
    stamps = [0.0, 0.1, 0.1, 0.05, 0.2, 0.3]
    north = [1.0, 2.0, 3.0, 9.0, math.nan, 4.0]
    kept = Rows(5, capacity=6)
    for _ in range(7):
        for stamp, each in zip(stamps, north, strict=True):
            kept.add(stamp, each, 0.0, 0.5, 0.0)
    assert 6 <= len(kept.kept) <= 12
    rows = kept.kept[-6:]
    trace = clean(rows, rows[:, :4], np.zeros((0, 7)))
    assert trace.commands[:, 1].tolist() == [1.0, 3.0, 4.0]
    assert trace.attitude[:, 1].tolist() == [1.0, 2.0, 4.0]
    assert math.isnan(trace.begin_s)
    assert trace.between(0.1, 0.2).attitude[:, 1].tolist() == [2.0]
