"""Identification against SciPy's simulation of the same equations, with noise, and its refusals."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy import signal
from scipy.integrate import solve_ivp
from scipy.linalg import expm

from offboard.analysis.identify import estimator_noise
from offboard.identification import attitude_fit
from offboard.identification.attitude_fit import ResponseFit
from offboard.identification.motion_fit import Motion, Noise, PositionFilter, predicted_velocity
from offboard.identification.response import first_order, linear_recursion, second_order
from offboard.identification.trace import Rows, Trace, clean
from offboard.identification.uncertainty import Estimate, long_run_covariance
from offboard.identification.vehicle_fit import Identified, completed, identify
from offboard.model.vehicle import AxisResponse, Vehicle

G = 9.80665
VEHICLE_FILE = Vehicle(
    name="file",
    mass_kg=1.0,
    inertia_kgm2=(0.02, 0.02, 0.03),
    drag_translation_npmps=(0.6, 0.6, 0.6),
    drag_rotation_nmpradps=(0.0, 0.0, 0.0),
    hover_thrust=0.42,
    tilt=AxisResponse(delay_s=0.04, natural_frequency_radps=11.0, damping=0.85),
    yaw=AxisResponse(delay_s=0.2, natural_frequency_radps=3.5, damping=0.5),
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


def steps(seed, count=60, period_s=0.1, size=0.035):
    """Random steps, at rest for the first half second."""
    generator = np.random.default_rng(seed)
    values = size * generator.choice([-1.0, 0.0, 1.0], count)
    values[:5] = 0.0
    return np.arange(count) * period_s, values


def fit_response(*measured, **options) -> ResponseFit:
    return completed(attitude_fit.fit_response(*measured, **options))


def test_linear_recursion_equals_its_loop():
    generator = np.random.default_rng(8)
    transitions = 0.5 * generator.normal(size=(29, 3, 3))
    inputs = generator.normal(size=(30, 3, 2))
    states = [inputs[0]]
    for transition, added in zip(transitions, inputs[1:], strict=True):
        states.append(transition @ states[-1] + added)
    assert linear_recursion(transitions, inputs) == pytest.approx(np.array(states), rel=1e-12)


@pytest.mark.parametrize("damping", [0.3, 0.999, 1.0, 1.7])
def test_second_order_response_equals_scipys_simulation(damping):
    """At any time since a command, which acts when its delay is over and not before."""
    sent_at, values = steps(3)
    times = 0.3 + np.cumsum(np.random.default_rng(4).choice([0.008, 0.016, 0.004], 500))
    ours = second_order(times, sent_at, values[:, None], 0.057, 11.4, damping)[:, 0]
    theirs = simulated(values, sent_at, 0.057, 11.4, damping, times)
    assert np.abs(ours - theirs).max() < 2e-5
    assert np.abs(theirs).max() > 0.02
    before = times < sent_at[np.flatnonzero(values)[0]] + 0.057
    assert np.abs(ours[before]).max() == 0.0


def test_innovations_of_a_matching_motion_are_white_and_of_unit_variance():
    """Position, speed and disturbance are driven by the densities that the filter assumes."""
    generator = np.random.default_rng(11)
    step_s, count, drag = 0.02, 20000, 0.7
    densities = np.array([0.02, 0.3, 0.5])
    drift = expm(np.array([[0.0, 1.0, 0.0], [0.0, -drag, 1.0], [0.0, 0.0, 0.0]]) * step_s)
    kicks = generator.normal(size=(count, 3)) * densities * math.sqrt(step_s)
    state, positions = np.zeros(3), np.empty(count)
    for i in range(count):
        positions[i] = state[0] + 0.01 * generator.normal()
        state = drift @ state + kicks[i]
    times = step_s * np.arange(count)
    position_filter = PositionFilter(times, drag, Noise(*densities, 0.01, 1.0, 1.0))
    white = position_filter.innovations(positions[None], np.zeros((1, count)), drag)[0, 200:]
    assert np.mean(white**2) == pytest.approx(1.0, abs=0.03)
    assert abs(np.mean(white[1:] * white[:-1])) < 0.02


@pytest.mark.parametrize("lags", [5, 15, 30])
def test_long_run_covariance_of_residuals_is_that_of_the_errors(lags):
    """Errors about their mean, as a fit leaves them; without the correction 8 to 41 % less."""
    generator = np.random.default_rng(6)
    errors = generator.normal(size=(4000, 120, 1))
    left = errors - errors.mean(axis=1, keepdims=True)
    found = np.mean([long_run_covariance(each, lags)[0, 0] for each in left])
    assert found == pytest.approx(120.0, rel=0.03)


def away_in_sds(fit: ResponseFit, true) -> list[float]:
    found = (fit.delay_s, fit.natural_frequency_radps, fit.damping)
    return [(each.value - t) / each.sd for each, t in zip(found, true, strict=True)]


def test_standard_deviations_agree_with_repeated_fits():
    """Noise is autocorrelated over 0.2 s, as an estimator's: errors over their sd have an rms near
    1."""
    sent_at, values = steps(6)
    times, true = np.arange(0.3, 5.9, 0.01), (0.05, 11.0, 0.6)
    exact, away = simulated(values, sent_at, *true, times), []
    for seed in range(40):
        white = np.random.default_rng(seed).normal(size=len(times) + 200)
        related = signal.lfilter([math.sqrt(1.0 - 0.95**2)], [1.0, -0.95], white)[200:]
        noisy = (exact + 0.002 * related)[:, None]
        away.append(away_in_sds(fit_response(times, noisy, sent_at, values[:, None]), true))
    rms = np.sqrt(np.mean(np.square(away), axis=0))
    assert ((rms > 0.5) & (rms < 1.8)).all(), rms


@pytest.mark.parametrize("white", [0.0, 0.001])
def test_standard_deviations_of_a_heading_whose_errors_wander(white):
    """Sixty stretches of 5.4 s with one double step, as in the phase EXCITE; errors of PX4's
    estimate, 16 mrad per root second. The residuals themselves would claim 40 % of the delay's."""
    true, sent_at = (0.15, 3.1, 0.4), np.arange(0.0, 5.4, 0.1)
    values = 0.07 * np.where((sent_at >= 1.0) & (sent_at < 5.0), 1.0, 0.0)
    values[(sent_at >= 2.0) & (sent_at < 4.0)] = -0.07
    times = np.arange(0.0, 5.4, 0.02)
    exact, away = simulated(values, sent_at, *true, times), []
    for seed in range(60):
        generator = np.random.default_rng(seed)
        walk = np.cumsum(generator.normal(size=len(times))) * 0.016 * math.sqrt(0.02)
        heading = (exact + walk + white * generator.normal(size=len(times)))[:, None]
        fit = fit_response(times, heading, sent_at, values[:, None], wanders=True)
        away.append(away_in_sds(fit, true))
    rms = np.sqrt(np.mean(np.square(away), axis=0))
    assert ((rms > 0.7) & (rms < 1.5)).all(), rms


