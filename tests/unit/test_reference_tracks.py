"""Every shape and every shipped reference: derivatives, joints, rest, broadcasting, runs.

Oracle of the derivatives: Chebyshev interpolation of the positions alone, differentiated.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from numpy.polynomial import Chebyshev
from numpy.typing import NDArray
from pydantic import ValidationError

from offboard.documents.reading import parse, read
from offboard.model.vehicle import Vehicle
from offboard.reference.base import FlatSample
from offboard.reference.feasibility import check
from offboard.reference.heading import HOLD_SPEED_MPS, AlongVelocity, Fixed, along_velocity
from offboard.reference.path import Harmonic
from offboard.reference.path import Path as FlatPath
from offboard.reference.shapes import SHAPES, Line
from offboard.reference.track import Track

Array = NDArray[np.float64]

CONFIG = Path(__file__).parents[2] / "config"
TABLE = "time_s,north_m,east_m,altitude_m,course_deg\n" + "".join(
    f"{0.5 * k},{math.sin(0.4 * k)},{math.cos(0.3 * k)},{2 + 0.1 * k},{(340 + 20 * k) % 360}\n"
    for k in range(25)
)
POINTS = [[0, 0, 0], [3, 1, 0.5], [4, 4, 1], [1, 5, 0.5], [0, 2, 0]]
NEEDED: dict[str, dict[str, object]] = {
    "waypoints": {"points_m": POINTS, "speed_mps": 1.2},
    "table": {"file": "flown.csv", "text": TABLE},
}
SHIPPED = sorted(path.stem for path in (CONFIG / "references").glob("*.yaml"))


def track_of(shape: str, heading: str, **settings: object) -> Track:
    values: dict[str, object] = {"course": heading, "course_deg": 30.0}
    return SHAPES[shape](**values | NEEDED.get(shape, {}) | settings).track()


def shipped(name: str) -> Track:
    text = (CONFIG / "references" / f"{name}.yaml").read_text()
    settings = read(text, name)
    return SHAPES[settings["shape"]](**settings).track()


CASES = [(shape, "fixed") for shape in SHAPES] + [(shape, "along_velocity") for shape in SHAPES]
TRACKS = {f"{shape}-{heading}": track_of(shape, heading) for shape, heading in CASES}
TRACKS["table-table"] = track_of("table", "table")
TRACKS["waypoints-jerk"] = track_of("waypoints", "along_velocity", minimise="jerk")
every_track = pytest.mark.parametrize("track", TRACKS.values(), ids=TRACKS.keys())


def stacked(sample: FlatSample) -> list[Array]:
    return [getattr(sample, name) for name in FlatSample.__slots__]


def orders(sample: FlatSample) -> tuple[Array, Array]:
    """Position to snap (5, ..., 3) and heading to its acceleration (3, ...)."""
    values = stacked(sample)
    return np.stack(values[:5]), np.stack(values[5:])


def joints(track: Track) -> Array:
    """Times at which one formula hands over to another."""
    ends = [0.0, track.run_in_s, track.run_in_s + track.cruise_s, track.duration_s]
    inner: list[float] = list(getattr(track.path, "breaks_s", ()))
    if isinstance(track.heading, AlongVelocity):
        inner += list(track.heading.slow_s.ravel())
    grid = np.linspace(0.0, track.duration_s, 20001)
    travelled = along_path(track, grid)
    return np.unique(np.concatenate([ends, np.interp(inner, travelled, grid)]).round(9))


def along_path(track: Track, times: Array) -> Array:
    """The path's own time, found by integrating what the run-in and run-out promise."""
    rate = np.interp(times, *_rate(track))
    steps = 0.5 * (rate[1:] + rate[:-1]) * np.diff(times)
    return np.concatenate([[0.0], np.cumsum(steps)])


def _rate(track: Track) -> tuple[Array, Array]:
    """ds/dt: the integral of x^4 (1 - x)^4, normalised, up and down."""
    x = np.linspace(0.0, 1.0, 2001)
    up = np.concatenate(
        [[0.0], np.cumsum((0.5 * (x[1:] + x[:-1]) * (1 - 0.5 * (x[1:] + x[:-1]))) ** 4)]
    )
    up /= up[-1]
    times = np.concatenate(
        [x * track.run_in_s, track.run_in_s + track.cruise_s + x * track.run_out_s]
    )
    return times + 1e-12 * np.arange(times.size), np.concatenate([up, up[::-1]])


