"""Every shape and every shipped reference: derivatives, rest, arrays, run-in, pauses."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import pytest
from numpy.typing import NDArray

from offboard.documents import shipped
from offboard.reference.base import FlatSample
from offboard.reference.fastest import PathLimits, fastest_times
from offboard.reference.feasibility import check
from offboard.reference.path import AlongVelocity, Harmonic, Sine, Smoothness, Spline, through
from offboard.reference.shapes import SHAPES, Line
from offboard.reference.track import STOP_S, Moved, Track
from offboard.run.configuration import load
from simulator import config

Array = NDArray[np.float64]

TABLE = "time_s,north_m,east_m,altitude_m,course_deg\n" + "".join(
    f"{0.5 * k},{math.sin(0.4 * k)},{math.cos(0.3 * k)},{2 + 0.1 * k},{(340 + 20 * k) % 360}\n"
    for k in range(25)
)
POINTS = [[0, 0, 0], [3, 1, 0.5], [4, 4, 1], [1, 5, 0.5], [0, 2, 0]]
NEEDED: dict[str, dict[str, object]] = {
    "sines": {"north": ((1.0, 1, 90.0),), "east": ((1.0, 1, 0.0),)},
    "waypoints": {"points_m": POINTS, "speed_mps": 1.2},
    "table": {"file": "flown.csv", "text": TABLE},
}


def track_of(shape: str, heading: str, **settings: object) -> Track:
    values: dict[str, object] = {"course": heading, "course_deg": 30.0}
    return SHAPES[shape](**values | NEEDED.get(shape, {}) | settings).track()


def shipped_track(name: str) -> Track:
    return load("flight", choices={"reference": name}).reference.track()


TRACKS = {shape: track_of(shape, "along_velocity") for shape in SHAPES} | {
    "line-fixed": track_of("line", "fixed"),
    "table-table": track_of("table", "table"),
    "waypoints-jerk": track_of("waypoints", "along_velocity", minimise="jerk"),
}


def orders(sample: FlatSample) -> tuple[Array, Array]:
    """Position to snap (5, ..., 3) and heading to its acceleration (3, ...)."""
    return np.stack(sample[:5]), np.stack(sample[5:])


@pytest.mark.parametrize("track", TRACKS.values(), ids=TRACKS.keys())
def test_tracks_have_consistent_derivatives_and_begin_and_end_at_rest(track: Track) -> None:
    """Each derivative is the central difference of the order below and has no jump, the track is at
    rest before and after, and arrays give the same as loops."""
    drawn = np.random.default_rng(3).uniform(0.12, track.duration_s - 0.12, 60)
    here, after, before = (orders(track.sample(drawn + by)) for by in (0.0, 1e-5, -1e-5))
    grid = orders(track.sample(np.linspace(-0.5, track.duration_s + 0.5, 20_001)))
    for kind in range(2):  # position and heading
        numeric = (after[kind] - before[kind]) / 2e-5
        np.testing.assert_allclose(here[kind][1:], numeric[:-1], rtol=1e-6, atol=2e-4)
        assert np.abs(np.diff(grid[kind], axis=1)).max() < 0.3  # of a jump, at any step
        for inside, outside in ((0.0, -3.0), (track.duration_s, track.duration_s + 100.0)):
            rest, edge = (orders(track.sample(each))[kind] for each in (outside, inside))
            assert np.all(rest[1:] == 0.0)
            np.testing.assert_allclose(edge, rest, atol=1e-9)
    times = np.linspace(-1.0, track.duration_s + 1.0, 6).reshape(1, 2, 3)
    batch = track.sample(times)
    assert (batch.position_ned_m.shape, batch.heading_rad.shape) == ((1, 2, 3, 3), (1, 2, 3))
    for index in np.ndindex(times.shape):
        single = track.sample(float(times[index]))
        assert single.heading_rad.shape == ()
        for many, one in zip(batch, single, strict=True):
            np.testing.assert_allclose(many[index], one, rtol=1e-13, atol=1e-13)
    full_speed = np.linspace(track.track_start_s, track.track_end_s, 7)[1:-1]
    expected = track.path.jet(full_speed - 0.5 * track.run_in_s)[1:, :, :3]
    np.testing.assert_allclose(orders(track.sample(full_speed))[0][1:], expected, atol=1e-12)
    middle_s = track.run_in_s + 0.5 * track.cruise_s
    assert track.path_time_s(middle_s) == pytest.approx(middle_s - 0.5 * track.run_in_s)


def test_paused_reference_rests_on_its_path_and_resumes() -> None:
    began_s, paused_s, resumed_s = 100.0, 108.3, 115.0
    track = shipped_track("lemniscate_course")
    paused = Moved(track, began_s, (10.0, -5.0, 2.0), paused_s).resumed(resumed_s)
    times_s = np.linspace(105.0, 125.0, 20_001)
    for jet in orders(paused.sample(times_s)):
        for below, above in pairwise(jet):
            slope = np.gradient(below, times_s, axis=0)[5:-5]
            np.testing.assert_allclose(slope, above[5:-5], atol=3e-4)
    rest = paused.sample(np.array([paused_s + STOP_S, 112.0, resumed_s]))
    assert np.abs(rest.velocity_ned_mps).max() < 1e-9
    at_s = paused.own_s(112.0)
    assert at_s == pytest.approx(paused_s + STOP_S / 2 - began_s)
    moved = np.array((10.0, -5.0, 2.0))
    own = track.sample(at_s).position_ned_m + moved
    np.testing.assert_allclose(rest.position_ned_m, [own] * 3, atol=1e-9)
    again_s = resumed_s + STOP_S + 1.0
    assert not paused.at_full_speed(again_s - 1.1)
    assert paused.at_full_speed(again_s)
    later = track.sample(again_s - began_s - (resumed_s - paused_s)).position_ned_m + moved
    np.testing.assert_allclose(paused.sample(again_s).position_ned_m, later, atol=1e-8)
    before = track.sample(7.0).position_ned_m + moved
    np.testing.assert_allclose(paused.sample(107.0).position_ned_m, before, atol=1e-8)
    twice = Moved(paused, paused_s=116.0)  # while the reference gains speed
    assert twice.own_s(1000.0) == pytest.approx(paused.own_s(116.0 + STOP_S / 2))
    assert paused.duration_s == began_s + track.duration_s + resumed_s - paused_s


def test_shipped_references_are_feasible_and_have_their_peak_speeds() -> None:
    fleet = [config.vehicle(name) for name in shipped.names("vehicle")]
    names = shipped.names("reference")
    peaks_mps = {"lemniscate_4mps": 4.0, "lemniscate_15s": 1.18, "circle": 1.57, "helix": 1.024}
    lowest_m = {"lemniscate_4mps": 5.0, "circle_vertical": 2.65, "trefoil": 1.5, "spiral": 1.5}
    lowest_m["racing"] = 3.72
    assert peaks_mps.keys() | lowest_m.keys() < set(names)
    for name in names:
        track = shipped_track(name)
        for vehicle in fleet:
            assert check(track, vehicle).tilt_rad < 0.62
        sample = track.sample(np.arange(0.0, track.duration_s, 0.01))
        lowest = -sample.position_ned_m[:, 2].max()
        assert lowest == pytest.approx(lowest_m.get(name, 3.0), abs=0.005)
        if name in peaks_mps:
            speed_mps = np.linalg.norm(sample.velocity_ned_mps, axis=-1).max()
            assert speed_mps == pytest.approx(peaks_mps[name], rel=0.005)


def test_shipped_curves_match_their_published_formulas() -> None:
    """Curves of quad_trajectories and ours, as north, east and height by time at full speed."""
    s = np.linspace(3.0, 50.0, 400)
    trefoil, w = shipped_track("trefoil"), math.tau * s / 25.0
    height_m, progress = 2.25 + 0.75 * np.sin(3 * w), 0.5 - 0.5 * np.cos(math.tau * s / 55.0)
    spiral, turned = shipped_track("spiral"), 6.0 * math.pi * progress
    circle, v, u = shipped_track("circle_vertical"), math.tau * s / 13.0, math.tau * s / 8.0
    published = (
        (trefoil, 0.6 * (np.sin(w) + 2 * np.sin(2 * w)), 0.6 * (np.cos(w) - 2 * np.cos(2 * w)),
         height_m),
        (spiral, 1.5 * np.cos(turned), 1.5 * np.sin(turned), 1.5 + 1.5 * progress),
        (circle, 0.35 * np.cos(v), 0.0 * v, 3.0 + 0.35 * np.sin(v)),
        (shipped_track("lemniscate"), 2.0 * np.sin(u), np.sin(2.0 * u), 3.0 + 0.0 * u),
    )  # fmt: skip
    for track, north_m, east_m, up_m in published:
        flown_m = track.sample(s + 0.5 * track.run_in_s).position_ned_m
        inside = s < track.path.length_s - 0.5 * track.run_out_s
        expected_m = np.column_stack((north_m, east_m, -up_m))
        np.testing.assert_allclose(flown_m[inside], expected_m[inside], atol=0.001)


def test_heading_along_velocity_is_tangential_and_unwrapped() -> None:
    track = track_of("circle", "along_velocity", laps=3)
    times = np.linspace(0.0, track.duration_s, 2301)
    sample = track.sample(times)
    moving = np.linalg.norm(sample.velocity_ned_mps, axis=-1) > 1e-6
    direction = sample.velocity_ned_mps[..., :2][moving]
    nose = np.stack([np.cos(sample.heading_rad), np.sin(sample.heading_rad)], -1)[moving]
    cross = nose[:, 0] * direction[:, 1] - nose[:, 1] * direction[:, 0]
    np.testing.assert_allclose(cross, 0.0, atol=1e-9)
    assert np.all(np.sum(nose * direction, axis=-1) > 0.0)
    # three laps clockwise, run-in and run-out: no jump at +-pi; 3 turns and 3.5 s of one more
    assert np.abs(np.diff(sample.heading_rad)).max() < 0.011
    turned = sample.heading_rad[-1] - sample.heading_rad[0]
    assert turned == pytest.approx(2 * np.pi * (3 + 3.5 / 8.0), abs=1e-9)


def test_heading_turns_smoothly_through_an_inner_stop() -> None:
    # out and back: the direction of motion jumps by pi where the path turns round
    sine = Sine((2.0, 0.0, 0.0), (0.5, 0.0, 0.0))
    back_and_forth = Harmonic(length_s=10.0, bounded=True, sines=(sine,))
    heading = AlongVelocity(back_and_forth, 10.0)
    s = np.linspace(0.0, 10.0, 100_001)
    jet = heading.jet(s, back_and_forth.jet(s))
    assert np.all(np.isfinite(jet))
    assert math.remainder(jet[0, -1] - jet[0, 0], math.tau) == pytest.approx(0.0, abs=1e-9)
    np.testing.assert_allclose(np.gradient(jet[0], s)[2:-2], jet[1, 2:-2], atol=0.01)
    assert np.abs(np.diff(jet[0])).max() < 0.01


def test_a_path_without_horizontal_motion_keeps_its_heading() -> None:
    climb = Line(to_north_m=0, climb_m=5, speed_mps=1).path()
    s = np.linspace(0.0, 5.0, 100)
    heading = AlongVelocity(climb, 5.0, 0.7).jet(s, climb.jet(s))
    np.testing.assert_allclose(heading, np.outer((0.7, 0.0, 0.0), np.ones(100)), atol=1e-12)
    assert float(track_of("hover", "along_velocity").sample(3.0).heading_rad) == pytest.approx(
        math.radians(30.0)
    )


@pytest.mark.parametrize(("minimise", "order"), [("jerk", 3), ("snap", 4)])
def test_waypoint_paths_minimise_jerk_or_snap(minimise: str, order: int) -> None:
    """The first variation of the integral vanishes for an admissible bump (zero at the points, flat
    at the ends); the second is positive by itself."""
    times = np.array([0.0, 3.0, 5.5, 8.0, 12.0])
    path = track_of(
        "waypoints", "fixed", speed_mps=None, times_s=times.tolist(), minimise=minimise,
        run_in_s=0, run_out_s=0,
    ).path  # fmt: skip
    nodes, weights = np.polynomial.legendre.leggauss(20)  # exact on every piece
    half = 0.5 * np.diff(times)[:, None]
    s, weights = (times[:-1, None] + half * (nodes + 1.0)).ravel(), (half * weights).ravel()
    bump = np.polynomial.Polynomial.fromroots([*times, *[0.0] * 3, *[12.0] * 3])
    bump *= np.polynomial.Polynomial(np.random.default_rng(0).normal(size=3))
    change, derivative = bump.deriv(order)(s), path.jet(s)[order]
    first, scale = weights * change @ derivative, np.sqrt(weights @ derivative**2)
    assert np.all(np.abs(first) < 1e-9 * scale * np.sqrt(weights @ change**2))


@pytest.mark.parametrize(
    ("settings", "sentence"),
    [
        (
            {"shape": "line", "to_north_m": 1.0},
            "run-in and run-out .* only 0.667 s long; lower run_in_s",
        ),
        ({"shape": "line", "run_in_s": 0.0}, "without a run-in the path must be at rest"),
        ({"shape": "circle", "run_out_s": 0.0}, "without a run-out the path must be at rest"),
        ({"shape": "line", "to_north_m": 0.0}, "longer than zero"),
        ({"shape": "waypoints", "points_m": POINTS}, "one of speed_mps, times_s and fastest"),
        (
            {"shape": "waypoints", "points_m": [[0, 0, 0], [0, 0, 0]], "speed_mps": 1},
            "points 1 and 2 are at the same place",
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
def test_invalid_reference_settings_are_refused(settings: dict[str, object], sentence: str) -> None:
    with pytest.raises(ValueError, match=sentence):
        SHAPES[str(settings["shape"])](**settings).track()


# --- the fastest times through waypoints ----------------------------------------------------------


CORNERS = ((0.0, 0.0, 0.0), (8.0, 3.0, 1.0), (12.0, 10.0, 3.0), (4.0, 12.0, 1.0), (0.0, 4.0, 2.0))
NED = np.array(CORNERS) * (1.0, 1.0, -1.0)
GRAVITY, DRAG = np.array([0.0, 0.0, 9.80665]), 0.3
LIMITS = PathLimits(
    speed_mps=8.0, thrust_mps2=14.0, tilt_deg=35.0, tilt_rate_dps=90.0, drag_per_mass_ps=DRAG
)


def shares(path: Spline) -> tuple[float, float, float, float]:
    """Greatest speed, thrust, tilt and turn rate of the thrust, each divided by its limit, from
    positions alone, by differences on a fine grid."""
    s, step_s = np.linspace(0.0, path.length_s, 40_001, retstep=True)
    position = path.jet(s)[0]
    velocity = np.gradient(position, step_s, axis=0)[3:-3]
    thrust = GRAVITY - np.gradient(velocity, step_s, axis=0) - DRAG * velocity
    size = np.linalg.norm(thrust, axis=1)[3:-3]
    direction = thrust[3:-3] / size[:, None]
    turned = np.linalg.norm(np.diff(direction, axis=0), axis=1) / step_s
    return (
        float(np.linalg.norm(velocity, axis=1).max() / LIMITS.speed_mps),
        float(size.max() / LIMITS.thrust_mps2),
        float(np.degrees(np.arccos(direction[:, 2])).max() / LIMITS.tilt_deg),
        float(np.degrees(turned).max() / LIMITS.tilt_rate_dps),
    )


@pytest.mark.parametrize("smoothness", [Smoothness.SNAP, Smoothness.JERK])
def test_fastest_path_keeps_its_limits_and_cannot_be_shortened(
    smoothness: Smoothness,
) -> None:
    times_s = fastest_times(CORNERS, smoothness, LIMITS)
    path = through(NED, times_s, smoothness)
    assert path.jet(times_s)[0] == pytest.approx(NED, abs=1e-9)
    assert 0.98 < max(shares(path)) < 1.01
    for leg in range(len(CORNERS) - 1):
        legs_s = np.diff(times_s)
        legs_s[leg] *= 0.95
        shorter = through(NED, np.append(0.0, np.cumsum(legs_s)), smoothness)
        assert max(shares(shorter)) > 1.01, leg
