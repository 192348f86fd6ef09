"""Faults of a scenario, in the datagrams of the companion's link or in the true state; what each
does to a flight is shown by the flights of `tests/flight/test_safety.py`."""

from __future__ import annotations

import math
from typing import Any

import pytest
from sim_bench import HOVER, Bench, engaged, hold

from offboard.documents.errors import DocumentError
from simulator import config
from simulator.config import Scenario
from simulator.firmware.ardupilot import ARDUPILOT
from simulator.firmware.base import Firmware
from simulator.firmware.px4 import PX4


def scenario(*faults: dict[str, Any], **more: Any) -> Scenario:
    return Scenario.model_validate({"name": "x", "faults": faults, **more})


# -- modes and refusals ----------------------------------------------------------------------------


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