@every_track
def test_derivatives_are_those_of_the_position(track: Track) -> None:
    generator = np.random.default_rng(3)
    width = 0.12
    centres = generator.uniform(width, track.duration_s - width, 60)
    centres = centres[np.min(np.abs(centres[:, None] - joints(track)), axis=1) > width + 0.01]
    assert centres.size >= 5
    for centre in centres:
        nodes = centre + width * np.cos(np.pi * (np.arange(12) + 0.5) / 12)
        position, heading = orders(track.sample(nodes))
        exact_position, exact_heading = orders(track.sample(float(centre)))
        domain = (centre - width, centre + width)
        for axis in range(3):
            fit = Chebyshev.fit(nodes, position[0, :, axis], 11, domain=domain)
            for order, tolerance in ((1, 1e-7), (2, 1e-5), (3, 1e-3), (4, 5e-2)):
                numeric = fit.deriv(order)(centre)
                exact = exact_position[order, axis]
                assert abs(numeric - exact) <= tolerance * max(1.0, abs(exact)), (centre, order)
        fit = Chebyshev.fit(nodes, heading[0], 11, domain=domain)
        assert exact_heading[1] == pytest.approx(fit.deriv(1)(centre), abs=2e-4)
        assert exact_heading[2] == pytest.approx(fit.deriv(2)(centre), abs=2e-2)


@every_track
def test_continuous_to_snap_and_heading_acceleration_everywhere(track: Track) -> None:
    # a jump does not shrink with the step; what is continuous does. Sampled across every joint.
    for joint in joints(track):
        for step, allowance in ((1e-4, 0.35), (1e-6, 0.02)):
            before, after = track.sample(joint - step), track.sample(joint + step)
            for name, left, right in zip(
                FlatSample.__slots__, stacked(before), stacked(after), strict=True
            ):
                jump = np.max(np.abs(right - left))
                assert jump < allowance, f"{name} jumps by {jump} at {joint}"


@every_track
def test_rests_before_and_after(track: Track) -> None:
    for inside, outside in ((0.0, -3.0), (track.duration_s, track.duration_s + 100.0)):
        position, heading = orders(track.sample(outside))
        assert np.all(position[1:] == 0.0)
        assert np.all(heading[1:] == 0.0)
        edge_position, edge_heading = orders(track.sample(inside))
        np.testing.assert_allclose(edge_position, position, atol=1e-9)
        np.testing.assert_allclose(edge_heading, heading, atol=1e-9)


@every_track
def test_array_equals_loop(track: Track) -> None:
    times = np.linspace(-1.0, track.duration_s + 1.0, 30).reshape(2, 3, 5)
    batch = track.sample(times)
    assert batch.position_ned_m.shape == (2, 3, 5, 3)
    assert batch.heading_rad.shape == (2, 3, 5)
    for index in np.ndindex(times.shape):
        single = track.sample(float(times[index]))
        assert single.position_ned_m.shape == (3,)
        assert single.heading_rad.shape == ()
        for many, one in zip(stacked(batch), stacked(single), strict=True):
            np.testing.assert_allclose(many[index], one, rtol=1e-13, atol=1e-13)


@every_track
def test_scored_part_is_the_full_speed_part(track: Track) -> None:
    expected = along_path(track, np.linspace(0.0, track.duration_s, 200001))[-1]
    assert track.path_end_s == pytest.approx(expected, abs=2e-3)
    assert track.track_start_s == track.run_in_s
    times = np.linspace(track.track_start_s, track.track_end_s, 7)[1:-1]
    full_speed = track.path.jet(times - 0.5 * track.run_in_s)
    position, _ = orders(track.sample(times))
    np.testing.assert_allclose(position[1:], full_speed[1:], atol=1e-12)


def test_lemniscate_is_the_figure_of_eight_of_the_requirement() -> None:
    track = shipped("lemniscate")
    assert (track.track_start_s, track.track_end_s, track.duration_s) == (4.0, 20.0, 23.0)
    times = np.linspace(4.0, 20.0, 1601)
    sample = track.sample(times)
    omega, s = 2 * np.pi / 8, times - 2.0
    expected = np.stack([2 * np.sin(omega * s), np.sin(2 * omega * s), np.full_like(s, -3.0)], -1)
    np.testing.assert_allclose(sample.position_ned_m, expected, atol=1e-12)
    speed = np.linalg.norm(sample.velocity_ned_mps, axis=-1)
    assert speed.max() == pytest.approx(2 * math.sqrt(2) * omega, rel=1e-4)  # 2.22 m/s
    np.testing.assert_allclose(track.sample(0.0).position_ned_m, [0, 0, -3])


