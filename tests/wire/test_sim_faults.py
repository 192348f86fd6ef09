"""Faults of a scenario, in the datagrams of the companion's link or in the true state; what each
does to a flight is shown by the flights of `tests/flight/test_safety.py`."""

from __future__ import annotations

import math
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
from sim_bench import HOVER, OFFBOARD, POSCTL, Bench, aloft, engaged, hold

from offboard.documents import shipped
from offboard.documents.errors import DocumentError
from simulator import config
from simulator.config import Scenario
from simulator.firmware.ardupilot import ARDUPILOT
from simulator.firmware.base import Firmware
from simulator.firmware.px4 import PX4
from simulator.mavlink.codec import Decoder, sender_of


def scenario(*faults: dict[str, Any], **more: Any) -> Scenario:
    return Scenario.model_validate({"name": "x", "faults": faults, **more})


# -- modes and refusals ----------------------------------------------------------------------------


def test_at_a_requested_interval_a_change_of_mode_is_reported_at_once() -> None:
    """A mode that no command may enter is the pilot's switch."""
    bench = engaged({"fault": "pilot_takes_over", "mode": "POSCTL", "at_s": 1.0})
    engaged_s = bench.time_s
    assert bench.command(511, 436, 50_000) == [0]
    hold(bench, 3.0)
    assert bench.mode == POSCTL
    shown = [(at_s, m.custom_mode) for at_s, m in bench.of("CURRENT_MODE", engaged_s + 0.1)]
    changed_s = [at_s for at_s, mode in shown if mode == POSCTL]
    assert changed_s[0] - engaged_s == pytest.approx(1.0, abs=0.03)
    assert {mode for at_s, mode in shown if at_s < changed_s[0]} == {OFFBOARD}
    assert len(changed_s) == 1 + 4  # twice a second


def test_what_a_run_cannot_simulate_is_refused() -> None:
    switch = scenario({"fault": "pilot_takes_over", "mode": "POSCTL"})
    flood = scenario({"fault": "stranger", "rate_hz": 30_000.0})
    config.check_for(switch, PX4, lockstep=True)
    config.check_for(flood, PX4, lockstep=False)
    with pytest.raises(DocumentError, match="scenario x: ardupilot has no mode POSCTL"):
        config.check_for(switch, ARDUPILOT, lockstep=True)
    with pytest.raises(DocumentError, match="scenario x: a stranger with more than 5000"):
        config.check_for(flood, PX4, lockstep=True)
    with pytest.raises(ValueError, match="'NOPE' is not a mode of any firmware"):
        scenario(start={"height_m": 3.0, "mode": "NOPE"})


def test_refusals_with_their_texts_until_they_end() -> None:
    requests = (
        ("arm", 400, (1.0,), "Arming denied: low battery"),
        ("offboard", 176, (1.0, 6.0), "Switching to Offboard denied: low battery"),
        ("takeoff", 22, (), "Takeoff denied: low battery"),
    )
    refused = {"fault": "refusal", "text": "low battery", "for_s": 7.0}
    bench = Bench(scenario=scenario(*({**refused, "of": of} for of, *_ in requests)))
    bench.run(5.6, lambda: bench.position(0, 0, -3.0))
    for _, number, params, text in requests:
        assert bench.command(number, *params)[-1] == 1
        assert bench.texts()[-1] == text
    bench.run(2.0, lambda: bench.position(0, 0, -3.0))
    for _, number, params, _ in requests:
        assert bench.command(number, *params)[-1] == 0


# -- telemetry -------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def observed() -> Bench:
    attitude = {"fault": "stuck_message", "message": "ATTITUDE", "for_s": 0.9}
    bench = aloft(
        {"fault": "silent_message", "message": "LOCAL_POSITION_NED", "at_s": 1.0, "every": 10},
        {**attitude, "at_s": 2.0},
        {**attitude, "at_s": 3.0, "stamp_runs": False},
    )
    bench.run(5.0)
    return bench


def test_every_tenth_of_a_message_is_sent(observed: Bench) -> None:
    arrived_s = [at_s for at_s, _ in observed.of("LOCAL_POSITION_NED", 1.01)]
    gaps_s = [b - a for a, b in pairwise(arrived_s)]
    assert gaps_s == pytest.approx([1 / 3] * 11, abs=0.01)


@pytest.mark.parametrize(("begin_s", "runs"), [(2.0, True), (3.0, False)])
def test_a_stuck_message_repeats_its_content(observed: Bench, begin_s: float, runs: bool) -> None:
    stuck = [m for at_s, m in observed.of("ATTITUDE", begin_s + 0.05) if at_s < begin_s + 0.9]
    assert len(stuck) > 50
    assert len({(m.roll, m.pitch, m.rollspeed) for m in stuck}) == 1
    assert (len({m.time_boot_ms for m in stuck}) == len(stuck)) is runs


