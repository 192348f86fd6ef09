"""The observer against an independent plant, SciPy's integrator and Riccati equation; its
estimates of noise and drift against motions and noise generated with NumPy."""

from __future__ import annotations

import copy
import itertools
import math
from dataclasses import dataclass, replace

import numpy as np
import pytest
from attitude_plant import Plant, Truth
from laws import LEVEL, PX4, G
from numpy.typing import NDArray
from scipy.integrate import solve_ivp
from scipy.linalg import expm, solve_discrete_are

from offboard.estimation.motion import COMMAND_SIZE, STATE_SIZE, THRUST, plant_of, propagate
from offboard.estimation.noise import START_SDS, Noise
from offboard.estimation.observer import Observer
from offboard.model.command import Command, PredictedState
from offboard.model.frames import quaternion_from_thrust_direction

Array = NDArray[np.float64]
UPRIGHT = (1.0, 0.0, 0.0, 0.0)
STILL = (0.0, 0.0, 0.0)
NO_DELAY = PX4.model_copy(update={"tilt": PX4.tilt.model_copy(update={"delay_s": 0.0})})


def command(north: float, east: float, thrust: float = G, heading: float = 0.0) -> Command:
    down = math.sqrt(1 - north**2 - east**2)
    return Command(thrust, (north, east, down), math.remainder(heading, math.tau))


def feed(observer, time_s, position=STILL, velocity=STILL, attitude=UPRIGHT) -> None:
    observer.on_attitude(time_s, tuple(attitude), STILL)
    observer.on_position(time_s, tuple(position), tuple(velocity))


def watch(observer: Observer, plant: Plant) -> None:
    feed(observer, plant.time_s, *plant.position(), plant.attitude())


def hovering(noise: Noise | None = None, until_s: float = 5.0) -> Observer:
    """An observer after a hover with exact telemetry every 10 ms."""
    observer = Observer(NO_DELAY, noise)
    observer.on_command(0.0, LEVEL)
    for i in range(round(until_s / 0.01) + 1):
        feed(observer, 0.01 * i)
    return observer


# ---------------------------------------------------------------- gains and motion


def test_steady_gains_solve_the_riccati_equation() -> None:
    """A message that is disturbed by 1e-6 changes the lateral state [p, v, b, b', d] by SciPy's
    gains times that. The velocity, with an sd of 1 m/s, has no influence."""
    small, step_s, noise = 1e-6, 0.01, Noise(velocity_sd_mps=1.0)
    wn, damping, drag_ps = 11.4, 0.56, PX4.drag_per_mass_ps
    a, b = np.zeros((5, 5)), np.zeros((5, 5))
    a[0, 1] = a[1, 4] = a[2, 3] = 1.0
    a[1, 1:3], a[3, 2:4] = (-drag_ps, -G), (-(wn**2), -2.0 * damping * wn)
    densities = 0.0, noise.acceleration_mps, 0.0, noise.tilt_radps, noise.disturbance_mps2
    b[range(5), range(5)] = np.square(densities)
    van_loan = expm(np.block([[-a, b], [np.zeros((5, 5)), a.T]]) * step_s)
    f = van_loan[5:, 5:].T
    q = f @ van_loan[:5, 5:]
    h, r = np.eye(5)[[0, 2]], np.diag([noise.position_sd_m**2, noise.attitude_sd_rad**2])
    covariance = solve_discrete_are(f.T, h.T, q, r)
    expected = covariance @ h.T @ np.linalg.inv(h @ covariance @ h.T + r)

    converged = hovering(noise, until_s=40.0)

    def after(position: float, tilt: float) -> np.ndarray:
        observer = copy.deepcopy(converged)
        direction = np.array([tilt, 0.0, math.sqrt(1 - tilt**2)])
        attitude = quaternion_from_thrust_direction(direction, 0.0)
        feed(observer, 40.01, (position, 0.0, 0.0), attitude=attitude)
        state = observer.predict(40.01)
        north = (state.position_ned_m, state.velocity_ned_mps, state.thrust_direction_ned,
                 state.thrust_direction_rate_ned_ps, state.disturbance_ned_mps2)  # fmt: skip
        return np.array(north)[:, 0]

    at_rest = after(0, 0)
    of_position = (after(small, 0) - at_rest) / small
    of_tilt = (after(0, small) - at_rest) / small
    assert of_position[[0, 1, 4]] == pytest.approx(expected[[0, 1, 4], 0], rel=0.02)
    assert of_tilt[2:4] == pytest.approx(expected[2:4, 1], rel=0.02)


