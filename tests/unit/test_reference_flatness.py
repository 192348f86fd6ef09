"""Differential flatness against SciPy's integrator and rotations; a reference that a vehicle cannot
fly is refused with time, value and limit."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from offboard.documents.errors import DocumentError
from offboard.model.frames import quaternion_from_thrust_direction
from offboard.model.vehicle import Vehicle
from offboard.reference.base import FlatSample
from offboard.reference.feasibility import check
from offboard.reference.flatness import FlatState, body_rates, flat_state
from offboard.reference.shapes import SHAPES
from offboard.reference.track import Track, hold
from offboard.run.configuration import build_track, load

Array = NDArray[np.float64]

GRAVITY = 9.80665
DRAG = 1.02
WIND = np.array([0.7, -0.4, 0.2])


def track(**settings: object) -> Track:
    return SHAPES[str(settings["shape"])](**settings).track()


TRACKS = (
    track(shape="lemniscate", laps=1, course_deg=140.0),
    track(shape="helix", laps=1, climb_mps=1.0, course="along_velocity"),
)


def state_of(track: Track, time_s: float | Array) -> FlatState:
    return flat_state(track.sample(time_s), GRAVITY, DRAG, WIND)


@pytest.mark.parametrize("flown", TRACKS)
def test_flat_thrust_reproduces_the_trajectory(flown: Track) -> None:
    def dynamics(time_s: float, state: Array) -> Array:
        flat = state_of(flown, time_s)
        thrust = float(flat.thrust_mps2) * flat.thrust_direction_ned
        acceleration = np.array([0, 0, GRAVITY]) - thrust - DRAG * state[3:] + WIND
        return np.concatenate([state[3:], acceleration])

    start = np.concatenate([flown.sample(0.0).position_ned_m, np.zeros(3)])
    times = np.linspace(0.0, flown.duration_s, 50)
    moved = solve_ivp(
        dynamics, (0.0, flown.duration_s), start, t_eval=times, rtol=1e-8, atol=1e-9, max_step=0.2
    )
    expected = flown.sample(times)
    np.testing.assert_allclose(moved.y[:3].T, expected.position_ned_m, atol=2e-5)
    np.testing.assert_allclose(moved.y[3:].T, expected.velocity_ned_mps, atol=2e-5)


@pytest.mark.parametrize("flown", TRACKS)
def test_body_rates_agree_with_the_attitude(flown: Track) -> None:
    """Body rates agree with SciPy's rotation vector from one attitude to the next, b with its z
    axis, and the rate of the thrust with a central difference."""
    times = np.linspace(0.1, flown.duration_s - 0.1, 400)
    half = 1e-4
    middle, before, after = (state_of(flown, times + shift) for shift in (0.0, -half, half))
    headings = [flown.sample(times + shift).heading_rad for shift in (0.0, -half, half)]
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
    rise = (after.thrust_mps2 - before.thrust_mps2) / (2 * half)
    np.testing.assert_allclose(rise, middle.thrust_rate_mps3, atol=2e-6)
    turn, rates = earlier.inv() * later, body_rates(flown.sample(times), middle)
    np.testing.assert_allclose(turn.as_rotvec() / (2 * half), rates, atol=2e-6)


def test_free_fall_and_knife_edge_stay_finite() -> None:
    zero = np.zeros(3)
    for acceleration in ([0, 0, GRAVITY], [GRAVITY, 0, GRAVITY], [0, 9.0, GRAVITY], [0, 0, 30.0]):
        sample = FlatSample(
            zero, zero, np.array(acceleration, dtype=float), np.ones(3), np.ones(3),
            np.array(0.0), np.array(1.0), np.array(0.0),
        )  # fmt: skip
        flat = flat_state(sample, GRAVITY, 0.0)
        for name in FlatState.__slots__:
            assert np.all(np.isfinite(getattr(flat, name))), (acceleration, name)
        assert np.all(np.isfinite(body_rates(sample, flat))), acceleration
        assert np.linalg.norm(flat.thrust_direction_ned) == pytest.approx(1.0)


def vehicle(**changes: object) -> Vehicle:
    response = {"delay_s": 0.05, "natural_frequency_radps": 11, "damping": 0.6}
    values = {
        "name": "test", "mass_kg": 1.0, "gravity_mps2": 9.8, "inertia_kgm2": [0.02, 0.02, 0.03],
        "drag_translation_npmps": [0, 0, 0], "drag_rotation_nmpradps": [0, 0, 0],
        "hover_thrust": 0.5, "tilt": response, "yaw": response, "tilt_max_rad": 0.7,
    }  # fmt: skip
    return Vehicle.model_validate(values | changes)


def test_circle_agrees_with_closed_forms() -> None:
    """Tilt, height and distance are closed forms; a circle beyond a limit is refused."""
    inward = (2 * math.pi / 8) ** 2 * 2.0
    flown = track(shape="circle", radius_m=2.0, period_s=8.0, run_in_s=30, run_out_s=30)
    reached = math.atan2(inward, 9.8), 3.0, 2.0
    assert check(flown, vehicle()) == pytest.approx(reached, rel=1e-3)
    thrust_mps2 = math.hypot(9.8, inward)
    with pytest.raises(ValueError, match=r"rate of .* beyond the limit of 0.05 rad/s"):
        check(flown, vehicle(angular_rate_limit_radps=(0.05, 0.05, 0.05)))
    with pytest.raises(ValueError, match=f"a thrust of {thrust_mps2:.3g} m"):
        check(flown, vehicle(hover_thrust=0.95 * 9.8 / (0.999 * thrust_mps2)))


UP = {"shape": "line", "to_north_m": 0, "speed_mps": 10, "run_out_s": 6, "height_m": 100}


@pytest.mark.parametrize(
    ("settings", "what", "limit"),
    [
        ({"shape": "circle", "period_s": 4.0}, "a tilt of", "0.4 rad"),
        (
            {"shape": "line", "to_north_m": 200, "speed_mps": 13, "run_in_s": 10},
            "a speed of",
            "12 m/s",
        ),
        ({"shape": "helix", "climb_mps": -0.4}, "a height of", "0.3 m"),
        (
            {"shape": "line", "to_north_m": 1000, "to_east_m": 0, "speed_mps": 11}
            | {"origin_north_m": 1000, "origin_east_m": 1000},
            "a distance of",
            "2e+03 m",
        ),
        (
            {"shape": "lemniscate", "period_s": 3.0, "half_length_m": 0.5, "half_width_m": 0.06}
            | {"course": "along_velocity"},
            "a yaw rate of",
            "3.49 rad/s",
        ),
        (UP | {"climb_m": 90, "run_in_s": 1.5}, "a thrust of", "18.6 m/s^2"),
        (UP | {"climb_m": -60, "run_in_s": 2.2}, "a thrust of", "3.27 m/s^2"),
    ],
)
def test_infeasible_reference_is_refused_with_time_value_and_limit(
    settings: dict[str, object], what: str, limit: str
) -> None:
    flown = track(**settings)
    side = "below" if limit in ("0.3 m", "3.27 m/s^2") else "beyond"
    with pytest.raises(ValueError, match=f"{side} the limit of {re.escape(limit)}") as caught:
        check(flown, vehicle(tilt_max_rad=0.4 / 0.9))
    sentence = str(caught.value)
    found = re.match(rf"the reference requires {what} (-?[\d.e+]+) \S+ at ([\d.]+) s, ", sentence)
    assert found, sentence
    assert 0.0 < float(found[2]) <= flown.duration_s + 0.005


@pytest.mark.parametrize("jump_s", [150.0, 200.0])
def test_jump_of_the_tilt_rate_is_refused_at_any_time(jump_s: float) -> None:
    """Also where one of the parts ends in which a reference is checked."""

    class Jumping:
        duration_s = 300.0

        def sample(self, time_s: NDArray[np.float64]) -> FlatSample:
            still = hold((0.0, 0.0, -2.0), 0.0).sample(time_s)
            jerk_mps3 = np.outer(time_s > jump_s - 0.005, [8.0, 0.0, 0.0])
            return still._replace(jerk_ned_mps3=jerk_mps3)

    with pytest.raises(ValueError, match=f"pitch acceleration of .* at {jump_s:.2f} s"):
        check(Jumping(), vehicle())


@pytest.mark.parametrize(
    ("assignments", "end"),
    [
        (["reference=circle", "reference.period_s=3"], "(period_s; its ends: run_in_s, run_out_s)"),
        (["reference=racing", "reference.fastest.tilt_deg=50"], "run_out_s)"),
        (["reference=lemniscate_course", "reference.half_width_m=0.06"], " or turn less (course)"),
        (["reference=helix", "reference.climb_mps=-0.4"], " s)"),  # the height needs no speed
    ],
)
def test_refusal_of_a_fast_reference_says_what_makes_it_slower(
    assignments: list[str], end: str
) -> None:
    with pytest.raises(DocumentError) as caught:
        build_track(load("flight", assignments=assignments))
    sentence = str(caught.value)
    assert sentence.endswith(end), sentence
    assert ("; fly it slower (" in sentence) is (end != " s)")


@dataclass
class Leap:
    """A reference whose speed grows and whose height falls with time."""

    start_down_m: float
    duration_s = 10.0

    def sample(self, time_s: object) -> FlatSample:
        time = np.asarray(time_s, dtype=np.float64)
        zero, heading = np.zeros((*time.shape, 3)), np.zeros(time.shape)
        down, north = np.array([0.0, 0.0, 1.0]), np.array([2.0, 0.0, 0.0])
        position = (self.start_down_m + time[..., None]) * down
        velocity = time[..., None] * north
        return FlatSample(position, velocity, zero, zero, zero, heading, heading, heading)


@pytest.mark.parametrize(
    ("start_down_m", "sentence"),
    [
        (-5.0, r"a height of -5 m at 10.00 s, .* 0.3 m \(first at 4.7[01] s"),
        (-15.0, r"a speed of 20 m/s at 10.00 s, .* \(first at 6.0[01] s"),
    ],
)
def test_first_exceeded_limit_is_named(start_down_m: float, sentence: str) -> None:
    with pytest.raises(ValueError, match=sentence):
        check(Leap(start_down_m), vehicle())


def test_nan_height_is_refused() -> None:
    with pytest.raises(ValueError, match="a height of nan m"):
        check(hold((0.0, 0.0, math.nan), 0.0), vehicle())


def test_long_references_are_checked_to_their_end() -> None:
    """The line is gentle for 500 s and has its greatest values, or a sudden stop, at its end."""
    climb = {"shape": "line", "to_north_m": 30, "climb_m": 96, "speed_mps": 0.2, "height_m": 2.0}
    assert check(track(**climb), vehicle())[1:] == pytest.approx((98.0, 30.0))
    with pytest.raises(ValueError, match=r"a pitch rate of .* at 50\d"):
        check(track(**climb, run_out_s=0.05), vehicle())
