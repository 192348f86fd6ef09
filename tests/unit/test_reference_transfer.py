"""Transfers against their limits, their ends and the closed form; CSV tables: what they mean, how
smooth they become, and the sentence for every wrong one."""

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


def test_rest_to_rest_is_the_smoothstep_of_degree_nine() -> None:
    flown = transfer((1.0, 2.0, 0.0), (1.0, 2.0, -3.0), 0.3, 0.3)
    x = np.linspace(0.0, 1.0, 21)
    smoothstep = 126 * x**5 - 420 * x**6 + 540 * x**7 - 315 * x**8 + 70 * x**9
    sample = flown.sample(x * flown.duration_s)
    np.testing.assert_allclose(sample.position_ned_m[:, 2], -3.0 * smoothstep, atol=1e-10)
    np.testing.assert_allclose(sample.position_ned_m[:, :2], [[1.0, 2.0]] * 21, atol=1e-12)
    np.testing.assert_allclose(sample.heading_rad, 0.3, atol=1e-12)


@pytest.mark.parametrize("distance_m", [0.0, 0.2, 3.0, 10.0])
def test_as_fast_as_the_limits_allow(distance_m: float) -> None:
    limits = Limits(speed_mps=2.0, acceleration_mps2=1.5, heading_rate_radps=0.5)
    flown = transfer((0, 0, -3), (distance_m, 0, -3), 0.0, 1.0, limits)
    speed, acceleration, rate = peaks(flown)
    ratio = max(speed / 2.0, acceleration / 1.5, rate / 0.5)
    assert 0.85 < ratio <= 1.001


@pytest.mark.parametrize(
    ("target", "velocity"),
    [((60.0, -40.0, -20.0), (-1.0, 0.5, -0.8)), ((0.0, 5.0, -60.0), (0.0, 0.0, 0.0))],
)
def test_a_long_way_is_flown_at_constant_speed(
    target: tuple[float, float, float], velocity: tuple[float, float, float]
) -> None:
    limits = Limits(cruise_mps=4.0, cruise_vertical_mps=1.5, acceleration_mps2=2.0)
    flown = transfer((0, 0, -3), target, 3.0, -3.0, limits, start_velocity_ned_mps=velocity)
    times = np.linspace(0.0, flown.duration_s, 4001)
    sample = flown.sample(times)
    distance_m = math.dist((0, 0, -3), target)
    cruise_mps = min(4.0, 1.5 * distance_m / max(abs(target[2] + 3.0), 1e-9))
    speed_mps, acceleration_mps2, _ = peaks(flown)
    assert speed_mps <= cruise_mps * 1.001
    assert acceleration_mps2 <= 2.001
    assert np.abs(sample.velocity_ned_mps[:, 2]).max() <= 1.501
    # no slower than at constant acceleration with twice the time for gaining and losing the speed
    gained_mps = cruise_mps + float(np.linalg.norm(velocity))
    assert flown.duration_s < distance_m / cruise_mps + 3.0 * gained_mps / 2.0
    start, end = flown.sample(0.0), flown.sample(flown.duration_s)
    np.testing.assert_allclose(start.velocity_ned_mps, velocity, atol=1e-9)
    np.testing.assert_allclose(end.position_ned_m, target, atol=1e-6)
    assert float(end.heading_rad) == pytest.approx(2 * math.pi - 3.0)
    for name in ("velocity_ned_mps", "acceleration_ned_mps2", "jerk_ned_mps3", "snap_ned_mps4"):
        np.testing.assert_allclose(getattr(end, name), 0.0, atol=1e-6)
        for knot_s in flown.path.breaks_s[1:-1]:  # no kink between the pieces
            before, after = (getattr(flown.sample(knot_s + h), name) for h in (-1e-7, 1e-7))
            np.testing.assert_allclose(before, after, atol=1e-4)