@pytest.mark.parametrize("damping", [0.56, 1.115])
def test_propagation_agrees_with_scipy(damping: float) -> None:
    """The oracle for one second under five commands, each axis with its own delay, is DOP853,
    restarted whenever a command takes effect."""
    tilt = PX4.tilt.model_copy(update={"damping": damping})
    vehicle = PX4.model_copy(update={"tilt": tilt})
    rng = np.random.default_rng(3)
    sent = np.zeros((5, COMMAND_SIZE))
    sent[:, 0] = [-0.2, 0.013, 0.113, 0.5, 0.62]
    sent[:, 1:3] = rng.uniform(-0.3, 0.3, (5, 2))
    sent[:, 3] = G + rng.uniform(-2, 2, 5)
    sent[:, 4] = rng.uniform(-0.5, 0.5, 5)
    start = rng.uniform(-0.2, 0.2, STATE_SIZE)
    start[THRUST] = 10.0
    delays = np.array([0.057, 0.057, 0.015, 0.148])

    def held(time: float) -> np.ndarray:
        rows = [np.flatnonzero(sent[:, 0] + delay <= time)[-1] for delay in delays]
        return sent[rows, [1, 2, 3, 4]]

    def rate(_: float, x: np.ndarray, u: np.ndarray) -> np.ndarray:
        p, v, b, b1, d, beta = x[:3], x[3:6], x[6:8], x[8:10], x[10:13], x[13:16]
        direction = np.array([b[0], b[1], np.sqrt(1 - b @ b)])
        a = np.array([0, 0, G]) - x[16] * direction - 1.02 * v + d
        b2 = 11.4**2 * (u[:2] - b) - 2 * damping * 11.4 * b1
        yaw = 3.1**2 * (u[3] - x[17]) - 2 * 0.4 * 3.1 * x[18]
        zeros, lagged = 0 * p, (u[2] - x[16]) / 0.05
        return np.concatenate([v, a, b1, b2, zeros, -beta / 10, [lagged, x[18], yaw]])

    edges = np.unique(np.concatenate([[0, 1], *(sent[:, 0] + delay for delay in delays)]))
    edges = edges[(edges >= 0) & (edges <= 1)]
    x = start.copy()
    for a, b in itertools.pairwise(edges):
        u = held(0.5 * (a + b))
        x = solve_ivp(rate, (a, b), x, "DOP853", args=(u,), rtol=1e-11, atol=1e-12).y[:, -1]
    propagate(start, plant_of(vehicle), sent, 0.0, 1.0)
    assert start == pytest.approx(x, abs=3e-6)