@pytest.mark.parametrize(
    ("name", "peak_mps"),
    [("lemniscate_4mps", 4.0), ("lemniscate_15s", 1.18), ("circle", 1.57), ("helix", 1.024)],
)
def test_shipped_peak_speeds(name: str, peak_mps: float) -> None:
    track = shipped(name)
    speed = np.linalg.norm(
        track.sample(np.linspace(0, track.duration_s, 4000)).velocity_ned_mps, axis=-1
    )
    assert speed.max() == pytest.approx(peak_mps, rel=0.005)


@pytest.mark.parametrize("name", SHIPPED)
@pytest.mark.parametrize("vehicle", sorted(p.stem for p in (CONFIG / "vehicles").glob("*.yaml")))
def test_shipped_references_are_feasible(name: str, vehicle: str) -> None:
    text = (CONFIG / "vehicles" / f"{vehicle}.yaml").read_text()
    envelope = check(shipped(name), parse(text, Vehicle, vehicle))
    assert envelope.tilt_max_rad < 0.62
    assert envelope.height_min_m == pytest.approx(5.0 if name == "lemniscate_4mps" else 3.0)


def test_heading_along_velocity_points_along_it_and_unwraps() -> None:
    track = track_of("circle", "along_velocity", laps=3)
    times = np.linspace(0.0, track.duration_s, 2301)
    sample = track.sample(times)
    moving = np.linalg.norm(sample.velocity_ned_mps, axis=-1) > 1e-6
    direction = sample.velocity_ned_mps[..., :2][moving]
    nose = np.stack([np.cos(sample.heading_rad), np.sin(sample.heading_rad)], -1)[moving]
    cross = nose[:, 0] * direction[:, 1] - nose[:, 1] * direction[:, 0]
    np.testing.assert_allclose(cross, 0.0, atol=1e-9)
    assert np.all(np.sum(nose * direction, axis=-1) > 0.0)
    # clockwise round three laps and the runs: through +-pi without a jump, 3 turns and 3.5 s more
    assert np.abs(np.diff(sample.heading_rad)).max() < 0.011
    turned = sample.heading_rad[-1] - sample.heading_rad[0]
    assert turned == pytest.approx(2 * np.pi * (3 + 3.5 / 8.0), abs=1e-9)


def test_heading_holds_where_the_path_stands_still() -> None:
    track = track_of("waypoints", "along_velocity")
    heading, path = track.heading, track.path
    assert isinstance(heading, AlongVelocity)
    assert heading.slow_s.shape == (2, 2)  # at both ends
    start, end = heading.slow_s[0]
    assert start == 0.0
    ends = np.array([0.0, path.length_s])
    np.testing.assert_allclose(heading.jet(ends, path.jet(ends))[1:], 0.0, atol=1e-9)
    speed = np.linalg.norm(path.jet(np.array([end]))[1, 0, :2])
    assert HOLD_SPEED_MPS <= speed < 2 * HOLD_SPEED_MPS
    position, jet = orders(track.sample(np.linspace(-1, track.duration_s + 1, 3000)))
    assert np.all(np.isfinite(position))
    assert np.all(np.isfinite(jet))
    assert np.abs(jet[1]).max() < 1.0


def test_heading_turns_smoothly_through_an_inner_stop() -> None:
    # out and back: the direction of motion jumps by pi where the path turns round
    back_and_forth = Harmonic(
        length_s=10.0, bounded=True, amplitude_ned_m=(2.0, 0, 0), omega_ned_radps=(0.5, 0, 0)
    )
    heading = along_velocity(back_and_forth, 10.0)
    s = np.linspace(0.0, 10.0, 100_001)
    jet = heading.jet(s, back_and_forth.jet(s))
    assert np.all(np.isfinite(jet))
    assert abs(abs(jet[0, -1] - jet[0, 0]) - 2 * np.pi) < 1e-9 or abs(jet[0, -1] - jet[0, 0]) < 1e-9
    np.testing.assert_allclose(np.gradient(jet[0], s)[2:-2], jet[1, 2:-2], atol=0.01)
    assert np.abs(np.diff(jet[0])).max() < 0.01


