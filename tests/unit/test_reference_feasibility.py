"""What a vehicle cannot fly is refused with time, value and limit; the figures are hand-made."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass

import numpy as np
import pytest

from offboard.model.vehicle import Vehicle
from offboard.reference.base import FlatSample
from offboard.reference.feasibility import check
from offboard.reference.shapes import SHAPES
from offboard.reference.track import Track, hold


def vehicle(**changes: object) -> Vehicle:
    response = {"delay_s": 0.05, "natural_frequency_radps": 11, "damping": 0.6}
    values = {
        "name": "test", "mass_kg": 1.0, "gravity_mps2": 9.8, "inertia_kgm2": [0.02, 0.02, 0.03],
        "drag_translation_npmps": [0, 0, 0], "drag_rotation_nmpradps": [0, 0, 0],
        "hover_thrust": 0.5, "tilt": response, "yaw": response, "tilt_max_rad": 0.7,
    }  # fmt: skip
    return Vehicle.model_validate(values | changes)


def track(**settings: object) -> Track:
    return SHAPES[str(settings["shape"])](**settings).track()


def test_a_circle_by_hand() -> None:
    """Its tilt, height and distance; a thrust beyond a limit that is just too low."""
    inward = (2 * math.pi / 8) ** 2 * 2.0
    flown = track(shape="circle", radius_m=2.0, period_s=8.0, run_in_s=30, run_out_s=30)
    reached = math.atan2(inward, 9.8), 3.0, 2.0
    assert check(flown, vehicle()) == pytest.approx(reached, rel=1e-3)
    thrust_mps2 = math.hypot(9.8, inward)
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
def test_refused_with_time_value_and_limit(
    settings: dict[str, object], what: str, limit: str
) -> None:
    flown = track(**settings)
    with pytest.raises(ValueError, match=f"beyond the limit of {re.escape(limit)}") as caught:
        check(flown, vehicle(tilt_max_rad=0.4 / 0.9))
    sentence = str(caught.value)
    found = re.match(rf"the reference asks for {what} (-?[\d.e+]+) \S+ at ([\d.]+) s, ", sentence)
    assert found, sentence
    assert 0.0 < float(found[2]) <= flown.duration_s + 0.005


@dataclass
class Leap:
    """Speed grows with time, height falls."""

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
def test_the_limit_that_is_met_first_is_named(start_down_m: float, sentence: str) -> None:
    with pytest.raises(ValueError, match=sentence):
        check(Leap(start_down_m), vehicle())


def test_what_is_not_a_number_is_refused() -> None:
    with pytest.raises(ValueError, match="a height of nan m"):
        check(hold((0.0, 0.0, math.nan), 0.0), vehicle())


def test_long_references_are_checked_in_parts() -> None:
    """Gentle for 500 s; what is greatest, or too brisk, at their end."""
    climb = {"shape": "line", "to_north_m": 30, "climb_m": 96, "speed_mps": 0.2, "height_m": 2.0}
    assert check(track(**climb), vehicle())[1:] == pytest.approx((98.0, 30.0))
    with pytest.raises(ValueError, match=r"a pitch rate of .* at 50\d"):
        check(track(**climb, run_out_s=0.05), vehicle())