def test_prediction_is_exact_on_a_matching_plant() -> None:
    """Commands are random tilts and headings at 10 Hz, facing south, so that heading, telemetry and
    commands cross the wrap at +-pi. After a gap of half a second in telemetry the state is right
    at once."""
    plant, rng = Plant(Truth(PX4)), np.random.default_rng(5)
    plant.x[11] = math.pi
    observer = Observer(PX4)

    def send(sent: Command) -> None:
        observer.on_command(plant.time_s, sent)
        unwrapped = math.pi + math.remainder(sent.heading_rad - math.pi, math.tau)
        plant.command(replace(sent, heading_rad=unwrapped))

    def compare(state: PredictedState, near_m: float) -> None:
        truth = plant.x
        assert state.position_ned_m == pytest.approx(truth[:3], abs=near_m)
        assert state.velocity_ned_mps == pytest.approx(truth[3:6], abs=3e-3)
        assert state.thrust_direction_ned[:2] == pytest.approx(truth[6:8], abs=1e-3)
        assert state.thrust_direction_rate_ned_ps[:2] == pytest.approx(truth[8:10], abs=1e-2)
        assert abs(state.heading_rad) <= math.pi
        apart = math.remainder(state.heading_rad - truth[11], math.tau)
        assert apart == pytest.approx(0.0, abs=1e-3)

    send(command(0.0, 0.0, heading=math.pi))
    for period in range(60):
        watch(observer, plant)
        predicted = observer.predict(plant.time_s)
        send(command(*rng.uniform(-0.15, 0.15, 2), G + 0.1, math.pi + rng.uniform(-0.5, 0.5)))
        for step in range(10):
            if step:
                watch(observer, plant)
            if step == 5:  # the tilt's delay is 57 ms, the plant is at multiples of 1 ms
                plant.advance(0.007)
                if period >= 20:
                    compare(predicted, 2e-4)
                plant.advance(0.003)
            else:
                plant.advance(0.01)
    watch(observer, plant)
    send(command(-0.1, 0.05, heading=math.pi))
    plant.advance(0.5)
    compare(observer.predict(plant.time_s - PX4.tilt.delay_s), 4e-4)
    watch(observer, plant)
    compare(observer.predict(plant.time_s - PX4.tilt.delay_s), 4e-4)


def test_vertical_state_is_predicted_to_when_the_thrust_acts() -> None:
    """A descent at 2 m/s, delays 15 ms (thrust) and 57 ms (tilt), gives two times and heights."""
    observer, thrust = Observer(PX4), G - 1.02 * 2.0
    observer.on_command(0.0, command(0.0, 0.0, thrust))
    for i in range(301):
        feed(observer, 0.01 * i, (0.0, 0.0, 0.02 * i), (0.0, 0.0, 2.0))
    state = observer.predict(3.0)
    assert state.time_s == pytest.approx(3.057)
    assert state.position_ned_m[2] == pytest.approx(6.114, abs=1e-3)
    assert state.vertical is not None
    assert state.vertical.time_s == pytest.approx(3.015)
    assert state.vertical.position_down_m == pytest.approx(6.03, abs=1e-3)
    assert state.vertical.velocity_down_mps == pytest.approx(2.0, abs=5e-3)
    assert state.vertical.thrust_down_mps2 == pytest.approx(thrust, abs=1e-6)


# ---------------------------------------------------------------- disturbance and bias


@pytest.mark.parametrize(("gap_s", "velocity_sd_mps"), [(0.01, 1.0), (0.05, 0.005)])
def test_disturbance_and_velocity_converge_at_100_and_20_hz(
    gap_s: float, velocity_sd_mps: float
) -> None:
    """The reported velocity has a bias of up to 0.3 m/s."""
    push = np.array((0.8, -0.5, 0.4))
    truth = Truth(PX4, wind_force_ned_mps2=tuple(push))
    plant = Plant(truth)
    observer, rng = Observer(PX4, Noise(velocity_sd_mps=velocity_sd_mps)), np.random.default_rng(1)
    for i in range(round(12.0 / gap_s)):
        if i % round(0.1 / gap_s) == 0:
            sent = command(*(push[:2] / G + rng.uniform(-0.1, 0.1, 2)), G + push[2])
            plant.command(sent)
            observer.on_command(plant.time_s, sent)
        position, velocity = plant.position()
        biased = velocity + np.array([0.3, -0.2, 0.25])
        feed(observer, plant.time_s, position, biased, plant.attitude())
        state, moving = observer.predict(plant.time_s - PX4.tilt.delay_s), plant.x[3:6].copy()
        plant.advance(gap_s)
    assert state.disturbance_ned_mps2 == pytest.approx(push, abs=0.03)
    assert state.velocity_ned_mps == pytest.approx(moving, abs=0.02)