@pytest.mark.parametrize(("timeout_us", "late"), [(5e6, 895), (2e6, 229)])
def test_gps_loss_drifts_and_jumps_back_and_px4_loses_the_position(
    timeout_us: float, late: int
) -> None:
    """After EKF2_NOAID_TOUT: the estimator's flags are those before the first fix."""
    lost = {"fault": "gps_loss", "at_s": 4.0, "for_s": 8.0, "drift_mps": 0.5}
    bench = Bench(scenario=scenario(lost))
    bench.set("EKF2_NOAID_TOUT", timeout_us)
    bench.run(14.0)
    fixes = {round(at_s, 1): m.fix_type for at_s, m in bench.of("GPS_RAW_INT")}
    assert {fix for at_s, fix in fixes.items() if 4.1 < at_s < 11.9} == {1}
    assert {fix for at_s, fix in fixes.items() if at_s > 12.1} == {3}
    flags = {round(at_s): m.flags for at_s, m in bench.of("ESTIMATOR_STATUS")}
    assert [flags[second] for second in (4, 8, 10, 11, 13)] == [895, late, 229, 229, 895]
    drifted = [m for at_s, m in bench.of("LOCAL_POSITION_NED") if 11.9 < at_s < 12.0][-1]
    assert math.hypot(drifted.x, drifted.y) == pytest.approx(4.0, abs=0.05)
    found = bench.of("ODOMETRY")[-1][1]
    assert math.hypot(found.x, found.y) < 0.01
    assert found.reset_counter == 1


@pytest.mark.parametrize(
    ("firmware", "message_id", "name", "ratios"),
    [(PX4, 230, "vel_ratio", (0.12, 1.0, 4.0)),
     (ARDUPILOT, 193, "velocity_variance", (0.02, 1.0, 2.0))],
    ids=["px4", "ardupilot"],
)  # fmt: skip
def test_ratio_of_a_wrong_velocity(
    firmware: Firmware, message_id: int, name: str, ratios: tuple[float, ...]
) -> None:
    """Innovation over gate times noise, 5 x 0.3 m/s; PX4 reports the square."""
    wrong = [
        {"fault": "velocity_error", "offset_ned_mps": (0.0, off_mps, 0.0), "at_s": at_s, "for_s": 1}
        for at_s, off_mps in ((6.0, 1.5), (8.0, 3.0))
    ]
    bench = Bench(firmware=firmware, scenario=scenario(*wrong, conditions={"boot_scale": 0.1}))
    found = []
    for moment_s in (5.0, 6.5, 8.5):
        bench.run(moment_s - bench.time_s)
        assert bench.command(512, message_id) == [0]
        found.append(
            next(getattr(m, name) for _, m in bench.received[::-1] if m.get_msgId() == message_id)
        )
    assert found == pytest.approx(ratios)


def strange(**fault: Any) -> list[bytes]:
    bench = Bench(scenario=scenario({"fault": "stranger", "at_s": 1.0, **fault}))
    bench.run(2.0)
    (queue,) = bench.instance.strangers
    return queue


def test_a_stranger_sends_noise_or_a_spoof_with_the_ids_of_the_vehicle() -> None:
    sent = strange(rate_hz=1000.0, size_bytes=40)
    assert len(set(sent)) == len(sent) == pytest.approx(1000, abs=4)
    assert {len(datagram) for datagram in sent} == {40}
    decoder = Decoder()
    spoofs = [m for each in strange(sends="heartbeat", rate_hz=20) for m in decoder.read(each)]
    assert {(m.get_type(), *sender_of(m), m.autopilot) for m in spoofs} == {("HEARTBEAT", 1, 1, 12)}
    assert len(spoofs) == pytest.approx(20, abs=1)


@pytest.mark.parametrize("firmware", [PX4, ARDUPILOT], ids=lambda firmware: firmware.name)
def test_the_same_seed_gives_the_same_bytes_with_every_new_fault(firmware: Firmware) -> None:
    stalled = {"stalled": True, "queue_bytes": 100_000, "at_s": 2.0, "for_s": 0.5}
    faults: tuple[dict[str, Any], ...] = (
        {"fault": "second_sender", "at_s": 0.5},
        {"fault": "second_vehicle"},
        {"fault": "stranger", "rate_hz": 500},
        {"fault": "pilot_takes_over", "at_s": 1.5, "for_s": 0.5},
        {"fault": "link", "direction": "down", **stalled},
        {"fault": "link", "direction": "down", "latency_s": 0.5, "ramp_s": 1.0, "at_s": 2.5},
    )

    def flown() -> tuple[bytes, bytes]:
        bench = engaged(*faults, firmware=firmware)
        hold(bench, 3.5)
        return bytes(bench.raw), b"".join(bench.instance.strangers[0])

    assert flown() == flown()


# -- motors, mass, reboot --------------------------------------------------------------------------


