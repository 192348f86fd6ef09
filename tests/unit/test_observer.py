"""The observer against an independent plant, SciPy's integrator and the gains measured on PX4."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
from attitude_plant import Plant, Truth
from scipy.integrate import solve_ivp

from offboard.estimation.motion import COMMAND_SIZE, STATE_SIZE, THRUST, plant_of, propagate
from offboard.estimation.noise import Noise
from offboard.estimation.observer import Observer
from offboard.model.command import Command, PredictedState
from offboard.model.frames import quaternion_from_thrust_direction
from offboard.model.vehicle import AxisResponse, Vehicle

G = 9.80665
LEVEL = Command(G, (0.0, 0.0, 1.0), 0.0)
UPRIGHT = (1.0, 0.0, 0.0, 0.0)
STILL = (0.0, 0.0, 0.0)
PX4 = Vehicle(
    name="px4",
    mass_kg=1.0,
    inertia_kgm2=(0.025, 0.025, 0.03),
    drag_translation_npmps=(1.02, 1.02, 1.02),
    drag_rotation_nmpradps=(0.02, 0.02, 0.02),
    hover_thrust=0.4895,
    thrust_delay_s=0.015,
    thrust_lag_s=0.05,
    tilt=AxisResponse(delay_s=0.057, natural_frequency_radps=11.4, damping=0.56),
    yaw=AxisResponse(delay_s=0.148, natural_frequency_radps=3.1, damping=0.4),
)
NO_DELAY = PX4.model_copy(update={"tilt": PX4.tilt.model_copy(update={"delay_s": 0.0})})


def command(north: float, east: float, thrust: float = G, heading: float = 0.0) -> Command:
    return Command(thrust, (north, east, math.sqrt(1 - north**2 - east**2)), heading)


def hovering(
    noise: Noise | None = None, until_s: float = 5.0, vehicle: Vehicle = NO_DELAY
) -> Observer:
    """An observer after a perfect hover with telemetry every 10 ms."""
    observer = Observer(vehicle, noise)
    observer.on_command(0.0, LEVEL)
    for i in range(round(until_s / 0.01) + 1):
        observer.on_attitude(0.01 * i, UPRIGHT, STILL)
        observer.on_position(0.01 * i, STILL, STILL)
    return observer


def follow(
    plant: Plant,
    observer: Observer,
    seconds: float,
    seed: int,
    gap_s: float = 0.01,
    about_rad: float = 0.0,
) -> list[tuple[PredictedState, np.ndarray]]:
    """Random tilt, and heading `about_rad`, at 10 Hz to both; predictions and what the plant then
    was."""
    rng = np.random.default_rng(seed)
    pairs, pending = [], []
    for i in range(round(seconds / gap_s)):
        now = plant.time_s
        observer.on_attitude(now, plant.attitude(), STILL)
        observer.on_position(now, *plant.position())
        if i % round(0.1 / gap_s) == 0:
            pending.append(observer.predict(now))
            heading = about_rad + rng.uniform(-0.5, 0.5)
            sent = command(*rng.uniform(-0.15, 0.15, 2), G + 0.1, heading)
            plant.command(sent)
            observer.on_command(now, replace(sent, heading_rad=math.remainder(heading, math.tau)))
        # the plant is at multiples of 1 ms, so is the delay
        target = pending[-1].time_s if pending else math.inf
        if now < target <= now + gap_s + 1e-9:
            plant.advance(target - now)
            pairs.append((pending.pop(), plant.x.copy()))
            plant.advance(now + gap_s - target)
        else:
            plant.advance(gap_s)
    return pairs


# ---------------------------------------------------------------- gains and motion


def test_steady_gains_equal_those_flown_on_px4() -> None:
    """Per 10 ms with the velocity ignored (its sd 1 m/s): p .36, v 7.87, d 5.97 from position;
    b .62, b' 28.2 from b. Found by disturbing one message by a little."""
    noise = Noise(velocity_sd_mps=1.0)
    small = 1e-5

    def after(position: float, tilt: float) -> PredictedState:
        observer = hovering(noise, until_s=20.0)
        direction = np.array([tilt, 0.0, math.sqrt(1 - tilt**2)])
        observer.on_attitude(20.01, quaternion_from_thrust_direction(direction, 0.0), STILL)
        observer.on_position(20.01, (position, 0.0, 0.0), STILL)
        return observer.predict(20.01)

    at_rest, moved, tilted = after(0, 0), after(small, 0), after(0, small)
    gains = [
        (moved.position_ned_m - at_rest.position_ned_m)[0] / small,
        (moved.velocity_ned_mps - at_rest.velocity_ned_mps)[0] / small,
        (moved.disturbance_ned_mps2 - at_rest.disturbance_ned_mps2)[0] / small,
        (tilted.thrust_direction_ned - at_rest.thrust_direction_ned)[0] / small,
        (tilted.thrust_direction_rate_ned_ps - at_rest.thrust_direction_rate_ned_ps)[0] / small,
    ]
    assert gains == pytest.approx([0.36, 7.87, 5.97, 0.62, 28.2], rel=0.01)