def test_hover_thrust_is_estimated_from_the_disturbance() -> None:
    """The file says u_h, the plant hovers at u_h / 0.85; the estimate is u_h (1 + d_z / g)."""
    plant = Plant(Truth(PX4, thrust_scale=0.85))
    observer, sent = Observer(PX4), command(0.0, 0.0, G / 0.85)
    plant.x[10] = G
    plant.command(sent)
    observer.on_command(0.0, sent)
    for _ in range(500):
        watch(observer, plant)
        plant.advance(0.01)
    true = PX4.hover_thrust / 0.85
    assert observer.hover_thrust_estimate == pytest.approx(true, rel=0.01)
    corrected = PX4.model_copy(update={"hover_thrust": observer.hover_thrust_estimate})
    observer.set_vehicle(corrected)
    state = observer.predict(plant.time_s)
    assert observer.hover_thrust_estimate == pytest.approx(true, rel=0.01)
    assert state.disturbance_ned_mps2[2] == pytest.approx(0.0, abs=1e-9)
    assert state.thrust_mps2 == pytest.approx(G, rel=0.01)
    assert abs(state.velocity_ned_mps[2]) < 0.01


def test_changed_drag_moves_into_the_disturbance() -> None:
    """The disturbance changes with the drag, so that the predicted acceleration stays the same."""
    observer = Observer(PX4)
    for i in range(300):
        feed(observer, 0.01 * i, (0.02 * i, -0.01 * i, -3.0), (2.0, -1.0, 0.0))
    old = observer.predict(3.0)
    observer.set_vehicle(PX4.model_copy(update={"drag_translation_npmps": (1.82, 1.82, 1.82)}))
    new = observer.predict(3.0)
    change = new.disturbance_ned_mps2 - old.disturbance_ned_mps2
    assert change == pytest.approx(0.8 * old.velocity_ned_mps, abs=0.02)
    assert new.velocity_ned_mps == pytest.approx(old.velocity_ned_mps, abs=2e-3)


# ---------------------------------------------------------------- ground, gaps, jumps


def test_prediction_spans_a_link_delay_of_2_s() -> None:
    """A level vehicle that moves at 1 m/s is slowed by its drag alone."""
    observer, drag_ps, ahead_s = Observer(PX4), PX4.drag_per_mass_ps, 2.5
    observer.on_command(0.0, LEVEL)
    feed(observer, 1.0, velocity=(1.0, 0.0, 0.0))
    state = observer.predict(1.0 + ahead_s - PX4.tilt.delay_s)
    assert state.time_s == pytest.approx(1.0 + ahead_s)
    assert state.velocity_ned_mps[0] == pytest.approx(math.exp(-drag_ps * ahead_s), rel=1e-6)
    assert state.position_ned_m[0] == pytest.approx(-math.expm1(-drag_ps * ahead_s) / drag_ps)


def test_frozen_observer_integrates_nothing() -> None:
    observer = Observer(PX4)
    observer.freeze(True)
    observer.on_command(5.0, command(0.3, 0.0, 1.5 * G))
    tilted = quaternion_from_thrust_direction(np.array([0.1, 0.0, math.sqrt(0.99)]), 0.5)
    for i in range(1, 206):
        feed(observer, 5.0 + 0.01 * i, (1.0, 2.0, -0.1), (0.2, 0.0, -0.1), tilted)
    state = observer.predict(7.05)
    assert state.position_ned_m == pytest.approx([1.0 + 0.2 * 0.057, 2.0, -0.1 - 0.1 * 0.057])
    assert state.velocity_ned_mps == pytest.approx([0.2, 0.0, -0.1])
    assert state.thrust_direction_ned == pytest.approx([0.1, 0.0, math.sqrt(0.99)])
    assert state.heading_rad == pytest.approx(0.5)
    assert np.all(state.disturbance_ned_mps2 == 0.0)
    observer.freeze(False)
    for time_s in (7.06, 7.07, 7.08):
        feed(observer, time_s, (1.0, 2.0, -0.1), (0.2, 0.0, -0.1), tilted)
    assert observer.predict(7.08).thrust_direction_ned[0] > 0.13  # now it responds to the command


