"""Faults of a scenario, observed in the datagrams of the companion's link or in the true state, and
vehicles that start in the air."""

from __future__ import annotations

import math
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
from sim_bench import HOVER, LOITER, OFFBOARD, POSCTL, Bench

from offboard.documents import shipped
from offboard.documents.errors import DocumentError
from simulator import config
from simulator.config import Scenario
from simulator.firmware.ardupilot import ARDUPILOT
from simulator.firmware.base import Firmware
from simulator.firmware.px4 import PX4
from simulator.mavlink.codec import Decoder, sender_of

GUIDED, BRAKE = 4, 17
HIGH = {"height_m": 8.0}


def flying(*faults: dict[str, Any], firmware: Firmware = PX4, **more: Any) -> Bench:
    """A vehicle with these faults; `more` are further parts of the scenario."""
    content = {"name": "test", "faults": faults, **more}
    bench = Bench(firmware=firmware, scenario=Scenario.model_validate(content))
    bench._parser.robust_parsing = True  # damage is part of the deal
    return bench


def engaged(*faults: dict[str, Any], firmware: Firmware = PX4) -> Bench:
    """The same, found 8 m above the ground and engaged; faults count from there."""
    counted = ({"after": "engaged", **fault} for fault in faults)
    bench = flying(*counted, firmware=firmware, start=HIGH)
    hover(bench, 0.6)
    bench.ask_mode(OFFBOARD if firmware is PX4 else GUIDED << 24)
    if firmware is ARDUPILOT:
        bench.command(176, 1, GUIDED)
    return bench


def hover(bench: Bench, duration_s: float) -> None:
    bench.run(duration_s, lambda: bench.position(0, 0, -8.0), 0.1)


# -- the mode that is reported ---------------------------------------------------------------------


def modes(bench: Bench) -> list[tuple[float, int, int]]:
    shown = bench.of("CURRENT_MODE")
    return [(at_s, m.custom_mode, m.intended_custom_mode) for at_s, m in shown]


def test_at_a_requested_interval_a_change_of_mode_is_reported_at_once() -> None:
    bench = flying(start=HIGH)
    hover(bench, 1.0)
    assert bench.command(511, 436, 50_000) == [0]
    hover(bench, 0.83)
    asked_s = bench.time_s
    bench.ask_mode(OFFBOARD)
    hover(bench, 2.0)
    first_s = next(at_s for at_s, mode, _ in modes(bench) if mode == OFFBOARD)
    assert first_s - asked_s <= 0.008
    assert len([at_s for at_s, *_ in modes(bench) if at_s > first_s]) == 4  # twice a second


# -- authority -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("firmware", "mode", "shown"),
    [(PX4, None, LOITER), (PX4, "POSCTL", POSCTL), (PX4, "RTL", 0x05040000),
     (ARDUPILOT, None, BRAKE), (ARDUPILOT, "LOITER", 5), (ARDUPILOT, "LAND", 9)],
    ids=lambda each: getattr(each, "name", str(each)),
)  # fmt: skip
def test_the_pilot_chooses_a_mode(firmware: Firmware, mode: str | None, shown: int) -> None:
    bench = engaged({"fault": "pilot_takes_over", "mode": mode, "at_s": 1.0}, firmware=firmware)
    before = bench.mode
    hover(bench, 1.1)
    assert before in (OFFBOARD, GUIDED)
    assert bench.mode == shown


def test_a_mode_that_the_firmware_lacks_is_refused() -> None:
    fault = {"fault": "pilot_takes_over", "mode": "POSCTL"}
    scenario = Scenario.model_validate({"name": "x", "faults": [fault]})
    config.check_for(scenario, PX4, lockstep=True)
    with pytest.raises(DocumentError, match="scenario x: ardupilot has no mode POSCTL"):
        config.check_for(scenario, ARDUPILOT, lockstep=True)
    with pytest.raises(ValueError, match="'NOPE' is not a mode of any firmware"):
        Scenario.model_validate({"name": "x", "start": {"height_m": 3.0, "mode": "NOPE"}})


def test_the_pilot_disarms_in_the_air() -> None:
    bench = engaged({"fault": "pilot_disarms", "at_s": 0.5})
    hover(bench, 2.0)
    assert not bench.armed
    assert bench.height_m < 4.0


@pytest.mark.parametrize("firmware", [PX4, ARDUPILOT], ids=lambda firmware: firmware.name)
def test_a_vehicle_found_in_a_failsafe_hovers_until_a_mode_is_chosen(firmware: Firmware) -> None:
    bench = flying(firmware=firmware, start={**HIGH, "by_failsafe": True})
    bench.run(0.1)
    first = bench.of("HEARTBEAT")[0][1]
    assert (first.custom_mode, first.system_status) == (
        (LOITER, 5) if firmware is PX4 else (BRAKE, 5)
    )
    assert first.base_mode & 128
    hover(bench, 5.0)
    assert (bench.height_m, bench.system_status) == (pytest.approx(8.0, abs=0.4), 5)
    if firmware is PX4:
        assert {m.landed_state for _, m in bench.of("EXTENDED_SYS_STATE")} == {2}