@pytest.mark.parametrize("damping", [0.56, 1.115])
def test_replay_agrees_with_scipy(damping: float) -> None:
    """One second under five commands, each axis with its own delay, against DOP853 restarted at
    every switch."""
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


@pytest.mark.parametrize("about_rad", [0.0, math.pi, -math.pi])
def test_prediction_is_exact_on_a_matching_plant(about_rad: float) -> None:
    """Facing south, heading, its telemetry and its commands are now on one side of the wrap, now on
    the other. After a gap of half a second the state is right at once."""
    plant = Plant(Truth(PX4, noisy=False), np.random.default_rng(0))
    plant.x[11] = about_rad
    plant.command(replace(LEVEL, heading_rad=about_rad))
    observer = Observer(PX4)
    observer.on_command(0.0, replace(LEVEL, heading_rad=about_rad))
    pairs = follow(plant, observer, 6.0, seed=5, about_rad=about_rad)[20:]
    assert len(pairs) > 30
    sent = command(-0.1, 0.05, heading=about_rad)
    plant.command(sent)
    observer.on_command(plant.time_s, sent)
    plant.advance(0.5)
    pairs.append((observer.predict(plant.time_s - PX4.tilt.delay_s), plant.x.copy()))
    observer.on_attitude(plant.time_s, plant.attitude(), STILL)
    observer.on_position(plant.time_s, *plant.position())
    pairs.append((observer.predict(plant.time_s - PX4.tilt.delay_s), plant.x.copy()))
    for number, (state, truth) in enumerate(pairs):
        near_m = 2e-4 if number < len(pairs) - 2 else 4e-4  # after the gap
        assert state.position_ned_m == pytest.approx(truth[:3], abs=near_m)
        assert state.velocity_ned_mps == pytest.approx(truth[3:6], abs=3e-3)
        assert state.thrust_direction_ned[:2] == pytest.approx(truth[6:8], abs=1e-3)
        assert state.thrust_direction_rate_ned_ps[:2] == pytest.approx(truth[8:10], abs=1e-2)
        assert abs(state.heading_rad) <= math.pi
        apart = math.remainder(state.heading_rad - truth[11], math.tau)
        assert apart == pytest.approx(0.0, abs=1e-3)


def test_vertical_is_predicted_to_the_time_when_the_thrust_acts() -> None:
    """Falling at 2 m/s with thrust delay 15 ms, tilt delay 57 ms: two times, two heights."""
    observer = Observer(PX4)
    thrust = G - 1.02 * 2.0
    observer.on_command(0.0, command(0.0, 0.0, thrust))
    for i in range(301):
        observer.on_attitude(0.01 * i, UPRIGHT, STILL)
        observer.on_position(0.01 * i, (0.0, 0.0, 0.02 * i), (0.0, 0.0, 2.0))
    state = observer.predict(3.0)
    assert state.time_s == pytest.approx(3.057)
    assert state.position_ned_m[2] == pytest.approx(6.114, abs=1e-3)
    assert state.heave is not None
    assert state.heave.time_s == pytest.approx(3.015)
    assert state.heave.position_down_m == pytest.approx(6.03, abs=1e-3)
    assert state.heave.velocity_down_mps == pytest.approx(2.0, abs=5e-3)
    assert state.heave.thrust_down_mps2 == pytest.approx(thrust, abs=1e-6)


# ---------------------------------------------------------------- disturbance and bias


@pytest.mark.parametrize(("gap_s", "velocity_sd_mps"), [(0.01, 1.0), (0.033, 0.005), (0.05, 0.005)])
def test_disturbance_and_velocity_converge_at_any_rate(
    gap_s: float, velocity_sd_mps: float
) -> None:
    push = (0.8, -0.5, 0.4)
    plant = Plant(Truth(PX4, wind_force_ned_mps2=push, noisy=False), np.random.default_rng(0))
    observer = Observer(PX4, Noise(velocity_sd_mps=velocity_sd_mps))
    rng = np.random.default_rng(1)
    for i in range(round(12.0 / gap_s)):
        now = plant.time_s
        if i % round(0.1 / gap_s) == 0:
            sent = command(*(np.array(push[:2]) / G + rng.uniform(-0.1, 0.1, 2)), G + push[2])
            plant.command(sent)
            observer.on_command(now, sent)
        observer.on_attitude(now, plant.attitude(), STILL)
        position, velocity = plant.position()
        observer.on_position(now, position, velocity + np.array([0.3, -0.2, 0.25]))
        state = observer.predict(now - PX4.tilt.delay_s)
        truth = plant.x.copy()
        plant.advance(gap_s)
    assert state.disturbance_ned_mps2 == pytest.approx(push, abs=0.03)
    assert state.velocity_ned_mps == pytest.approx(truth[3:6], abs=0.02)