def test_old_and_repeated_messages_are_dropped() -> None:
    observer = hovering()
    before = observer.predict(5.0)
    for time_s in (5.0, 4.5):  # the same stamp again, and older than the stream
        feed(observer, time_s, (0.2, 0.0, 0.0))
    after = observer.predict(5.0)
    assert np.array_equal(before.position_ned_m, after.position_ned_m)


def test_late_position_is_used_at_its_own_time() -> None:
    """A position stamped 8 ms before the newest attitude causes no error of 24 mm at 3 m/s."""
    observer, tilt = Observer(NO_DELAY), -1.02 * 3.0 / G
    observer.on_command(0.0, command(tilt, 0.0))
    b = quaternion_from_thrust_direction(np.array([tilt, 0.0, math.sqrt(1 - tilt**2)]), 0.0)
    for i in range(400):
        time_s = 0.02 * i
        observer.on_attitude(time_s + 0.008, tuple(b), STILL)
        observer.on_position(time_s, (3.0 * time_s, 0.0, 0.0), (3.0, 0.0, 0.0))
    state = observer.predict(time_s + 0.008)
    assert state.position_ned_m[0] == pytest.approx(3.0 * (time_s + 0.008), abs=1e-3)
    assert state.velocity_ned_mps[0] == pytest.approx(3.0, abs=5e-3)


def test_position_jump_causes_no_velocity_kick() -> None:
    """After a jump the next position has little effect on the velocity, because the jump says
    nothing about it. A jump of the reported velocity becomes bias."""
    kicks = []
    for position in ((2.0, -1.0, 0.0), STILL):
        observer = hovering()
        feed(observer, 5.01, position)
        state = observer.predict(5.01)
        assert state.position_ned_m == pytest.approx(position, abs=1e-6)
        assert state.velocity_ned_mps == pytest.approx([0, 0, 0], abs=1e-6)
        observer.on_position(5.02, (position[0] + 0.01, position[1], 0.0), STILL)
        kicks.append(observer.predict(5.02).velocity_ned_mps[0])
    assert 0 < kicks[0] < 0.6 * kicks[1]
    observer = hovering()
    for time_s in (5.01, 5.02):
        observer.on_position(time_s, STILL, (0.0, 2.0, 0.0))
        assert observer.predict(time_s).velocity_ned_mps == pytest.approx([0, 0, 0], abs=0.01)


def test_observer_restarts_after_a_gap_and_after_a_reboot() -> None:
    observer = Observer(NO_DELAY)
    observer.on_command(0.0, LEVEL)
    assert not observer.ready
    for i in range(600):  # a disturbance of 0.5 m/s^2 at its terminal speed
        feed(observer, 0.01 * i, (0.005 * i / 1.02, 0.0, 0.0), (0.5 / 1.02, 0.0, 0.0))
    assert observer.ready
    observer.on_position(9.0, (7, 7, -7), (1, 0, 0))  # integers
    assert not observer.ready
    observer.on_attitude(9.0, UPRIGHT, STILL)
    state = observer.predict(9.0)
    assert observer.ready
    assert state.position_ned_m == pytest.approx([7.0, 7.0, -7.0])
    assert state.velocity_ned_mps == pytest.approx([1.0, 0.0, 0.0])
    assert state.disturbance_ned_mps2[0] == pytest.approx(0.5, abs=0.05)
    feed(observer, 0.5, (4.0, 0.0, 0.0))
    state = observer.predict(0.5)
    assert (observer.ready, state.time_s, state.position_ned_m[0]) == (True, 0.5, 4.0)


