"""Draws the README's picture: the path of one or two flights against their reference, as SVG.

    python .github/flight_picture.py FLIGHT [FLIGHT] > .github/flight.svg

The first flight is labelled as flown by offboard, the second by the autopilot's position loop.
Left: the horizontal path. Right: distance from the reference over time. Both show the scored part
of the flight, the phase TRACK. Colours are chosen to be readable on white and on black.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicHermiteSpline

from offboard.analysis import history, tlog
from offboard.flight.phases import Phase

Array = NDArray[np.float64]
SAMPLE_S = 0.05
PIXELS_PER_M = 92.0
MAP_CENTRE = (245.0, 165.0)
CHART = (540.0, 300.0, 880.0, 70.0)  # left, bottom, right, top
CHART_MAX_M = 1.2
GREY = "#808890"
COLOURS = ("#1f8fe5", "#e0662b")
LABELS = ("offboard", "the autopilot's own position loop")


def tracked(flight: Path) -> tuple[Array, Array, Array]:
    """Time since the start of TRACK (N,), reference and flown position (N, 3), NED in metres."""
    flown = history.gather(tlog.read(flight))
    track = flown.records["phase"] == Phase.TRACK.code
    begin_s, end_s = flown.records["time_s"][track][[0, -1]]
    times = np.arange(begin_s, end_s, SAMPLE_S)
    _, first = np.unique(flown.reference["time_s"], return_index=True)
    rows = flown.reference[first]
    reference = CubicHermiteSpline(
        rows["time_s"], rows["position_ned_m"], rows["velocity_ned_mps"]
    )(times)
    places, stamps = flown.position["position_ned_m"], flown.position["time_s"]
    columns = (np.interp(times, stamps, axis) for axis in places.T)
    return times - begin_s, reference, np.column_stack(list(columns))


def polyline(x: Array, y: Array, colour: str, width: float, more: str = "") -> str:
    """One line through pixel coordinates (N,), rounded to a tenth of a pixel."""
    points = " ".join(f"{a:.1f},{b:.1f}" for a, b in zip(x, y, strict=True))
    style = f'fill="none" stroke="{colour}" stroke-width="{width}" stroke-linejoin="round"'
    return f'<polyline {style} {more} points="{points}"/>'


def text(x: float, y: float, words: str, colour: str = GREY, anchor: str = "start") -> str:
    return f'<text x="{x:.0f}" y="{y:.0f}" fill="{colour}" text-anchor="{anchor}">{words}</text>'


def on_map(position: Array) -> tuple[Array, Array]:
    """Pixels of NED positions (N, 3) seen from above: north to the right, east down."""
    return (
        MAP_CENTRE[0] + PIXELS_PER_M * position[:, 0],
        MAP_CENTRE[1] + PIXELS_PER_M * position[:, 1],
    )


def chart_frame(duration_s: float) -> list[str]:
    """Axes of the error over time, with grid lines every 0.2 m and ticks every 4 s."""
    left, bottom, right, top = CHART
    parts = [text(left, 26, "distance from the reference [m]")]
    for metres in np.arange(0.0, CHART_MAX_M + 0.01, 0.2):
        y = bottom - (bottom - top) * metres / CHART_MAX_M
        parts.append(polyline(np.array([left, right]), np.array([y, y]), GREY, 0.4))
        parts.append(text(left - 8, y + 4, f"{metres:.1f}", anchor="end"))
    for second in range(0, round(duration_s) + 1, 4):
        x = left + (right - left) * second / duration_s
        parts.append(text(x, bottom + 20, f"{second} s", anchor="middle"))
    return parts


def draw(flights: list[Path]) -> str:
    """The whole picture."""
    paths = [tracked(flight) for flight in flights[: len(LABELS)]]
    times, reference, _ = paths[0]
    left, bottom, right, top = CHART
    parts = [
        *chart_frame(times[-1]),
        polyline(*on_map(reference), GREY, 5.0, 'stroke-opacity="0.45"'),
        text(20, 26, "seen from above, north to the right"),
        polyline(np.array([20.0, 20.0 + PIXELS_PER_M]), np.array([318.0, 318.0]), GREY, 1.5),
        text(20 + PIXELS_PER_M / 2, 312, "1 m", anchor="middle"),
        text(140, 322, "broad grey line: reference"),
    ]
    for line, (times, reference, flown) in enumerate(paths, 1):
        colour, label = COLOURS[line - 1], LABELS[line - 1]
        error_m = np.linalg.norm(flown - reference, axis=1)
        x = left + (right - left) * times / times[-1]
        y = bottom - (bottom - top) * error_m / CHART_MAX_M
        parts.append(polyline(*on_map(flown), colour, 1.5, f'id="flight-{line}"'))
        parts.append(polyline(x, y, colour, 1.5))
        rmse_m = float(np.sqrt(np.mean(error_m**2)))
        parts.append(text(left, 26 + 18 * line, f"{label}: RMSE {rmse_m:.2f} m", colour))
    head = (
        '<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 900 335" '
        'font-family="system-ui, sans-serif" font-size="14">'
    )
    return "\n".join([head, *parts, "</svg>\n"])


if __name__ == "__main__":
    sys.stdout.write(draw([Path(name) for name in sys.argv[1:]]))
