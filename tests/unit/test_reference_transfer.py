"""Transfers against their limits, their ends and the closed form; CSV tables: their
meaning, how smooth they are flown, and the sentence for each error."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from laws import PX4

from offboard.reference.feasibility import check
from offboard.reference.shapes import FromTable
from offboard.reference.table import parse
from offboard.reference.track import Track
from offboard.reference.transfer import Limits, transfer


def peaks(flown: Track) -> tuple[float, float, float]:
    """Greatest speed, acceleration and rate of the heading."""
    sample = flown.sample(np.linspace(0.0, flown.duration_s, 2001))
    return (
        float(np.linalg.norm(sample.velocity_ned_mps, axis=-1).max()),
        float(np.linalg.norm(sample.acceleration_ned_mps2, axis=-1).max()),
        float(np.abs(sample.heading_rate_radps).max()),
    )


@pytest.mark.parametrize("distance_m", [0.0, 0.2, 3.0, 10.0])
def test_transfer_is_as_fast_as_the_limits_allow(distance_m: float) -> None:
    limits = Limits(speed_mps=2.0, acceleration_mps2=1.5, heading_rate_radps=0.5)
    flown = transfer((0, 0, -3), (distance_m, 0, -3), 0.0, 1.0, limits)
    speed, acceleration, rate = peaks(flown)
    ratio = max(speed / 2.0, acceleration / 1.5, rate / 0.5)
    assert 0.85 < ratio <= 1.001


def test_transfer_from_any_velocity_stays_within_the_limits() -> None:
    """From any start velocity the transfer has no kink, ends at rest at the target and goes no
    further out than braking needs. It lasts no longer than a transfer at constant acceleration with
    twice the time to gain and lose speed. A long way is flown at constant speed."""
    rng = np.random.default_rng(5)
    limits = Limits(cruise_mps=4.0, cruise_vertical_mps=1.5, acceleration_mps2=2.0)
    for size_m, speed_mps in itertools.product((2.0, 30.0, 500.0), (0.0, 0.5, 1.4, 3.0, 8.0)):
        for _ in range(3):
            start, target = rng.uniform(-size_m, size_m, (2, 3))
            velocity = rng.normal(size=3)
            velocity *= speed_mps / np.linalg.norm(velocity)
            flown = transfer(start, target, 3.0, -3.0, limits, start_velocity_ned_mps=velocity)
            path = flown.sample(np.linspace(0.0, flown.duration_s, 4001))
            distance_m = math.dist(start, target)
            cruise_mps = min(4.0, 1.5 * distance_m / abs(target[2] - start[2]))
            reached_mps, reached_mps2, _ = peaks(flown)
            assert reached_mps <= max(cruise_mps, 1.5, speed_mps) * 1.01
            assert reached_mps2 <= max(2.0, 35.0 / 24.0 * speed_mps) * 1.01
            falling_mps = np.abs(path.velocity_ned_mps[:, 2]).max()
            assert falling_mps <= max(1.5, abs(velocity[2])) * 1.05
            braking_m = speed_mps * max(1.5, 35.0 / 32.0 * speed_mps) / 2.0
            off_m = 0.5 + braking_m
            inside = path.position_ned_m - np.clip(
                path.position_ned_m, *np.sort((start, target), 0)
            )
            assert np.abs(inside).max() <= off_m
            wasted_s = 3.0 * (cruise_mps + speed_mps) / 2.0 + 6.0
            assert flown.duration_s < (distance_m + braking_m) / cruise_mps + wasted_s
            np.testing.assert_allclose(path.position_ned_m[-1], target, atol=1e-6)
            np.testing.assert_allclose(path.velocity_ned_mps[0], velocity, atol=1e-9)
            assert float(path.heading_rad[-1]) == pytest.approx(2 * math.pi - 3.0)
            for name in ("velocity_ned_mps", "acceleration_ned_mps2", "jerk_ned_mps3"):
                np.testing.assert_allclose(getattr(path, name)[-1], 0.0, atol=1e-6)
                for knot_s in flown.path.breaks_s[1:-1]:  # no kink between the pieces
                    before, after = (getattr(flown.sample(knot_s + h), name) for h in (-1e-7, 1e-7))
                    np.testing.assert_allclose(before, after, atol=1e-4)


def test_flat_way_is_flown_at_the_greater_height() -> None:
    """Further than 1 m from either end of a flat way, the vehicle is as high as the higher end,
    after a lift-off, on the way down, and when it first brakes. A steep way is straight."""
    cases = (
        ((0, 0, -0.6), (40, 0, -3), (0, 0, -0.9)),
        ((0, 0, -20), (9, 30, -3), (0, 0, 0)),
        ((0, 0, -3), (60, 0, -8), (5, 0, 0)),
    )
    for start, target, velocity in cases:
        flown = transfer(
            start, target, 0.0, 1.0, start_velocity_ned_mps=velocity, keeps_height=True
        )
        places = flown.sample(np.linspace(0.0, flown.duration_s, 4001)).position_ned_m
        braked_m = velocity[0] * 35.0 / 16.0 * velocity[0] / 2.0 / 2.0
        from_start_m = np.linalg.norm(places[:, :2] - (start[0] + braked_m, 0.0), axis=1)
        away = from_start_m > 1.0
        away &= np.linalg.norm(places[:, :2] - target[:2], axis=1) > 1.0
        away &= places[:, 0] >= braked_m
        assert away.any()
        np.testing.assert_allclose(places[away, 2], min(start[2], target[2]), atol=1e-6)
        np.testing.assert_allclose(places[-1], target, atol=1e-6)
    steep = ((0, 0, -1), (4, 0, -6), 0.0, 0.0)
    way, straight = transfer(*steep, keeps_height=True), transfer(*steep)
    assert way.duration_s == straight.duration_s


def table_track(text: str, **settings: object) -> Track:
    return FromTable(**{"file": "flown.csv", "text": text} | settings).track()


def test_table_track_passes_through_every_row_with_its_heading() -> None:
    """Columns may have any order and any of their names, times any start and unequal steps."""
    times = np.delete(np.linspace(0, 12, 25), 7)
    heading = (300 + 15 * times) % 360
    rows = "".join(
        f"{math.cos(0.5 * t)},{3 + 0.1 * t},{2 * math.sin(0.5 * t)},{10 + t},{c}\n"
        for t, c in zip(times, heading, strict=True)
    )
    track = table_track("\ufeffY_m, altitude_m ,x,time_s,course_deg\n\n" + rows)
    # half of the run-in is spent on the path: rows lie 1 s later, inside the full-speed part
    inner = (times > 1.0) & (times < 11.0)
    sample = track.sample(times[inner] + 1.0)
    t = times[inner]
    expected = np.stack([2 * np.sin(0.5 * t), np.cos(0.5 * t), -3 - 0.1 * t], -1)
    np.testing.assert_allclose(sample.position_ned_m, expected, atol=1e-9)
    np.testing.assert_allclose(np.degrees(sample.heading_rad), 300 + 15 * t, atol=1e-8)
    np.testing.assert_allclose(np.degrees(sample.heading_rate_radps), 15, atol=1e-6)
    middle = np.abs(t - 6.0) < 3.0
    expected_acceleration = -0.25 * np.stack([2 * np.sin(0.5 * t), np.cos(0.5 * t)], -1)
    np.testing.assert_allclose(
        sample.acceleration_ned_mps2[middle, :2], expected_acceleration[middle], atol=2e-3
    )


@pytest.mark.parametrize(("step_s", "digits"), [(0.04, 4), (0.1, 2), (0.01, 3)])
def test_rounded_rows_are_smoothed(step_s: float, digits: int) -> None:
    """Rounding demands great accelerations of the tilt from a curve through every row, as from rows
    at 25 Hz rounded to 0.1 mm. Without `knot_spacing_s` the rows are fitted."""
    rows = "".join(
        f"{t:.2f},{2 * math.sin(0.7 * t):.{digits}f},{math.cos(0.7 * t):.{digits}f},3\n"
        for t in np.arange(0, 10, step_s)
    )
    text = "time_s,x,y,altitude_m\n" + rows
    with pytest.raises(ValueError, match=r"rate of|tilt of|acceleration of"):
        check(table_track(text, knot_spacing_s=0), PX4)
    fitted = table_track(text)
    check(fitted, PX4)
    s = np.linspace(2.0, 7.0, 100)
    expected = np.stack([2 * np.sin(0.7 * s), np.cos(0.7 * s)], -1)
    assert np.abs(fitted.sample(s + 1.0).position_ned_m[:, :2] - expected).max() < 10.0**-digits


def test_rows_with_a_corner_are_not_smoothed() -> None:
    times = np.arange(0, 10, 0.1)
    rows = np.stack((np.minimum(times, 5.0), np.maximum(times - 5.0, 0.0)), axis=-1)
    text = "".join(f"{t:.1f},{x:.3f},{y:.3f},3\n" for t, (x, y) in zip(times, rows, strict=True))
    track = table_track("time_s,x,y,altitude_m\n" + text)
    inner = track.sample(times[15:85] + 1.0).position_ned_m[:, :2]
    np.testing.assert_allclose(inner, rows[15:85], atol=1e-9)


HEAD = "time_s,north_m,east_m,down_m\n"
BODY = "0,0,0,-2\n1,1,0,-2\n2,2,1,-2\n"


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("", r"a\.csv is empty: .* at least 4 rows"),
        (HEAD, r"a\.csv has 0 rows of data: at least 4"),
        (HEAD + BODY + "3,x,0,-2\n", r"a\.csv, row 5, column north_m: 'x' is not a finite number"),
        (HEAD + BODY + "\n2,0,0,-2\n", r"row 6, column time_s: 2 does not come after 2"),
        (HEAD + BODY + "3,0,0\n", r"row 5: 3 cells for 4 columns"),
        ("t,x,y,z\n" + BODY, r"row 1: unknown column 't'; known, separated by commas, are time_s"),
        ("time_s,x,y\n" + BODY, r"row 1: column altitude_m is missing"),
        ("time_s,x,y,z,altitude_m\n" + BODY, r"down_m and altitude_m exclude each other"),
        ("time_s,x,z\n" + BODY, r"row 1: column east_m is missing"),
        ("time_s,x,y,x_m\n" + BODY, r"row 1: column north_m is given twice"),
        ("\x00\x01\x02PK", r"a\.csv, row 1: unknown column|not a CSV"),
        (HEAD + BODY + "3600.03,3,0,-2\n", r"^a\.csv lasts 3600\.03 s: at most 3600 s are flown$"),
    ],
)
def test_bad_tables_name_file_row_and_column(text: str, sentence: str) -> None:
    with pytest.raises(ValueError, match=sentence):
        parse(text, "a.csv")
