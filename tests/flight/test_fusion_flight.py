"""Flights with `estimate: fused`: nearer to the truth than the vehicle's own estimate, and whole
when the receiver fails on the way."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from pair import LEAN, Pair, in_phase, make

from offboard.flight.phases import Phase
from simulator.firmware.px4 import PX4

FUSED = ("estimate=fused", "controller={law: lqr}", "reference.laps=1")
WITH_RECEIVER = replace(
    LEAN,
    companion_rates_hz=LEAN.companion_rates_hz
    | {"GPS_RAW_INT": PX4.companion_rates_hz["GPS_RAW_INT"]},
)


def flight(*assignments: str, **more: object) -> Pair:
    return make(*assignments, scenario="px4_like", firmware=WITH_RECEIVER, **more)  # type: ignore[arg-type]


def test_truth_is_nearer_than_by_the_vehicle_s_estimate(tmp_path: Path) -> None:
    fused, own = flight(*FUSED, seed=1), flight(*FUSED[1:], seed=1)
    for pair in (fused, own):
        assert pair.fly().exit_code == 0
    by_fusion, by_estimate = fused.score(tmp_path / "fused"), own.score(tmp_path / "own")
    assert by_fusion.rmse_truth_m < 0.22
    assert by_fusion.rmse_truth_m < 0.6 * by_estimate.rmse_truth_m
    assert by_estimate.rmse_position_m < 0.05 < 0.2 < by_fusion.rmse_position_m
    assert [said for said in fused.companion.announced if "own position fusion" in said]
    assert not [said for said in own.companion.announced if "GPS" in said]


def test_a_receiver_that_jumps_ends_no_flight(tmp_path: Path) -> None:
    def jump(pair: Pair) -> None:
        pair.instance.autopilot.plant.shift_fixes((30.0, 0.0, 0.0))

    pair = flight(*FUSED, seed=3, at=[(in_phase(Phase.TRACK, 2.0), jump)])
    assert pair.fly().exit_code == 0
    assert pair.went_through(Phase.TRACK)
    assert [said for said in pair.companion.announced if "GPS" in said] == [
        "no usable GPS fix for 1 s: following the vehicle's estimate",
        "GPS is 30.0 m off the vehicle's estimate: not fused",
    ]
    sent = [setpoint for _, phase, setpoint in pair.setpoints if phase is Phase.TRACK]
    tilts = [2.0 * (s.q[1] ** 2 + s.q[2] ** 2) for s in sent]  # 1 - cos
    assert max(tilts) < 0.1
    assert pair.score(tmp_path).max_truth_m < 1.2
