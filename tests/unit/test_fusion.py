"""Own position fusion: accuracy against theory, smooth changes of the estimate, wrong fixes.

The vehicle here is exact: its thrust and attitude are those of an analytic motion, its estimate
is off by a slow wave, its receiver by white noise. None of it is made by the code under test.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import pytest
from scipy.linalg import solve_continuous_are

from offboard.estimation.fusion import Fusion
from offboard.estimation.fusion_filter import FusionSettings
from offboard.model.command import Command
from offboard.model.geodesy import Geodetic
from offboard.model.vehicle import AxisResponse, Vehicle

G, DRAG = 9.80665, 1.0
VEHICLE = Vehicle(
    name="exact",
    mass_kg=1.0,
    inertia_kgm2=(0.025, 0.025, 0.03),
    drag_translation_npmps=(DRAG, DRAG, DRAG),
    drag_rotation_nmpradps=(0.02, 0.02, 0.02),
    hover_thrust=0.5,
    tilt=AxisResponse(delay_s=0.05, natural_frequency_radps=11.0, damping=0.6),
    yaw=AxisResponse(delay_s=0.15, natural_frequency_radps=3.0, damping=0.4),
)
ORIGIN = Geodetic(0.0, 0.0, 100.0)  # on the equator degrees are metres both ways
DEGREE_M = math.radians(1.0) * 6_371_000.0
SETTINGS = FusionSettings()
STEP_S, FIX_EVERY = 0.01, 12


def motion(time_s: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Position, velocity, acceleration: a figure of eight in 8 s."""
    w = 2 * math.pi / 8.0
    scale, turns = np.array([2.0, 1.0, 0.3]), np.array([w, 2 * w, w])
    phase = turns * time_s + [0.0, 0.0, 1.0]
    return (
        scale * np.sin(phase) - [0.0, 0.0, 3.0],
        scale * turns * np.cos(phase),
        -scale * turns**2 * np.sin(phase),
    )


def place_of(position: np.ndarray) -> Geodetic:
    north, east, down = position
    return Geodetic(north / DEGREE_M, east / DEGREE_M, 100.0 - down)


@dataclass
class Trial:
    """One flight of the fusion: rows of time, truth, reported and followed position."""

    fusion: Fusion
    settings: FusionSettings
    rng: np.random.Generator
    delay_s: float = 0.0
    quiet: bool = False
    fixes: Callable[[float], np.ndarray | None] = lambda time_s: np.zeros(3)
    push_mps2: np.ndarray = field(default_factory=lambda: np.zeros(3))
    rows: list[np.ndarray] = field(default_factory=list)
    velocities: list[np.ndarray] = field(default_factory=list)
    time_s: float = 100.0

    def fly(self, duration_s: float) -> Trial:
        for _ in range(round(duration_s / STEP_S)):
            self._step()
        return self

    def _step(self) -> None:
        self.time_s += STEP_S
        position, velocity, acceleration = motion(self.time_s)
        pull = np.array([0.0, 0.0, G]) - acceleration - DRAG * velocity + self.push_mps2
        thrust = float(np.linalg.norm(pull))
        down = pull / thrust
        # quaternion of the shortest rotation from z to `down`
        w, x, y = np.array([1.0 + down[2], -down[1], down[0]]) / math.sqrt(2.0 + 2.0 * down[2])
        self.fusion.on_command(self.time_s - STEP_S / 2, Command(thrust, (0.0, 0.0, 1.0), 0.0))
        self.fusion.on_attitude(self.time_s, (w, x, y, 0.0))
        if round(self.time_s / STEP_S) % FIX_EVERY == 0:
            self._fix()
        wave = np.sin(2 * math.pi * self.time_s / np.array([7.0, 9.0, 11.0]))
        reported = position + 0.5 * wave
        followed, moving = self.fusion.follow(self.time_s, tuple(reported), tuple(velocity))
        self.rows.append(np.array([self.time_s, *position, *reported, *followed]))
        self.velocities.append(np.array(moving) - velocity)

    def _fix(self) -> None:
        off = self.fixes(self.time_s)
        if off is None:
            return
        position, velocity, _ = motion(self.time_s - self.delay_s)
        sds = np.array([self.settings.position_sd_m] * 2 + [self.settings.height_sd_m])
        noise = self.rng.normal(size=5) * (0.0 if self.quiet else 1.0)
        speed = velocity[:2] + self.settings.velocity_sd_mps * noise[3:]
        place = place_of(position + off + sds * noise[:3])
        self.fusion.on_fix(self.time_s, place, (speed[0], speed[1]), 0.9)

    @property
    def table(self) -> np.ndarray:
        return np.array(self.rows)

    def off_m(self, last_s: float) -> np.ndarray:
        """Followed less true position (N, 3) over the last seconds."""
        rows = self.table[-round(last_s / STEP_S) :]
        difference: np.ndarray = rows[:, 7:10] - rows[:, 1:4]
        return difference


