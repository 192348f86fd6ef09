"""Faults of a scenario, each observed in telemetry or in the true state."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import pytest
from sim_bench import HOVER, Bench

from offboard.documents import shipped
from offboard.documents.reading import DocumentError
from simulator import config
from simulator.config import Scenario


def faulty(*faults: dict[str, Any], seed: int = 1) -> Bench:
    """A vehicle with these faults on a calm day."""
    scenario = Scenario.model_validate({"name": "test", "faults": faults})
    bench = Bench(seed=seed, scenario=scenario)
    bench._parser.robust_parsing = True  # damage is part of the deal
    return bench


def hovering(*faults: dict[str, Any]) -> Bench:
    """The same at 3 m, streaming position setpoints; faults count from engaging."""
    bench = faulty(*({"after": "engaged", **fault} for fault in faults))
    bench.fly_offboard()
    return bench


def hold(bench: Bench, duration_s: float) -> None:
    bench.run(duration_s, lambda: bench.position(0, 0, -3.0), 0.1)


def engaged_s(bench: Bench) -> float:
    return bench.text_at("Armed by external command")


def test_delay_each_way() -> None:
    bench = faulty({"fault": "link", "latency_s": 0.1})
    bench.run(1.0)
    ages_s = [at_s - m.time_boot_ms / 1000 for at_s, m in bench.of("ATTITUDE")]
    assert ages_s == pytest.approx([0.1] * len(ages_s))
    assert len(ages_s) > 80
    asked_s = bench.time_s
    bench.command(520)
    bench.run(0.5)
    ((at_s, _),) = bench.of("COMMAND_ACK")
    assert at_s - asked_s == pytest.approx(0.2, abs=0.009)


def test_estimator_jump_increases_the_reset_counter() -> None:
    bench = faulty({"fault": "estimator_jump", "at_s": 2.0, "offset_ned_m": (1.0, 0.0, -0.5)})
    bench.run(4.0)
    odometry = bench.of("ODOMETRY")
    before = [m for at_s, m in odometry if at_s < 1.99]
    after = [m for at_s, m in odometry if at_s > 2.01]
    assert {m.reset_counter for m in before} == {0}
    assert {m.reset_counter for m in after} == {1}
    assert (after[0].x, after[0].z) == pytest.approx((1.0, -0.5), abs=0.01)
    assert abs(before[-1].x) < 0.01


def test_gps_loss_drifts_and_jumps_back() -> None:
    bench = faulty({"fault": "gps_loss", "at_s": 4.0, "for_s": 4.0, "drift_mps": 0.5})
    bench.run(10.0)
    fixes = {m.fix_type for at_s, m in bench.of("GPS_RAW_INT") if 4.1 < at_s < 7.9}
    assert fixes == {1}
    assert {m.fix_type for at_s, m in bench.of("GPS_RAW_INT") if at_s > 8.1} == {3}
    gps = 0x20
    health = [(at_s, m.onboard_control_sensors_health & gps) for at_s, m in bench.of("SYS_STATUS")]
    assert {bit for at_s, bit in health if 4.1 < at_s < 7.9} == {0}
    assert {bit for at_s, bit in health if at_s > 8.3} == {gps}
    lost = [m for at_s, m in bench.of("LOCAL_POSITION_NED") if 7.9 < at_s < 8.0][-1]
    assert math.hypot(lost.x, lost.y) == pytest.approx(2.0, abs=0.05)
    found = bench.of("ODOMETRY")[-1][1]
    assert math.hypot(found.x, found.y) < 0.01
    assert found.reset_counter == 1


@pytest.mark.parametrize("runs", [True, False])
def test_a_stuck_message_repeats_its_content(runs: bool) -> None:
    bench = hovering(
        {"fault": "stuck_message", "message": "ATTITUDE", "at_s": 1.0, "stamp_runs": runs}
    )
    stuck = [m for at_s, m in bench.of("ATTITUDE") if at_s > engaged_s(bench) + 1.1]
    assert len(stuck) > 50
    assert len({(m.roll, m.pitch, m.rollspeed) for m in stuck}) == 1
    assert (len({m.time_boot_ms for m in stuck}) == len(stuck)) is runs


SINKING = [
    ({"fault": "weak_motor", "motor_scale": 0.4}, 0.85),
    ({"fault": "thrust_change", "thrust_scale": 0.8}, 0.8),
    ({"fault": "mass_change", "mass_scale": 1.25}, 0.8),
]


@pytest.mark.parametrize(("fault", "ratio"), SINKING, ids=lambda row: str(row))
def test_a_weaker_or_heavier_vehicle_accelerates_less(fault: dict[str, Any], ratio: float) -> None:
    """Level at hover thrust the vertical specific force is what the change leaves of gravity."""
    bench = hovering({**fault, "at_s": 8.0, "for_s": 4.0})
    since_s = engaged_s(bench)

    def lift_at(flight_s: float) -> float:
        bench.run(since_s + flight_s - bench.time_s, lambda: bench.attitude(thrust=HOVER))
        acceleration = bench.instance.autopilot.state.truth.acceleration_ned_mps2[2]
        return float(1.0 - acceleration / 9.80665)

    hold(bench, since_s + 7.6 - bench.time_s)
    assert lift_at(7.98) == pytest.approx(1.0, abs=0.02)
    assert lift_at(8.04) == pytest.approx(ratio, abs=0.02)
    hold(bench, since_s + 11.6 - bench.time_s)
    before = lift_at(11.98)
    assert lift_at(12.04) == pytest.approx(before / ratio, abs=0.02)


def test_battery_drop() -> None:
    bench = faulty({"fault": "battery_drop", "remaining": 0.1, "at_s": 1.0})
    bench.run(3.0)
    left = [(at_s, m.battery_remaining) for at_s, m in bench.of("SYS_STATUS")]
    assert {share for at_s, share in left if at_s < 0.99} == {100}
    assert {share for at_s, share in left if at_s > 1.01} == {10}


def test_reboot_in_flight_disarms_and_restarts_time_after_silence() -> None:
    bench = hovering({"fault": "reboot", "at_s": 8.0, "for_s": 0.5})
    hold(bench, engaged_s(bench) + 8.0 - bench.time_s + 0.3)
    begun_s = bench.time_s
    assert bench.height_m < 2.8  # falling
    bench.run(3.0)
    beats = [(at_s, m) for at_s, m in bench.of("HEARTBEAT") if at_s > begun_s]
    assert beats[0][0] == pytest.approx(begun_s + 0.2, abs=0.05)
    assert not any(m.base_mode & 128 for _, m in beats)
    stamps = [m.time_boot_ms for at_s, m in bench.of("ATTITUDE") if at_s > begun_s]
    assert stamps[0] < 50
    assert bench.height_m == pytest.approx(0.0, abs=0.01)


def test_a_clock_jump_changes_time_stamps_only() -> None:
    bench = faulty({"fault": "clock_jump", "jump_s": -1.5, "at_s": 2.0})
    bench.run(4.0)
    offsets = [(at_s, m.time_boot_ms / 1000 - at_s) for at_s, m in bench.of("ATTITUDE")]
    assert [late for at_s, late in offsets if at_s < 1.99] == pytest.approx(
        [0.0] * len([1 for at_s, _ in offsets if at_s < 1.99]), abs=1e-9
    )
    assert offsets[-1][1] == pytest.approx(-1.5)
    assert len(offsets) == pytest.approx(400, abs=3)


REFUSALS = [
    ("arm", 400, (1.0,), "Arming denied: low battery", 1),
    ("offboard", 176, (1.0, 6.0), "Switching to Offboard denied: low battery", 1),
    ("takeoff", 22, (), "Takeoff denied: low battery", 1),
]


@pytest.mark.parametrize(("of", "number", "params", "text", "result"), REFUSALS)
def test_refusals(of: str, number: int, params: tuple[float, ...], text: str, result: int) -> None:
    bench = faulty({"fault": "refusal", "of": of, "text": "low battery", "for_s": 7.0})
    bench.boot()
    bench.run(0.6, lambda: bench.position(0, 0, -3.0))
    assert bench.command(number, *params)[-1] == result
    assert bench.texts() == [text]
    bench.run(2.0, lambda: bench.position(0, 0, -3.0))
    assert bench.command(number, *params)[-1] == 0


BAD = {
    "faults: [{fault: lnk}]": "'lnk'",
    "faults: [{fault: link, loss: 1.5}]": "faults.0.loss: 1.5 should be less than or equal to 1",
    "faults: [{fault: link, speed: 1}]": "faults.0.speed is not a known key",
    "faults: [{fault: reboot, after: never}]": "'never' should be 'boot', 'armed', 'took_off'",
    "faults: [{fault: silent_message, message: NOPE}]": "'NOPE' is not a MAVLink message",
    "faults: [{fault: mass_change}]": "faults.0.mass_scale is missing",
}


@pytest.mark.parametrize("text", BAD)
def test_an_invalid_fault_is_refused_with_one_sentence(text: str, tmp_path: Path) -> None:
    path = tmp_path / "bad.yaml"
    path.write_text(f"name: bad\n{text}\n")
    with pytest.raises(DocumentError) as caught:
        config.scenario(str(path))
    assert BAD[text] in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", shipped.names("scenarios"))
def test_every_shipped_scenario_is_valid(name: str) -> None:
    assert config.scenario(name).name == name