def test_no_start_is_planned_further_out_than_it_needs_to_brake() -> None:
    """Climbing away, falling, sideways: the plan stays between start, target and braking point."""
    rng, acceleration = np.random.default_rng(5), Limits().acceleration_mps2
    for size_m, speed_mps in itertools.product((2.0, 30.0, 500.0), (0.5, 3.0, 8.0)):
        for _ in range(5):
            start, target = rng.uniform(-size_m, size_m, (2, 3))
            velocity = rng.normal(size=3)
            velocity *= speed_mps / np.linalg.norm(velocity)
            flown = transfer(start, target, 0.0, 1.0, start_velocity_ned_mps=velocity)
            path = flown.sample(np.linspace(0.0, flown.duration_s, 501)).position_ned_m
            braking_m = speed_mps * max(1.5, 35.0 / 16.0 * speed_mps / acceleration) / 2.0
            lowest = np.minimum(start, target) - braking_m - 0.5
            highest = np.maximum(start, target) + braking_m + 0.5
            assert np.all((path >= lowest) & (path <= highest))
            assert flown.duration_s < 20.0 + 2.0 * braking_m + size_m * math.sqrt(12.0)
            np.testing.assert_allclose(flown.sample(0.0).velocity_ned_mps, velocity, atol=1e-9)
            np.testing.assert_allclose(path[-1], target, atol=1e-6)


def table_track(text: str, **settings: object) -> Track:
    return FromTable(**{"file": "flown.csv", "text": text} | settings).track()


def test_columns_in_any_order_and_by_any_name() -> None:
    text = (
        "\ufeffY_m, altitude_m ,x,time_s,course_deg\n\n"
        "1,2,3,10,350\n4,5,6,11,10\n7,8,9,12.5,30\n1,1,1,14,0\n"
    )
    rows = parse(text, "a.csv")
    np.testing.assert_allclose(rows.times_s, [0, 1, 2.5, 4])
    np.testing.assert_allclose(rows.points_ned_m[:2], [[3, 1, -2], [6, 4, -5]])
    assert rows.heading_rad is not None
    np.testing.assert_allclose(np.degrees(rows.heading_rad), [350, 370, 390, 360])


def test_passes_through_every_row_with_its_heading() -> None:
    times = np.linspace(0, 12, 25)
    heading = (300 + 15 * times) % 360
    rows = "".join(
        f"{t},{2 * math.sin(0.5 * t)},{math.cos(0.5 * t)},{3 + 0.1 * t},{c}\n"
        for t, c in zip(times, heading, strict=True)
    )
    track = table_track("time_s,x,y,altitude_m,course_deg\n" + rows)
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


def test_knots_forgive_rounded_rows() -> None:
    """100 Hz rows rounded to a millimetre: interpolated they cannot be flown, fitted they can."""
    times = np.arange(0, 10, 0.01)
    rows = "".join(
        f"{t:.2f},{2 * math.sin(0.7 * t):.3f},{math.cos(0.7 * t):.3f},3.000\n" for t in times
    )
    text = "time_s,x,y,altitude_m\n" + rows
    with pytest.raises(ValueError, match=r"rate of|tilt of"):
        check(table_track(text), PX4)
    fitted = table_track(text, knot_spacing_s=0.5)
    check(fitted, PX4)
    s = np.linspace(2.0, 7.0, 100)
    expected = np.stack([2 * np.sin(0.7 * s), np.cos(0.7 * s)], -1)
    assert np.abs(fitted.sample(s + 1.0).position_ned_m[:, :2] - expected).max() < 1e-3


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
        ("t,x,y,z\n" + BODY, r"row 1: unknown column 't'; known are time_s"),
        ("time_s,x,y\n" + BODY, r"row 1: column altitude_m is missing"),
        ("time_s,x,y,z,altitude_m\n" + BODY, r"down_m and altitude_m exclude each other"),
        ("time_s,x,z\n" + BODY, r"row 1: column east_m is missing"),
        ("time_s,x,y,x_m\n" + BODY, r"row 1: column north_m is given twice"),
        ("\x00\x01\x02PK", r"a\.csv, row 1: unknown column|not a CSV"),
    ],
)
def test_bad_tables_name_file_row_and_column(text: str, sentence: str) -> None:
    with pytest.raises(ValueError, match=sentence):
        parse(text, "a.csv")


def test_table_of_more_than_an_hour_is_refused():
    rows = "".join(f"{1200.01 * i},0,0,3\n" for i in range(4))
    with pytest.raises(ValueError, match=r"^a\.csv lasts 3600\.03 s: at most 3600 s are flown$"):
        parse("time_s,north_m,east_m,altitude_m\n" + rows, "a.csv")