def test_a_path_without_horizontal_motion_keeps_its_heading() -> None:
    climb = Line(to_north_m=0, climb_m=5, speed_mps=1).path()
    assert along_velocity(climb, 5.0, 0.7) == Fixed(0.7)
    assert float(track_of("hover", "along_velocity").sample(3.0).heading_rad) == math.radians(30.0)


def test_waypoints_are_passed_at_their_times() -> None:
    times = [0.0, 3.0, 5.5, 8.0, 12.0]
    track = track_of("waypoints", "fixed", speed_mps=None, times_s=times, run_in_s=0, run_out_s=0)
    expected = np.array(POINTS) * (1, 1, -1) + (0, 0, -3)
    np.testing.assert_allclose(track.sample(np.array(times)).position_ned_m, expected, atol=1e-9)


@pytest.mark.parametrize(("minimise", "order"), [("jerk", 3), ("snap", 4)])
def test_waypoints_minimise_what_they_say(minimise: str, order: int) -> None:
    """Any admissible bump (zero at the points, flat at the ends) makes the integral larger."""
    times = np.array([0.0, 3.0, 5.5, 8.0, 12.0])
    track = track_of(
        "waypoints", "fixed", speed_mps=None, times_s=times.tolist(), minimise=minimise,
        run_in_s=0, run_out_s=0,
    )  # fmt: skip
    path: FlatPath = track.path
    nodes, node_weights = np.polynomial.legendre.leggauss(20)  # exact on every piece
    half = 0.5 * np.diff(times)[:, np.newaxis]
    s = (times[:-1, np.newaxis] + half * (nodes + 1.0)).ravel()
    weights = (half * node_weights).ravel()
    derivative = path.jet(s)[order]
    for axis in range(3):
        for seed in range(3):
            factor = np.random.default_rng(seed).normal(size=3)
            bump = np.polynomial.Polynomial.fromroots([*times, *[0.0] * 3, *[12.0] * 3])
            bump *= np.polynomial.Polynomial(factor)
            bump /= np.abs(bump(s)).max()
            change = bump.deriv(order)(s)
            # stationary: the first variation vanishes; the second is positive by itself
            first = np.sum(weights * derivative[:, axis] * change)
            scale = np.sqrt(
                np.sum(weights * derivative[:, axis] ** 2) * np.sum(weights * change**2)
            )
            assert abs(first) < 1e-9 * scale


@pytest.mark.parametrize(
    ("shape", "settings", "sentence"),
    [
        ("line", {"to_north_m": 1.0}, "run-in and run-out .* only 0.667 s long"),
        ("line", {"run_in_s": 0.0}, "without a run-in the path must be at rest"),
        ("circle", {"run_out_s": 0.0}, "without a run-out the path must be at rest"),
        ("line", {"to_north_m": 0.0}, "longer than zero"),
    ],
)
def test_impossible_tracks_are_refused(
    shape: str, settings: dict[str, float], sentence: str
) -> None:
    with pytest.raises(ValueError, match=sentence):
        track_of(shape, "fixed", **settings)


@pytest.mark.parametrize(
    ("settings", "sentence"),
    [
        ({"shape": "circle", "radius": 2}, "Extra inputs"),
        ({"shape": "circle", "radius_m": -1}, "greater than 0.05"),
        ({"shape": "circle", "course": "table"}, "fixed"),
        ({"shape": "lemniscate", "period_s": "soon"}, "valid number"),
        ({"shape": "hover", "run_in_s": 2}, "Input should be 0"),
        ({"shape": "waypoints", "points_m": POINTS}, "one of speed_mps and times_s"),
        (
            {"shape": "waypoints", "points_m": [[0, 0, 0], [0, 0, 0]], "speed_mps": 1},
            "points 1 and 2 are the same place",
        ),
        (
            {"shape": "waypoints", "points_m": [[0, 0, 0], [1, 0, 0]], "times_s": [0, 0]},
            "must start at 0 and increase",
        ),
        (
            {"shape": "waypoints", "points_m": [[0, 0, 0], [1, 0, 0]], "times_s": [0, 1, 2]},
            "2 points need as many times",
        ),
    ],
)
def test_wrong_configuration_is_refused(settings: dict[str, object], sentence: str) -> None:
    with pytest.raises(ValidationError, match=sentence):
        SHAPES[str(settings["shape"])](**settings)


@pytest.mark.parametrize("name", SHAPES)
def test_every_shape_has_the_name_of_its_row(name: str) -> None:
    assert SHAPES[name](**NEEDED.get(name, {})).shape == name
