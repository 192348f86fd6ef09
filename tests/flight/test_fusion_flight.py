"""Flights with `estimate: fused`: nearer to the truth than the vehicle's own estimate, and
undisturbed when the GPS receiver fails."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from pair import LEAN, Pair, in_phase, make

from offboard.analysis import history
from offboard.flight.phases import ExitCode, Phase
from simulator.firmware.px4 import PX4

LQR = "controller={law: lqr, bandwidth_radps: 5.0}"
FUSED = ("estimate=fused", LQR)
SEEDS = range(1, 8)
FIXES_HZ = {"GPS_RAW_INT": PX4.streams.companion_rates_hz["GPS_RAW_INT"]}
RATES_HZ = {**LEAN.streams.companion_rates_hz, **FIXES_HZ}
WITH_RECEIVER = replace(LEAN, streams=replace(LEAN.streams, companion_rates_hz=RATES_HZ))


def flight(*assignments: str, **more: object) -> Pair:
    return make(*assignments, scenario="px4_like", firmware=WITH_RECEIVER, **more)  # type: ignore[arg-type]


def truth_and_estimate_m(pair: Pair, directory: Path) -> tuple[float, float]:
    """RMS distance while tracking: truth to reference, and the vehicle's own estimate to truth."""
    flown = history.gather(pair.log(directory))
    begun = {phase: at_s for at_s, phase in pair.phases}
    rows = flown.position[flown.position[:, 0] > begun[Phase.TRACK]]
    rows = rows[rows[:, 0] < begun[Phase.HOVER]]
    truth = np.stack([np.interp(rows[:, 0], flown.truth[:, 0], x) for x in flown.truth[:, 1:].T])
    away = np.linalg.norm(rows[:, 1:4] - truth.T, axis=1)
    return pair.score(directory / "again").rmse_truth_m, float(np.sqrt(np.mean(away**2)))


def test_error_is_half_that_of_the_vehicles_estimate(tmp_path: Path) -> None:
    """A flight that follows the vehicle's estimate has its error."""
    flown = []
    for seed in SEEDS:
        pair = flight(*FUSED, seed=seed)
        pair.track()
        assert any("own position fusion in use" in line for line in pair.companion.announced)
        flown.append(truth_and_estimate_m(pair, tmp_path / str(seed)))
    by_fusion_m, by_estimate_m = np.sqrt(np.mean(np.square(flown), axis=0))
    assert max(own for own, _ in flown) < 0.25
    assert by_fusion_m < 0.5 * by_estimate_m


def test_a_reported_position_that_stands_still_ends_the_flight() -> None:
    """Although fixes still arrive, with which the fused position would go on."""
    pair = make(*FUSED, scenario="frozen_position", firmware=WITH_RECEIVER, seed=1)
    outcome = pair.fly()
    assert outcome.exit_code == ExitCode.ABORTED
    assert outcome.sentence.startswith("no LOCAL_POSITION_NED for 0.")
    assert any("own position fusion in use" in line for line in pair.companion.announced)


def test_without_fusion_the_vehicles_estimate_is_followed(tmp_path: Path) -> None:
    pair = flight(LQR, seed=1)
    pair.track()
    score = pair.score(tmp_path / "score")
    by_truth_m, estimate_m = truth_and_estimate_m(pair, tmp_path)
    assert by_truth_m == pytest.approx(estimate_m, rel=0.1)
    assert score.rmse_position_m < 0.05 < 0.2 < by_truth_m
    assert not [line for line in pair.companion.announced if "GPS" in line]


def largest_tilt_rad(pair: Pair) -> float:
    """The largest tilt commanded while tracking."""
    sent = [setpoint for _, phase, setpoint in pair.setpoints if phase is Phase.TRACK]
    return max(2.0 * math.asin(math.hypot(s.q[1], s.q[2])) for s in sent)


def test_flight_continues_when_the_receiver_jumps(tmp_path: Path) -> None:
    def jump(pair: Pair) -> None:
        pair.instance.autopilot.plant.shift_fixes((30.0, 0.0, 0.0))

    undisturbed = flight(*FUSED, "reference.laps=1", seed=3)
    undisturbed.track()
    pair = flight(*FUSED, "reference.laps=1", seed=3, at=[(in_phase(Phase.TRACK, 2.0), jump)])
    pair.track()
    assert [line for line in pair.companion.announced if "GPS" in line] == [
        "no usable GPS fix for 1 s: using the vehicle's estimate",
        "GPS is 29.9 m from the vehicle's estimate: not fused",
    ]
    assert largest_tilt_rad(pair) < largest_tilt_rad(undisturbed) + 0.02
    assert pair.score(tmp_path).max_truth_m < 1.2