def with_lost_commands(seed, share, times, size):
    """Random steps of which this share never acts, which the fit does not know, and the response
    with a delay of 0.15 s and noise of 0.001."""
    sent_at, values = steps(seed, count=80, size=size)
    generator = np.random.default_rng(seed)
    acts = generator.random(80) > share
    acts[0] = True
    signals = simulated(values[acts], sent_at[acts], 0.15, 11.0, 0.6, times)
    signals += 0.001 * generator.normal(size=len(times))
    return times, signals[:, None], sent_at, values[:, None]


def test_fit_is_right_within_its_uncertainty_though_commands_are_lost():
    shares, errors_s = [], []
    times = np.arange(0.3, 7.9, 0.02)
    for seed in range(30):
        delay = fit_response(*with_lost_commands(seed, 1 / 12, times, 0.035)).delay_s
        shares.append((delay.value - 0.15) / delay.sd)
        errors_s.append(delay.value - 0.15)
    assert np.max(np.abs(errors_s)) < 0.015
    assert np.max(np.abs(shares)) < 3.5
    assert 0.3 < np.sqrt(np.mean(np.square(shares))) < 1.5


def test_weights_of_outliers_have_converged():
    """Large steps, telemetry at 20 Hz: the delay's error is 1.5 ms rms, with weights
    that are computed twice only 3.7 ms."""
    times = np.arange(0.3, 7.9, 0.05)
    fits = [fit_response(*with_lost_commands(seed, 1 / 8, times, 0.1)) for seed in range(15)]
    assert np.sqrt(np.mean([(fit.delay_s.value - 0.15) ** 2 for fit in fits])) < 0.002