def test_a_second_sender_moves_the_vehicle_and_is_heard() -> None:
    """Its thrust of 0.6 instead of 0.49 climbs; ours, ten times a second, holds the height."""
    bench = engaged({"fault": "second_sender", "at_s": 1.0, "thrust": 0.6, "component": 200})
    bench.run(1.0, lambda: bench.attitude(thrust=HOVER), 0.1)
    before_m = bench.height_m
    bench.run(3.0, lambda: bench.attitude(thrust=HOVER), 0.1)
    assert bench.height_m > before_m + 0.5
    others = [m for _, m in bench.of("HEARTBEAT") if m.get_srcComponent() == 200]
    assert (len(others), {m.type for m in others}) == (4, {18})


# -- telemetry -------------------------------------------------------------------------------------


def test_every_tenth_of_a_message_is_sent() -> None:
    fault = {"fault": "silent_message", "message": "LOCAL_POSITION_NED", "at_s": 1.0, "every": 10}
    bench = flying(fault)
    bench.run(5.0)
    arrived_s = [at_s for at_s, _ in bench.of("LOCAL_POSITION_NED", 1.01)]
    assert [b - a for a, b in pairwise(arrived_s)] == pytest.approx(
        [1 / 3] * (len(arrived_s) - 1), abs=0.01
    )
    assert len(arrived_s) == 12


def test_a_wrong_landed_state_is_reported_and_not_believed() -> None:
    bench = flying(
        {"fault": "wrong_landed_state", "reports": "on_ground", "at_s": 2.0, "for_s": 2.0},
        start=HIGH,
    )
    bench.run(6.0)
    states = [(at_s, m.landed_state) for at_s, m in bench.of("EXTENDED_SYS_STATE")]
    assert {state for at_s, state in states if 2.01 < at_s < 3.99} == {1}
    assert {state for at_s, state in states if not 2.0 <= at_s <= 4.0} == {2}
    assert bench.height_m == pytest.approx(8.0, abs=0.4)


def test_a_velocity_error_is_seen_while_it_lasts() -> None:
    bench = flying(
        {"fault": "velocity_error", "offset_ned_mps": (0, 0, -1.0), "at_s": 2.0, "for_s": 0.1}
    )
    bench.run(3.0)
    climbing_s = [at_s for at_s, m in bench.of("LOCAL_POSITION_NED") if m.vz < -0.9]
    assert 2.0 <= climbing_s[0] < climbing_s[-1] < 2.104


# -- landing and clock -----------------------------------------------------------------------------


def test_motors_are_cut_at_a_height_in_the_landing() -> None:
    bench = engaged({"fault": "motors_cut", "after": "landing", "below_m": 2.5})
    bench.command(21)
    bench.run_until(lambda: bench.height_m < 2.6, 20.0)
    assert bench.instance.autopilot.state.truth.acceleration_ned_mps2[2] < 1.0
    bench.run_until(lambda: bench.height_m < 2.4, 5.0)
    bench.run(0.1)
    assert bench.instance.autopilot.state.truth.acceleration_ned_mps2[2] > 7.0


@pytest.mark.parametrize("blind", [False, True])
def test_without_a_detected_landing_the_vehicle_stays_armed(blind: bool) -> None:
    bench = engaged(*[{"fault": "blind_land_detector"}] * blind)
    bench.command(21)
    bench.run(30.0)
    assert bench.height_m == pytest.approx(0.0, abs=0.02)
    assert bench.armed is blind


def test_the_clock_starts_where_it_is_told_and_wraps() -> None:
    bench = flying(conditions={"clock_start_s": 4294966.0})
    bench.run(3.0)
    stamps_ms = [m.time_boot_ms for _, m in bench.of("ATTITUDE")]
    assert stamps_ms[0] == 4294966004
    assert [(b - a) % 2**32 for a, b in pairwise(stamps_ms)] == pytest.approx(
        [10] * (len(stamps_ms) - 1), abs=4
    )
    assert stamps_ms[-1] == pytest.approx(1704, abs=10)
    unix_s = [m.time_unix_usec / 1e6 for _, m in bench.of("SYSTEM_TIME")]
    assert unix_s[1] - 1_767_225_600 == pytest.approx(1.0, abs=0.01)


# -- senders beside the vehicle --------------------------------------------------------------------