@pytest.mark.parametrize("scale", [0.85, 1.15])
def test_hover_thrust_is_estimated_from_the_disturbance(scale: float) -> None:
    """The vehicle file has a hover thrust of u_h, the plant u_h / scale: u_h (1 + d_z / g)."""
    plant = Plant(Truth(PX4, thrust_scale=scale, noisy=False), np.random.default_rng(0))
    observer = Observer(PX4)
    sent = command(0.0, 0.0, G / scale)
    plant.x[10] = G
    plant.command(sent)
    observer.on_command(0.0, sent)
    for _ in range(500):
        observer.on_attitude(plant.time_s, plant.attitude(), STILL)
        observer.on_position(plant.time_s, *plant.position())
        plant.advance(0.01)
    assert observer.hover_thrust_estimate == pytest.approx(PX4.hover_thrust / scale, rel=0.01)

    corrected = PX4.model_copy(update={"hover_thrust": observer.hover_thrust_estimate})
    observer.set_vehicle(corrected)
    state = observer.predict(plant.time_s)
    assert observer.hover_thrust_estimate == pytest.approx(PX4.hover_thrust / scale, rel=0.01)
    assert state.disturbance_ned_mps2[2] == pytest.approx(0.0, abs=1e-9)
    assert state.thrust_mps2 == pytest.approx(G, rel=0.01)
    assert abs(state.velocity_ned_mps[2]) < 0.01


def test_observer_goes_on_smoothly_with_another_drag() -> None:
    """The predicted acceleration stays the same: the disturbance changes with the drag."""
    observer = Observer(PX4)
    for i in range(300):
        observer.on_attitude(0.01 * i, UPRIGHT, STILL)
        observer.on_position(0.01 * i, (0.02 * i, -0.01 * i, -3.0), (2.0, -1.0, 0.0))
    old = observer.predict(3.0)
    observer.set_vehicle(PX4.model_copy(update={"drag_translation_npmps": (1.82, 1.82, 1.82)}))
    new = observer.predict(3.0)
    change = new.disturbance_ned_mps2 - old.disturbance_ned_mps2
    assert change == pytest.approx(0.8 * old.velocity_ned_mps, abs=0.02)
    assert new.velocity_ned_mps == pytest.approx(old.velocity_ned_mps, abs=2e-3)


# ---------------------------------------------------------------- ground, gaps, jumps


def test_frozen_observer_integrates_nothing() -> None:
    observer = hovering(vehicle=PX4)
    observer.freeze(True)
    observer.on_command(5.0, command(0.3, 0.0, 1.5 * G))
    tilted = quaternion_from_thrust_direction(np.array([0.1, 0.0, math.sqrt(0.99)]), 0.5)
    for i in range(1, 200):
        observer.on_attitude(5.0 + 0.01 * i, tuple(tilted), STILL)
        observer.on_position(5.0 + 0.01 * i, (1.0, 2.0, -0.1), (0.2, 0.0, -0.1))
    observer.on_attitude(7.05, tuple(tilted), STILL)
    state = observer.predict(7.05)
    assert state.position_ned_m == pytest.approx([1.0 + 0.2 * 0.057, 2.0, -0.1 - 0.1 * 0.057])
    assert state.velocity_ned_mps == pytest.approx([0.2, 0.0, -0.1])
    assert state.thrust_direction_ned == pytest.approx([0.1, 0.0, math.sqrt(0.99)])
    assert state.heading_rad == pytest.approx(0.5)
    assert np.all(state.disturbance_ned_mps2 == 0.0)
    observer.freeze(False)
    for message in (1, 2, 3):
        observer.on_attitude(7.05 + 0.01 * message, tuple(tilted), STILL)
        observer.on_position(7.05 + 0.01 * message, (1.0, 2.0, -0.1), (0.2, 0.0, -0.1))
    assert observer.predict(7.08).thrust_direction_ned[0] > 0.13  # now it responds to the command