def test_state_is_finite_under_any_telemetry() -> None:
    """Time stamps are irregular, repeated and decreasing, and values are random."""
    rng, observer, time_s = np.random.default_rng(11), Observer(PX4), 0.0
    for _ in range(1500):
        time_s += rng.choice([0.0, 0.001, 0.01, 0.05, 0.4, -0.02, -0.3, 1.5, -2.0])
        q, position, velocity = rng.normal(size=4), rng.normal(size=3), rng.normal(size=3)
        feed(observer, time_s, 1e3 * position, 50.0 * velocity, q / np.linalg.norm(q))
        observer.on_command(time_s, command(*rng.uniform(-0.6, 0.6, 2), rng.uniform(0, 20)))
        state = observer.predict(time_s + rng.uniform(-0.1, 0.5))
        parts = [state.position_ned_m, state.velocity_ned_mps, state.thrust_direction_ned,
                 state.thrust_direction_rate_ned_ps, state.disturbance_ned_mps2,
                 [state.heading_rad, state.thrust_mps2]]  # fmt: skip
        assert np.isfinite(np.concatenate(parts)).all()
        assert np.abs(state.disturbance_ned_mps2).max() <= 8.0
        assert np.linalg.norm(state.thrust_direction_ned[:2]) < 10


# ---------------------------------------------------------------- noise and drift


DRAG = PX4.drag_per_mass_ps
NOISE = Noise()
FIXED_DRIFT = Noise(disturbance_limit_mps2=NOISE.disturbance_mps2)


@dataclass(frozen=True)
class Hover:
    """Motion of a level vehicle that only a disturbance moves: (N, 3) in NED at `times`, SI."""

    times: Array
    positions: Array
    velocities: Array
    disturbances: Array


def hover(seconds: float, gap_s: float, seed: int, drift: float = 0.0, kicks: float = 0.0) -> Hover:
    """Integrate v' = d - c v for each axis in steps of 1 ms; d is a random walk of density `drift`
    (m/s^2 per root second), and white noise of density `kicks` (m/s per root second) drives v."""
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
    """Feed an observer with `flown` and white noise of the sds `white` on position (m) and velocity
    (m/s). Return it with its estimates of position and disturbance (N, 3)."""
    rng = np.random.default_rng(99)
    observer = Observer(NO_DELAY, noise)
    observer.on_command(0.0, LEVEL)
    positions, disturbances = np.empty_like(flown.positions), np.empty_like(flown.positions)
    if adopted:
        observer.set_vehicle(NO_DELAY)
    for i, time_s in enumerate(flown.times.tolist()):
        position = flown.positions[i] + white[0] * rng.standard_normal(3)
        velocity = flown.velocities[i] + white[1] * rng.standard_normal(3)
        feed(observer, time_s, position, velocity)
        state = observer.predict(time_s)
        positions[i] = state.position_ned_m
        disturbances[i] = state.disturbance_ned_mps2
    return observer, positions, disturbances


def noise_sds(observer: Observer) -> Array:
    """Estimated sds of the noise of position (m) and reported velocity (m/s), (2,)."""
    return np.sqrt(observer.estimated.variances)


def rms(errors: Array) -> float:
    """The RMS of the second half of the rows, per axis."""
    return float(np.sqrt(np.mean(errors[-round(0.5 * len(errors)) :] ** 2)))


@pytest.mark.parametrize("gap_s", [0.008, 0.05])
def test_white_noise_is_measured_and_filtered(gap_s: float) -> None:
    """Noise of 2 cm and 5 cm/s on a drifting hover is estimated within a quarter, at 125 and 20 Hz.
    At 125 Hz at most 0.6 cm per sample is left; with the configured R, 2 mm, it is 1 cm."""
    flown = hover(25.0, gap_s, seed=1, drift=0.1)
    observer, adapted, _ = observe(flown, white=(0.02, 0.05))
    assert noise_sds(observer)[0] == pytest.approx(0.02, rel=0.25)
    assert noise_sds(observer)[1] == pytest.approx(0.05, rel=0.25)
    if gap_s == 0.008:
        assert rms(adapted - flown.positions) < 0.006