def strange(fault: dict[str, Any], seconds: float) -> list[bytes]:
    bench = flying({"fault": "stranger", "at_s": 1.0, **fault})
    bench.run(1.0 + seconds)
    (queue,) = bench.instance.strangers
    return queue


def test_a_stranger_sends_noise_that_the_seed_decides() -> None:
    sent = strange({"rate_hz": 1000.0, "size_bytes": 40}, 1.0)
    assert len(sent) == pytest.approx(1000, abs=4)
    assert {len(datagram) for datagram in sent} == {40}
    assert len(set(sent)) == len(sent)
    assert strange({"rate_hz": 1000.0, "size_bytes": 40}, 1.0) == sent


def test_a_spoof_has_the_ids_of_the_vehicle() -> None:
    decoder = Decoder()
    spoofs = [
        m for d in strange({"sends": "heartbeat", "rate_hz": 20}, 1.0) for m in decoder.read(d)
    ]
    assert {(m.get_type(), *sender_of(m), m.autopilot) for m in spoofs} == {("HEARTBEAT", 1, 1, 12)}
    assert len(spoofs) == pytest.approx(20, abs=1)


def test_a_flood_is_refused_in_lockstep() -> None:
    fault = {"fault": "stranger", "rate_hz": 30_000.0}
    flood = Scenario.model_validate({"name": "flood", "faults": [fault]})
    config.check_for(flood, PX4, lockstep=False)
    with pytest.raises(DocumentError, match="scenario flood: a stranger with more than 5000"):
        config.check_for(flood, PX4, lockstep=True)


# -- places far away -------------------------------------------------------------------------------


@pytest.mark.parametrize("firmware", [PX4, ARDUPILOT], ids=lambda firmware: firmware.name)
def test_the_same_seed_gives_the_same_bytes_with_every_new_fault(firmware: Firmware) -> None:
    faults: tuple[dict[str, Any], ...] = (
        {"fault": "second_sender", "at_s": 1.0},
        {"fault": "second_vehicle"},
        {"fault": "stranger", "rate_hz": 500},
        {"fault": "pilot_takes_over", "at_s": 3.0, "for_s": 0.5},
        {"fault": "velocity_error", "offset_ned_mps": (0, 0.1, 0), "at_s": 2.0, "for_s": 1.0},
        {"fault": "link", "direction": "down", "stalled": True, "queue_bytes": 100_000,
         "at_s": 4.0, "for_s": 0.5},
        {"fault": "link", "direction": "down", "latency_s": 0.5, "ramp_s": 1.0, "at_s": 5.0},
    )  # fmt: skip

    def flown() -> tuple[bytes, bytes]:
        bench = engaged(*faults, firmware=firmware)
        hover(bench, 7.0)
        return bytes(bench.raw), b"".join(bench.instance.strangers[0])

    assert flown() == flown()


# -- link, estimator, power, autopilot ------------------------------------------------------------


def hovering(*faults: dict[str, Any]) -> Bench:
    """The same at 3 m, streaming position setpoints; faults count from engaging."""
    bench = flying(*({"after": "engaged", **fault} for fault in faults))
    bench.fly_offboard()
    return bench


def hold(bench: Bench, duration_s: float) -> None:
    bench.run(duration_s, lambda: bench.position(0, 0, -3.0), 0.1)


def engaged_s(bench: Bench) -> float:
    return bench.text_at("Armed by external command")


def test_delay_each_way() -> None:
    bench = flying({"fault": "link", "latency_s": 0.1})
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
    bench = flying({"fault": "estimator_jump", "at_s": 2.0, "offset_ned_m": (1.0, 0.0, -0.5)})
    bench.run(4.0)
    odometry = bench.of("ODOMETRY")
    before = [m for at_s, m in odometry if at_s < 1.99]
    after = [m for at_s, m in odometry if at_s > 2.01]
    assert {m.reset_counter for m in before} == {0}
    assert {m.reset_counter for m in after} == {1}
    assert (after[0].x, after[0].z) == pytest.approx((1.0, -0.5), abs=0.01)
    assert abs(before[-1].x) < 0.01


def test_gps_loss_drifts_and_jumps_back() -> None:
    bench = flying({"fault": "gps_loss", "at_s": 4.0, "for_s": 4.0, "drift_mps": 0.5})
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
    bench = flying({"fault": "battery_drop", "remaining": 0.1, "at_s": 1.0})
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
    bench = flying({"fault": "clock_jump", "jump_s": -1.5, "at_s": 2.0})
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
    bench = flying({"fault": "refusal", "of": of, "text": "low battery", "for_s": 7.0})
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


@pytest.mark.parametrize("name", shipped.names("scenario"))
def test_every_shipped_scenario_is_valid(name: str) -> None:
    assert config.scenario(name).name == name