def trial(seed: int = 1, settings: FusionSettings = SETTINGS, **more: object) -> Trial:
    """Three seconds frozen as on the ground, then flying."""
    fusion = Fusion(VEHICLE, settings)
    fusion.on_origin(ORIGIN, from_vehicle=True)
    made = Trial(fusion, settings, np.random.default_rng(seed), **more)  # type: ignore[arg-type]
    made.fly(3.0)
    fusion.freeze(False)
    return made


def steady_sd_m(sd_m: float, drift: float, speed_sd: float | None) -> float:
    """Least possible sd: the continuous Riccati equation with a fix every 0.12 s."""
    dynamics = np.array([[0.0, 1.0, 0.0], [0.0, -DRAG, 1.0], [0.0, 0.0, 0.0]])
    seen = np.eye(3)[: 1 if speed_sd is None else 2]
    sds = [sd_m] if speed_sd is None else [sd_m, speed_sd]
    noise = np.diag(np.square(sds)) * FIX_EVERY * STEP_S
    drive = np.diag([0.0, (0.2 * drift) ** 2, drift**2])
    return math.sqrt(solve_continuous_are(dynamics.T, seen.T, drive, noise)[0, 0])


def test_error_is_the_least_possible() -> None:
    squares = np.array([np.mean(trial(s).fly(40.0).off_m(30.0) ** 2, axis=0) for s in (1, 2, 3)])
    rms = np.sqrt(squares.mean(axis=0))
    lateral = steady_sd_m(0.2, SETTINGS.lateral_drift_mps2, SETTINGS.velocity_sd_mps)
    vertical = steady_sd_m(0.5, SETTINGS.vertical_drift_mps2, None)
    assert lateral == pytest.approx(0.044, abs=0.003)
    assert vertical == pytest.approx(0.14, abs=0.01)
    # 90 s hold some fifty independent errors: their deviation is known to a tenth
    assert math.hypot(*rms[:2]) / math.sqrt(2.0) == pytest.approx(lateral, rel=0.15)
    assert rms[2] == pytest.approx(vertical, rel=0.2)


def test_constant_disturbance_is_estimated() -> None:
    flown = trial()
    flown.push_mps2 = np.array([0.8, -0.5, 0.6])
    flown.fly(40.0)
    assert np.abs(flown.off_m(20.0).mean(axis=0)).max() < 0.06


@pytest.mark.parametrize(
    ("configured_s", "most_m", "least_m"), [(0.15, 0.01, 0.0), (0.0, 0.4, 0.1)]
)
def test_fixes_are_compared_with_the_state_at_their_time(
    configured_s: float, most_m: float, least_m: float
) -> None:
    settings = SETTINGS.model_copy(update={"delay_s": configured_s})
    flown = trial(settings=settings, delay_s=0.15, quiet=True).fly(40.0)
    off_m = math.sqrt(np.mean(flown.off_m(16.0)[:, :2] ** 2))
    assert least_m <= off_m < most_m


def test_smooth_from_start_to_end() -> None:
    """Fusion begins, is corrected, ends and begins again: the position never steps."""
    flown = trial(fixes=lambda time_s: None if 120 < time_s < 125 else np.zeros(3)).fly(40.0)
    table = flown.table
    steps = np.diff(table[:, 7:10] - table[:, 1:4], axis=0)
    assert np.abs(steps).max() < 0.015  # one metre over two seconds
    news = flown.fusion.news
    assert ["own position fusion in use" in s for s in news] == [True, False, True]
    assert news[1] == "no usable GPS fix for 1 s: using the vehicle's estimate"
    at = table[:, 0]
    after_fusion = table[(at > 124.0) & (at < 125.0)]
    # Followed for three seconds, with a hand-over of two
    assert np.abs(after_fusion[:, 7:10] - after_fusion[:, 4:7]).max() < 0.35
    assert np.abs(flown.off_m(8.0)).max() < 0.45


@pytest.mark.parametrize("size_m", [3.0, 60.0])
def test_fixes_that_jump_are_not_used(size_m: float) -> None:
    jump = np.array([size_m, 0.0, 0.0])
    flown = trial(fixes=lambda time_s: jump * (time_s > 120.0)).fly(16.9)
    assert flown.fusion.fused
    flown.fly(10.0)
    table = flown.table
    around = (table[:, 0] > 110.0) & (table[:, 0] < 121.0)
    assert np.abs(table[:, 7] - table[:, 1])[around].max() < 0.15
    assert "no usable GPS fix for 1 s: using the vehicle's estimate" in flown.fusion.news
    if size_m > SETTINGS.disagreement_m:  # else the vehicle may be the one that is wrong
        assert not flown.fusion.fused
        assert np.abs(table[-1, 7] - table[-1, 4]) < 0.01
        assert "m from the vehicle's estimate: not fused" in flown.fusion.news[-1]
        assert len(flown.fusion.news) == 3