def test_a_weaker_or_heavier_vehicle_accelerates_less() -> None:
    """Level at hover thrust the vertical specific force is what the change leaves of gravity."""
    sinking: tuple[tuple[dict[str, Any], float], ...] = (
        ({"fault": "weak_motor", "motor_scale": 0.4, "at_s": 2.0}, 0.85),
        ({"fault": "thrust_change", "thrust_scale": 0.8, "at_s": 6.0}, 0.8),
        ({"fault": "mass_change", "mass_scale": 1.25, "at_s": 10.0}, 0.8),
    )
    bench = engaged(*({**fault, "for_s": 0.2} for fault, _ in sinking))
    begun_s = bench.time_s

    def lift_at(flight_s: float) -> float:
        bench.run(begun_s + flight_s - bench.time_s, lambda: bench.attitude(thrust=HOVER))
        return 1.0 - bench.instance.autopilot.state.truth.acceleration_ned_mps2[2] / 9.80665

    for fault, ratio in sinking:
        hold(bench, begun_s + fault["at_s"] - 0.4 - bench.time_s)
        assert lift_at(fault["at_s"] - 0.03) == pytest.approx(1.0, abs=0.02)
        assert lift_at(fault["at_s"] + 0.04) == pytest.approx(ratio, abs=0.02)
        lifted = lift_at(fault["at_s"] + 0.17)
        assert lift_at(fault["at_s"] + 0.24) == pytest.approx(lifted / ratio, abs=0.02)


def test_motors_are_cut_at_a_height_in_the_landing() -> None:
    bench = engaged({"fault": "motors_cut", "after": "landing", "below_m": 2.5})
    bench.command(21)
    state = bench.instance.autopilot.state
    bench.run_until(lambda: bench.height_m < 2.6, 20.0)
    assert state.truth.acceleration_ned_mps2[2] < 1.0
    bench.run_until(lambda: bench.height_m < 2.4, 5.0)
    bench.run(0.1)
    assert state.truth.acceleration_ned_mps2[2] > 7.0


def test_disarmed_by_the_pilot_or_by_a_reboot_it_falls() -> None:
    """After the reboot it is silent, and its time begins again."""
    bench = aloft({"fault": "pilot_disarms", "at_s": 0.5})
    bench.run(2.0)
    assert not bench.armed
    assert bench.height_m < 4.0
    bench = aloft({"fault": "reboot", "at_s": 1.0, "for_s": 0.5})
    bench.run(3.0)
    assert bench.height_m < 1.0
    beats = [(at_s, m) for at_s, m in bench.of("HEARTBEAT") if at_s > 1.01]
    assert beats[0][0] == pytest.approx(1.5, abs=0.05)
    assert not any(m.base_mode & 128 for _, m in beats)
    assert bench.of("ATTITUDE", 1.01)[0][1].time_boot_ms < 50


def test_faults_that_run_go_on_after_a_reboot_and_end_as_they_should() -> None:
    """The clock is set by the reboot."""
    bench = Bench(
        scenario=scenario(
            {"fault": "clock_jump", "jump_s": -30.0, "for_s": 8.0},
            {"fault": "velocity_error", "offset_ned_mps": (0.0, 2.0, 0.0), "for_s": 8.0},
            {"fault": "refusal", "of": "arm", "text": "no", "for_s": 8.0},
            {"fault": "reboot", "at_s": 1.0, "for_s": 0.5},
        )
    )
    bench.run(7.0)
    autopilot = bench.instance.autopilot
    assert autopilot.state.estimate.velocity_ned_mps[1] == pytest.approx(2.0, abs=0.1)
    assert bench.command(400, 1) == [1]
    assert bench.texts()[-1] == "Arming denied: no"
    bench.run(2.0)
    assert autopilot.state.estimate.velocity_ned_mps[1] == pytest.approx(0.0, abs=0.1)
    assert bench.command(400, 1) == [0]
    assert bench.of("ATTITUDE")[-1][1].time_boot_ms == pytest.approx(7540, abs=60)


# -- documents -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("fault", "says"),
    [
        ("fault: lnk", "'lnk'"),
        ("fault: link, loss: 1.5", "faults.0.loss: 1.5 should be less than or equal to 1"),
        ("fault: link, speed: 1", "faults.0.speed is not a known key"),
        ("fault: silent_message, message: NOPE", "'NOPE' is not a MAVLink message"),
        ("fault: mass_change", "faults.0.mass_scale is missing"),
    ],
)
def test_an_invalid_fault_is_refused_with_one_sentence(
    fault: str, says: str, tmp_path: Path
) -> None:
    path = tmp_path / "bad.yaml"
    path.write_text(f"name: bad\nfaults: [{{{fault}}}]\n")
    with pytest.raises(DocumentError) as caught:
        config.scenario(str(path))
    assert says in str(caught.value)
    assert "\n" not in str(caught.value)


def test_every_shipped_scenario_is_valid() -> None:
    names = shipped.names("scenario")
    assert [config.scenario(name).name for name in names] == list(names)
