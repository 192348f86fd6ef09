"""Volumes to keep out of: distances in numbers, what is refused, and the ways round them."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from attitude_plant import lemniscate
from pydantic import TypeAdapter

from offboard.control.keep_out import KeepOut, clearances, refusal
from offboard.reference.path import Fixed
from offboard.reference.track import Track

SPHERE = {"shape": "sphere", "north_m": 1, "east_m": 2, "height_m": 3, "radius_m": 0.5}
TOWER = {
    "shape": "cylinder", "north_m": 0, "east_m": 0, "height_m": 2, "radius_m": 1, "length_m": 4,
}  # fmt: skip
BOX = {
    "shape": "box", "north_m": 0, "east_m": 0, "height_m": 10,
    "size_north_m": 2, "size_east_m": 4, "size_up_m": 6,
}  # fmt: skip


def volume(values: dict[str, object]):  # type: ignore[no-untyped-def]
    return TypeAdapter(KeepOut).validate_python(values)


@pytest.mark.parametrize(
    ("values", "at", "expected"),
    [
        (SPHERE, (1, 2, -3), -0.5),
        (SPHERE, (1, 2, 3), 5.5),  # NED: 3 m below the take-off point
        (TOWER, (0, 0.5, -2), -0.5),
        (TOWER, (0, 0, -3.9), -0.1),
        (TOWER, (3, 4, -2), 4.0),
        (TOWER, (0, 0, -7), 3.0),
        (TOWER, (4, 0, -8), 5.0),  # off its rim, 3-4-5
        (BOX, (0, 1.5, -10), -0.5),
        (BOX, (0, 0, -12.9), -0.1),
        (BOX, (5, 0, -10), 4.0),
        (BOX, (3, 4, -14), 3.0),  # off its corner by (2, 2, 1)
    ],
)
def test_distances(values: dict[str, object], at: tuple[float, ...], expected: float) -> None:
    (found,) = clearances((volume(values),), np.zeros(1), np.array([at], np.float64))
    assert found == pytest.approx(expected, abs=1e-12)


def test_moving_ones_start_with_the_reference() -> None:
    moving = volume({**SPHERE, "velocity_north_mps": 1.0, "velocity_up_mps": 2.0})
    place = np.tile([1.0, 2.0, -3.0], (4, 1))
    found = clearances((moving,), np.array([math.nan, -5.0, 0.0, 3.0]), place)
    assert found == pytest.approx([-0.5, -0.5, -0.5, math.sqrt(45) - 0.5])
    inside = clearances((moving,), np.array([3.0]), np.array([[4.0, 2.0, -9.0]]))
    assert inside == pytest.approx([-0.5])  # 3 m further north, 6 m further up


@pytest.mark.parametrize(
    ("values", "says"),
    [
        ({**SPHERE, "north_m": 0, "east_m": 0, "height_m": 0}, "contains the take-off point"),
        ({**SPHERE, "north_m": 0, "east_m": 0}, "contains the start of the reference"),
        ({**BOX, "height_m": 6, "size_north_m": 30, "size_east_m": 30, "size_up_m": 10},
         "contains the whole path"),
        (SPHERE, None),
        ({**SPHERE, "north_m": 1.41, "east_m": 1}, None),  # on the path, which leads out of it
        ({**SPHERE, "north_m": 0, "east_m": -3, "velocity_east_mps": 3 / 18},
         "contains the end of the reference"),
    ],
)  # fmt: skip
def test_what_cannot_be_flown_is_refused(values: dict[str, object], says: str | None) -> None:
    short = replace(lemniscate(7.0).path, length_s=10.0)
    track = Track(short, Fixed(0.0), 4.0, 4.0, origin_ned_m=(0.0, 0.0, -3.0))
    found = refusal((volume(values),), 0.3, track)
    if says is None:
        assert found is None
    else:
        assert found is not None
        assert says in found
        assert "clearance of 0.3 m" in found