def test_a_single_wild_fix_changes_nothing() -> None:
    plain = trial().fly(30.0).table
    wild = trial(fixes=lambda t: np.full(3, 500.0 if 119.99 < t < 120.1 else 0.0)).fly(30.0).table
    assert np.abs(wild - plain)[:, 7:10].max() < 0.25
    assert np.abs(wild - plain)[-500:, 7:10].max() < 0.01


def test_vehicles_estimate_is_used_on_the_ground_and_without_fixes() -> None:
    fusion = Fusion(VEHICLE, SETTINGS)
    grounded = Trial(fusion, SETTINGS, np.random.default_rng(1)).fly(5.0)
    assert np.array_equal(grounded.table[:, 4:7], grounded.table[:, 7:10])
    fusion = Fusion(VEHICLE, SETTINGS)
    fusion.freeze(False)
    blind = Trial(fusion, SETTINGS, np.random.default_rng(1), fixes=lambda time_s: None).fly(5.0)
    assert np.array_equal(blind.table[:, 4:7], blind.table[:, 7:10])
    assert not fusion.news


def test_without_an_origin_the_first_fix_is_matched_to_the_estimate() -> None:
    fusion = Fusion(VEHICLE, SETTINGS)
    made = Trial(fusion, SETTINGS, np.random.default_rng(1), quiet=True).fly(3.0)
    matched = made.table[FIX_EVERY * 1 : FIX_EVERY * 3]
    fusion.freeze(False)
    made.fly(30.0)
    off = made.off_m(8.0).mean(axis=0)  # by what the estimate was off at the first fix
    errors = matched[:, 4:7] - matched[:, 1:4]
    assert np.abs(off - errors.mean(axis=0)).max() < 0.1
    fusion.on_origin(Geodetic(1.0, 1.0, 1.0), from_vehicle=False)
    fusion.on_origin(ORIGIN, from_vehicle=True)
    fusion.on_origin(Geodetic(2.0, 2.0, 2.0), from_vehicle=False)
    made.fly(20.0)
    assert np.abs(made.off_m(8.0)).max() < 0.05


def test_inaccurate_and_old_fixes_are_not_used() -> None:
    flown = trial().fly(10.0)
    before = flown.fusion._fixed_s
    here = place_of(motion(flown.time_s)[0])
    flown.fusion.on_fix(flown.time_s, here, None, 5.1)  # claims no better than 5.1 m
    flown.fusion.on_fix(before, here, None, 0.9)  # repeats itself
    flown.fusion.on_fix(before - 5.0, here, None, 0.9)  # of long ago
    assert flown.fusion._fixed_s == before


def test_fix_with_a_stamp_far_ahead_does_not_affect_later_fixes() -> None:
    plain, spoilt = trial().fly(20.0), trial().fly(20.0)
    here = place_of(motion(spoilt.time_s - spoilt.delay_s)[0])
    spoilt.fusion.on_fix(spoilt.time_s + 3600.0, here, None, 0.9)
    difference = (spoilt.fly(30.0).table - plain.fly(30.0).table)[:, 7:10]
    assert spoilt.fusion.fused
    assert np.abs(difference).max() < 0.25
    assert np.abs(difference[-500:]).max() < 0.01
    assert spoilt.fusion.news == plain.fusion.news


@pytest.mark.parametrize(
    "silence_s", [1.1, 4e6]
)  # without new attitudes the prediction is worthless
def test_vehicles_estimate_is_used_after_a_gap_of_the_attitude(silence_s: float) -> None:
    flown = trial().fly(20.0)
    assert flown.fusion.fused
    flown.fusion.on_attitude(flown.time_s + silence_s, (1.0, 0.0, 0.0, 0.0))
    assert not flown.fusion.fused
    assert flown.fusion.news[-1] == "no attitude for 1 s: using the vehicle's estimate"


def test_result_is_always_finite() -> None:
    flown = trial().fly(5.0)
    flown.fusion.on_command(flown.time_s, Command(math.inf, (0.0, 0.0, 1.0), 0.0))
    flown.fly(1.0)
    assert np.isfinite(flown.table).all()
    assert "not finite" in flown.fusion.news[-1]
    flown.fusion.reset()
    flown.fusion.on_origin(ORIGIN, from_vehicle=True)
    flown.fly(3.0)
    flown.fusion.freeze(False)
    flown.fly(20.0)
    assert flown.fusion.fused
    assert np.abs(flown.off_m(8.0)).max() < 0.5