def test_old_and_repeated_messages_are_dropped() -> None:
    observer = hovering()
    before = observer.predict(5.0)
    observer.on_position(5.0, (0.2, 0.0, 0.0), STILL)  # the same stamp again
    observer.on_attitude(4.95, UPRIGHT, STILL)  # older than the stream
    observer.on_position(4.5, (0.2, 0.0, 0.0), STILL)
    after = observer.predict(5.0)
    assert np.array_equal(before.position_ned_m, after.position_ned_m)


def test_position_older_than_the_attitude_is_used_at_its_own_time() -> None:
    """Position stamped 8 ms before the newest attitude, at 3 m/s: no error of 24 mm."""
    observer = Observer(NO_DELAY)
    observer.on_command(0.0, command(-1.02 * 3.0 / G, 0.0))
    tilt = -1.02 * 3.0 / G
    b = quaternion_from_thrust_direction(np.array([tilt, 0.0, math.sqrt(1 - tilt**2)]), 0.0)
    for i in range(400):
        time_s = 0.02 * i
        observer.on_attitude(time_s + 0.008, tuple(b), STILL)
        observer.on_position(time_s, (3.0 * time_s, 0.0, 0.0), (3.0, 0.0, 0.0))
    state = observer.predict(time_s + 0.008)
    assert state.position_ned_m[0] == pytest.approx(3.0 * (time_s + 0.008), abs=1e-3)
    assert state.velocity_ned_mps[0] == pytest.approx(3.0, abs=5e-3)


def test_a_jump_is_followed_without_a_velocity_kick() -> None:
    """A position that jumps, and a velocity, which becomes bias. The next position has little
    effect: the jump says nothing of the velocity."""
    kicks = []
    for position in ((2.0, -1.0, 0.0), STILL):
        observer = hovering()
        observer.on_attitude(5.01, UPRIGHT, STILL)
        observer.on_position(5.01, position, STILL)
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


def test_restart_after_a_long_gap_keeps_the_disturbance_and_after_a_reboot_the_clock() -> None:
    observer = Observer(NO_DELAY)
    observer.on_command(0.0, LEVEL)
    assert not observer.ready
    for i in range(600):
        observer.on_attitude(0.01 * i, UPRIGHT, STILL)
        lateral = 0.5 * 0.01 * i / 1.02  # a push of .5 at its terminal speed
        observer.on_position(0.01 * i, (lateral, 0.0, 0.0), (0.5 / 1.02, 0.0, 0.0))
    assert observer.ready
    observer.on_position(9.0, (7, 7, -7), (1, 0, 0))  # integers
    assert not observer.ready
    observer.on_attitude(9.0, UPRIGHT, STILL)
    state = observer.predict(9.0)
    assert observer.ready
    assert state.position_ned_m == pytest.approx([7.0, 7.0, -7.0])
    assert state.velocity_ned_mps == pytest.approx([1.0, 0.0, 0.0])
    assert state.disturbance_ned_mps2[0] == pytest.approx(0.5, abs=0.05)
    observer.on_attitude(0.5, UPRIGHT, STILL)
    observer.on_position(0.5, (4.0, 0.0, 0.0), STILL)
    state = observer.predict(0.5)
    assert observer.ready
    assert state.time_s == 0.5
    assert state.position_ned_m[0] == 4.0


def test_state_is_finite_under_any_telemetry() -> None:
    """Irregular, repeated and decreasing stamps, random values."""
    rng = np.random.default_rng(11)
    observer = Observer(PX4)
    time_s = 0.0
    for _ in range(3000):
        time_s += rng.choice([0.0, 0.001, 0.01, 0.05, 0.4, -0.02, -0.3, 1.5, -2.0])
        q = rng.normal(size=4)
        observer.on_attitude(time_s, tuple(q / np.linalg.norm(q)), tuple(rng.normal(size=3)))
        observer.on_position(
            time_s, tuple(rng.normal(size=3) * 1e3), tuple(rng.normal(size=3) * 50)
        )
        observer.on_command(time_s, command(*rng.uniform(-0.6, 0.6, 2), rng.uniform(0, 20)))
        state = observer.predict(time_s + rng.uniform(-0.1, 0.5))
        parts = [state.position_ned_m, state.velocity_ned_mps, state.thrust_direction_ned,
                 state.thrust_direction_rate_ned_ps, state.disturbance_ned_mps2]  # fmt: skip
        assert all(np.isfinite(part).all() for part in parts)
        assert np.abs(state.disturbance_ned_mps2).max() <= 8.0
        assert math.isfinite(state.heading_rad)
        assert math.isfinite(state.thrust_mps2)
        assert np.linalg.norm(state.thrust_direction_ned[:2]) < 10
