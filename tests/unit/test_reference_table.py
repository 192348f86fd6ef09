"""CSV tables: what they mean, how smooth they become, and the sentence for every wrong one."""

from __future__ import annotations

import math

import numpy as np
import pytest
from laws import PX4

from offboard.reference.feasibility import check
from offboard.reference.shapes import FromTable
from offboard.reference.table import parse
from offboard.reference.track import Track


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