def test_delay_known_beforehand_counts_by_its_uncertainty():
    """An uncertain one changes nothing; a certain one decides, also on the natural frequency."""
    sent_at, values = steps(5)
    times = np.arange(0.3, 5.9, 0.01)
    noise = 0.004 * np.random.default_rng(1).normal(size=len(times))
    signals = (simulated(values, sent_at, 0.123, 7.0, 1.2, times) + noise)[:, None]
    alone, uncertain, certain = (
        fit_response(times, signals, sent_at, values[:, None], delay)
        for delay in (None, Estimate(0.3, 10.0), Estimate(0.123, 1e-5))
    )
    assert uncertain.delay_s.value == pytest.approx(alone.delay_s.value, abs=1e-6)
    assert uncertain.delay_s.sd == pytest.approx(alone.delay_s.sd, rel=1e-3)
    assert certain.delay_s.value == pytest.approx(0.123, abs=1e-4)
    assert certain.delay_s.sd < 1e-4
    wrong = [abs(each.natural_frequency_radps.value - 7.0) for each in (alone, certain)]
    assert wrong[1] < 0.7 * wrong[0]


def test_first_order_response_equals_scipys_integration():
    sent_at = np.array([0.0, 0.5, 0.9, 1.4])
    thrust = np.array([0.4, 0.5, 0.35, 0.45])
    times = np.arange(0.4, 2.0, 0.013)

    def rate(t, u):
        row = max(int(np.searchsorted(sent_at + 0.02, t, side="right")) - 1, 0)
        return (thrust[row] - u) / 0.08

    solved = solve_ivp(rate, (0.0, 2.0), [0.4], t_eval=times, max_step=1e-3, rtol=1e-8)
    ours = first_order(times, sent_at, thrust[:, None], 0.02, 0.08)[:, 0]
    assert np.abs(ours - solved.y[0]).max() < 5e-4


def flown(
    *, tilt=0.25, heading=0.1, heave=0.06, hover=0.5, drag=0.8, noise=0.0, seconds=12.0, seed=1
) -> Trace:
    """A vehicle that swings under open-loop commands, integrated by SciPy. Delay, natural frequency
    and damping: tilt .06, 12, .7, heading .1, 4, .6; thrust: delay .02, lag .05."""
    sent_at = np.arange(0.0, seconds, 0.1)
    generator = np.random.default_rng(seed)
    swing = tilt * np.sin(1.6 * sent_at), tilt * np.cos(2.3 * sent_at)
    tilts = [each + 0.1 * tilt * generator.choice([-1, 0, 1], len(sent_at)) for each in swing]
    thrust = hover * (1.0 + heave * np.sign(np.sin(2.0 * sent_at)))
    headings = heading * np.sign(np.sin(1.1 * sent_at))
    grid = np.arange(0.0, seconds, 0.01)
    b = [simulated(each, sent_at, 0.06, 12.0, 0.7, grid) for each in tilts]
    turned = simulated(headings, sent_at, 0.1, 4.0, 0.6, grid)

    def rate(t, x):
        row = max(int(np.searchsorted(sent_at + 0.02, t + 1e-12, side="right")) - 1, 0)
        push = G / hover * x[6]
        north, east = (np.interp(t, grid, each) for each in b)
        down = G - push * math.sqrt(1.0 - north**2 - east**2)
        pulls = np.array([-push * north, -push * east, down])
        return np.concatenate((x[3:6], pulls - drag * x[3:6], [(thrust[row] - x[6]) / 0.05]))

    start = np.array([0, 0, 0, 0, 0, 0, hover], float)
    solved = solve_ivp(rate, (0.0, seconds), start, t_eval=grid, max_step=0.01, rtol=1e-7)
    position = solved.y[:3].T + noise * generator.normal(size=(len(grid), 3))
    velocity = solved.y[3:6].T
    direction = np.array(b).T + 0.2 * noise * generator.normal(size=(len(grid), 2))
    whole = Trace(
        np.column_stack((sent_at, *tilts, thrust, headings)),
        np.column_stack((grid, direction, turned)),
        np.column_stack((grid, position, velocity)),
    )
    return whole.between(0.5, seconds)  # what was commanded before is known


@pytest.mark.parametrize("noise", [0.0, 0.001])
def test_every_constant_is_identified(noise):
    found = identify(flown(noise=noise), VEHICLE_FILE)
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


