"""Flatness against the dynamics integrated and rotations by SciPy, and a circle by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from offboard.model.frames import quaternion_from_thrust_direction
from offboard.reference.base import FlatSample
from offboard.reference.flatness import FlatState, flat_state
from offboard.reference.shapes import SHAPES, Circle, HeadingMode, Hover
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
    track = track_of(shape, "fixed")
    times = np.linspace(0.1, track.duration_s - 0.1, 400)
    h = 1e-3
    states = [state_of(track, times + k * h) for k in (-2, -1, 0, 1, 2)]
    b = [state.thrust_direction_ned for state in states]
    first = (b[0] - 8 * b[1] + 8 * b[3] - b[4]) / (12 * h)
    second = (-b[0] + 16 * b[1] - 30 * b[2] + 16 * b[3] - b[4]) / (12 * h * h)
    thrust = [state.thrust_mps2 for state in states]
    thrust_rate = (thrust[0] - 8 * thrust[1] + 8 * thrust[3] - thrust[4]) / (12 * h)
    np.testing.assert_allclose(states[2].thrust_direction_rate_ned_ps, first, atol=1e-6)
    np.testing.assert_allclose(states[2].thrust_direction_acceleration_ned_ps2, second, atol=1e-4)
    np.testing.assert_allclose(states[2].thrust_rate_mps3, thrust_rate, atol=1e-6)
    assert np.abs(second).max() > 0.05  # it does move


def test_a_level_circle_by_hand() -> None:
    """Steady circle without drag: T = hypot(g, v^2/r), tilt atan(v^2 / (r g)) inwards, and with
    the nose along the velocity p = 0, q and r the parts of the turn about the vertical."""
    radius, period = 2.0, 8.0
    track = Circle(course=HeadingMode.ALONG_VELOCITY).track()
    omega = 2 * math.pi / period
    inward = omega**2 * radius
    flat = flat_state(track.sample(9.3), GRAVITY, 0.0)
    tilt = math.atan2(inward, GRAVITY)
    assert float(flat.thrust_mps2) == pytest.approx(math.hypot(GRAVITY, inward), rel=1e-12)
    assert float(flat.thrust_rate_mps3) == pytest.approx(0.0, abs=1e-12)
    assert float(flat.thrust_direction_ned[2]) == pytest.approx(math.cos(tilt), rel=1e-12)
    # clockwise: banked to the right
    np.testing.assert_allclose(
        flat.rates_frd_radps, [0.0, omega * math.sin(tilt), omega * math.cos(tilt)], atol=1e-12
    )


def test_hover_in_a_disturbance_leans_against_it() -> None:
    track = Hover().track()
    flat = flat_state(track.sample(1.0), GRAVITY, DRAG, WIND)
    force = np.array([0, 0, GRAVITY]) + WIND
    assert float(flat.thrust_mps2) == pytest.approx(np.linalg.norm(force))
    np.testing.assert_allclose(flat.thrust_direction_ned, force / np.linalg.norm(force))
    assert np.all(flat.rates_frd_radps == 0.0)


def test_array_equals_loop_and_shapes() -> None:
    track = track_of("helix", "along_velocity")
    times = np.linspace(0.0, track.duration_s, 12).reshape(3, 4)
    batch = state_of(track, times)
    assert batch.thrust_direction_ned.shape == (3, 4, 3)
    for index in np.ndindex(3, 4):
        single = state_of(track, float(times[index]))
        assert single.thrust_mps2.shape == ()
        assert single.rates_frd_radps.shape == (3,)
        for name in (*FlatState.__slots__, "rates_frd_radps"):
            np.testing.assert_allclose(
                getattr(batch, name)[index], getattr(single, name), rtol=1e-12, atol=1e-13
            )


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