def test_wandering_estimate_counts_as_neither_noise_nor_gusts() -> None:
    """The velocity walks as that of PX4's estimate (0.2 m/s per root second) and is smooth from
    sample to sample. No noise of the position is found; a third of the variance of the walk,
    0.0103 m/s, is taken for noise of the velocity. Two seeds."""
    for seed in (3, 4):
        observer, _, _ = observe(hover(20.0, 0.008, seed=seed, kicks=0.2))
        assert noise_sds(observer)[0] == NOISE.position_sd_m
        assert noise_sds(observer)[1] < 0.011
        floor = NOISE.disturbance_mps2
        assert observer.estimated.drift_mps2 == pytest.approx([floor, floor], rel=0.3)


def test_adaptive_observer_follows_gusts_faster() -> None:
    """While the disturbance drifts by 0.7 m/s^2 per root second, both estimated densities grow, the
    vertical one only once the thrust is identified; afterwards they fall. The error of the
    disturbance is less than 0.7 of the error with the configured density."""
    flown = hover(20.0, 0.01, seed=6, drift=0.7)
    _, _, fixed = observe(flown, FIXED_DRIFT)
    early, _, _ = observe(flown, adopted=False)
    assert early.estimated.drift_mps2[1] == NOISE.disturbance_mps2
    assert early.estimated.drift_mps2[0] > 0.5
    observer, _, adapted = observe(flown)
    assert min(observer.estimated.drift_mps2) > 0.5
    assert rms(adapted - flown.disturbances) < 0.7 * rms(fixed - flown.disturbances)
    for i in range(2000):
        feed(observer, 20.0 + 0.01 * i, flown.positions[-1])
    assert observer.estimated.drift_mps2 == pytest.approx([0.15, 0.15])


def test_jumps_are_not_noise_and_do_not_hide_gusts() -> None:
    """The estimator resets its position fifteen times by 2 m in 15 s of gusts."""
    flown = hover(15.0, 0.01, seed=9, drift=0.7)
    jumps = 2.0 * np.cumsum(np.arange(len(flown.times)) % 100 == 50)[:, None]
    observer, _, _ = observe(Hover(flown.times, flown.positions + jumps, *[flown.velocities] * 2))
    assert noise_sds(observer)[0] == NOISE.position_sd_m
    assert observer.estimated.drift_mps2[0] > 0.5


def test_noise_estimates_are_bounded_and_cleared_by_a_reset() -> None:
    noise = replace(NOISE, disturbance_limit_mps2=0.4)
    observer, _, _ = observe(hover(15.0, 0.01, seed=10, drift=2.0), noise, (0.05, 0.0))
    assert noise_sds(observer)[0] > 0.03
    assert max(observer.estimated.drift_mps2) <= 0.4
    observer.reset()
    assert noise_sds(observer) == pytest.approx(START_SDS)
    assert observer.estimated.drift_mps2 == pytest.approx([0.15, 0.15])


def test_positions_older_than_the_attitude_keep_the_noise_finite() -> None:
    """Two positions arrive after a newer attitude, so that the state has the same time at both."""
    observer = Observer(NO_DELAY, NOISE)
    observer.on_command(0.0, LEVEL)
    for i in range(200):
        time_s = 0.04 * i
        observer.on_attitude(time_s + 0.05, UPRIGHT, STILL)
        observer.on_position(time_s, (1e-4 * (i % 3), 0.0, -2.0), STILL)
        observer.on_position(time_s + 0.02, (1e-4 * (i % 2), 0.0, -2.0), STILL)
    assert np.isfinite(noise_sds(observer)).all()
    assert np.isfinite(observer.predict(8.0).position_ned_m).all()