def test_reported_velocity_is_not_used():
    """A velocity that is wrong by 0.4 m/s for seconds changes nothing but the noise figure."""
    true = flown()
    wrong = true.position.copy()
    wrong[:, 4:7] += 0.4 * np.sin(1.5 * wrong[:, :1])
    right, misled = (
        identify(Trace(true.commands, true.attitude, each), VEHICLE_FILE)
        for each in (true.position, wrong)
    )
    assert misled.drag_ps == right.drag_ps
    assert misled.hover_thrust == right.hover_thrust
    contradictions = [
        estimator_noise(Trace(true.commands, true.attitude, each)).velocity_contradiction_mps
        for each in (true.position, wrong)
    ]
    assert contradictions[0] < 0.002
    assert 0.2 < contradictions[1] < 0.4


def test_predicted_velocity_is_that_of_the_flight():
    """With the true constants, after the unknown speed at the start has decayed for 7 s; a constant
    velocity is not determined."""
    trace = flown()
    true = VEHICLE_FILE.model_copy(
        update={
            "hover_thrust": 0.5,
            "thrust_lag_s": 0.05,
            "thrust_delay_s": 0.02,
            "drag_translation_npmps": (0.8, 0.8, 0.8),
        }
    )
    motion = Motion(trace)
    velocity = predicted_velocity(motion, true)
    flight = np.array(
        [np.interp(motion.times, trace.position[:, 0], trace.position[:, 4 + i]) for i in range(3)]
    )
    later = motion.times > motion.times[0] + 7.0
    apart = np.std(velocity - flight, axis=1, where=later)
    assert np.all(np.std(flight, axis=1, where=later) > [0.4, 0.3, 0.15])
    assert np.all(apart < 0.01)


def test_white_noise_of_the_estimator_is_measured():
    trace = flown(noise=0.004)
    noise = estimator_noise(trace)
    assert noise.position_m == pytest.approx(0.004, rel=0.1)
    assert noise.attitude_rad == pytest.approx(0.0008, rel=0.15)
    assert noise.velocity_mps < 1e-4


@pytest.mark.parametrize(
    ("flight", "refused"),
    [
        (
            {"tilt": 0.0, "heading": 0.0, "heave": 0.0},
            {
                "tilt": "moved by 0.0 mrad rms",
                "yaw": "moved by 0.0 mrad rms",
                "thrust_lag_s": "the thrust changed by 0.0 %",
                "drag_ps": "drag needs motion",
            },
        ),
        ({"tilt": 0.01}, {"drag_ps": "drag needs motion"}),
        ({"seconds": 2.0}, {"tilt": "1.5 s of flight, 2 s are needed"}),
    ],
)
def test_constant_that_the_flight_does_not_determine_is_refused(flight, refused):
    """Hovering without steps determines the hover thrust alone."""
    found = identify(flown(**flight), VEHICLE_FILE)
    applied = found.applied_to(VEHICLE_FILE)
    for name, words in refused.items():
        assert words in found.refusals[name]
        assert getattr(found, name) is None
        assert getattr(applied, name, None) == getattr(VEHICLE_FILE, name, None)
    if len(refused) > 1:
        assert found.hover_thrust is not None
        assert found.hover_thrust.value == pytest.approx(0.5, rel=0.005)


def test_attitude_that_does_not_follow_its_commands_is_refused():
    """The attitude of one flight with the commands of another."""
    ours, other = flown(seed=1), flown(seed=2)
    swapped = other.commands.copy()
    swapped[:, 1:3] = np.roll(swapped[:, 1:3], 17, axis=0)
    found = identify(Trace(swapped, ours.attitude, ours.position), VEHICLE_FILE)
    assert found.tilt is None
    assert "does not follow" in found.refusals["tilt"] or "limit" in found.refusals["tilt"]


def test_almost_empty_trace_is_refused():
    trace = flown(seconds=3.0)
    for rows in (0, 1, 5):
        cut = Trace(trace.commands[:rows], trace.attitude[:rows], trace.position[:rows])
        found = identify(cut, VEHICLE_FILE)
        assert found == Identified(0.0, refusals=found.refusals)
        assert set(found.refusals) >= {"tilt", "yaw", "hover_thrust", "drag_ps"}
        assert not found.supported


def test_last_rows_are_kept_and_cleaned():
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
