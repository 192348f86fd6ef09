"""Flatness against the dynamics integrated and rotations by SciPy, and a circle by hand."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from offboard.model.frames import quaternion_from_thrust_direction
from offboard.reference.base import FlatSample
from offboard.reference.flatness import FlatState, flat_state
from offboard.reference.shapes import SHAPES
from offboard.reference.track import Track

Array = NDArray[np.float64]

GRAVITY = 9.80665
DRAG = 1.02
WIND = np.array([0.7, -0.4, 0.2])
POINTS = [[0, 0, 0], [3, 1, 0.5], [4, 4, 1], [1, 5, 0.5]]
SETTINGS: dict[str, dict[str, object]] = {
    "line": {"to_north_m": 8, "to_east_m": 6, "climb_m": 2},
    "circle": {"course_deg": 140.0},
    "lemniscate": {"laps": 1},
    "helix": {"laps": 1, "climb_mps": 1.0},
    "waypoints": {"points_m": POINTS, "speed_mps": 1.5},
}
every_shape = pytest.mark.parametrize("shape", SETTINGS)
every_heading = pytest.mark.parametrize("heading", ["fixed", "along_velocity"])


def track_of(shape: str, heading: str) -> Track:
    return SHAPES[shape](**{"course": heading} | SETTINGS[shape]).track()


def state_of(track: Track, time_s: float | Array) -> FlatState:
    return flat_state(track.sample(time_s), GRAVITY, DRAG, WIND)


@every_shape
def test_thrust_along_b_flies_the_trajectory(shape: str) -> None:
    track = track_of(shape, "fixed")

    def dynamics(time_s: float, state: Array) -> Array:
        flat = state_of(track, time_s)
        thrust = float(flat.thrust_mps2) * flat.thrust_direction_ned
        acceleration = np.array([0, 0, GRAVITY]) - thrust - DRAG * state[3:] + WIND
        return np.concatenate([state[3:], acceleration])

    start = np.concatenate([track.sample(0.0).position_ned_m, np.zeros(3)])
    times = np.linspace(0.0, track.duration_s, 50)
    flown = solve_ivp(
        dynamics, (0.0, track.duration_s), start, t_eval=times, rtol=1e-8, atol=1e-9, max_step=0.2
    )
    expected = track.sample(times)
    np.testing.assert_allclose(flown.y[:3].T, expected.position_ned_m, atol=2e-5)
    np.testing.assert_allclose(flown.y[3:].T, expected.velocity_ned_mps, atol=2e-5)


@every_shape
@every_heading
def test_rates_turn_the_attitude(shape: str, heading: str) -> None:
    """Body rates are the rotation vector from one attitude to the next, by SciPy; b is its z."""
    track = track_of(shape, heading)
    times = np.linspace(0.1, track.duration_s - 0.1, 400)
    half = 1e-4
    middle, before, after = (state_of(track, times + shift) for shift in (0.0, -half, half))
    headings = [track.sample(times + shift).heading_rad for shift in (0.0, -half, half)]
    attitude, earlier, later = (
        Rotation.from_quat(
            quaternion_from_thrust_direction(state.thrust_direction_ned, heading_rad),
            scalar_first=True,
        )
        for state, heading_rad in zip((middle, before, after), headings, strict=True)
    )
    np.testing.assert_allclose(
        attitude.apply([0.0, 0.0, 1.0]), middle.thrust_direction_ned, atol=1e-12
    )
    nose = attitude.apply([1.0, 0.0, 0.0])
    off = np.arctan2(nose[:, 1], nose[:, 0]) - headings[0]
    np.testing.assert_allclose(np.sin(off), 0.0, atol=1e-9)
    assert np.all(np.cos(off) > 0.0)
    turn = earlier.inv() * later
    np.testing.assert_allclose(turn.as_rotvec() / (2 * half), middle.rates_frd_radps, atol=2e-6)


@every_shape
def test_derivatives_of_thrust_and_direction(shape: str) -> None:
    """By central differences, each from the one below it."""
    track, h = track_of(shape, "fixed"), 1e-4
    times = np.linspace(0.1, track.duration_s - 0.1, 400)
    before, here, after = (state_of(track, times + k * h) for k in (-1, 0, 1))
    for name, derivative, near in (
        ("thrust_direction_ned", "thrust_direction_rate_ned_ps", 1e-6),
        ("thrust_direction_rate_ned_ps", "thrust_direction_acceleration_ned_ps2", 1e-4),
        ("thrust_mps2", "thrust_rate_mps3", 1e-6),
    ):
        slope = (getattr(after, name) - getattr(before, name)) / (2 * h)
        np.testing.assert_allclose(getattr(here, derivative), slope, atol=near)
    assert np.abs(here.thrust_direction_acceleration_ned_ps2).max() > 0.05  # it does move


def test_free_fall_and_knife_edge_stay_finite() -> None:
    zero = np.zeros(3)
    for acceleration in ([0, 0, GRAVITY], [GRAVITY, 0, GRAVITY], [0, 9.0, GRAVITY], [0, 0, 30.0]):
        sample = FlatSample(
            zero, zero, np.array(acceleration, dtype=float), np.ones(3), np.ones(3),
            np.array(0.0), np.array(1.0), np.array(0.0),
        )  # fmt: skip
        flat = flat_state(sample, GRAVITY, 0.0)
        for name in (*FlatState.__slots__, "rates_frd_radps"):
            assert np.all(np.isfinite(getattr(flat, name))), (acceleration, name)
        assert np.linalg.norm(flat.thrust_direction_ned) == pytest.approx(1.0)
