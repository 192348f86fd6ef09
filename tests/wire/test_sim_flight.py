"""Flights of the simulated PX4: stream and position lost, hold and landing, setpoint rules; faults
of a scenario."""

from __future__ import annotations

import math
from typing import Any

import pytest
from sim_bench import HOVER, LAND, LOITER, NAN, OFFBOARD, POSCTL, Bench, aloft, engaged, hold

from offboard.documents.errors import DocumentError
from simulator import config
from simulator.autopilot.firmware import Firmware
from simulator.config import Scenario, Start
from simulator.firmware.ardupilot import ARDUPILOT
from simulator.firmware.px4 import PX4
from simulator.mavlink.codec import Decoder, sender_of
from simulator.vehicle.conditions import Conditions

PREARM_CHECK = 1 << 28  # MAV_SYS_STATUS_SENSOR


def test_position_loss_lands_automatic_flight_but_not_offboard() -> None:
    bench = aloft()
    autopilot = bench.instance.autopilot
    autopilot.plant.gps_healthy = False
    bench.run(4.5)
    assert bench.mode == LOITER
    bench.run(1.0)
    assert (bench.mode, bench.system_status) == (LAND, 5)
    autopilot.plant.gps_healthy = True
    bench.run(0.5)
    assert (bench.mode, bench.system_status) == (LOITER, 4)
    bench.run(0.6, bench.attitude)
    bench.ask_mode(OFFBOARD)
    autopilot.plant.gps_healthy = False
    bench.run(6.0, bench.attitude)
    assert (bench.mode, bench.system_status) == (OFFBOARD, 4)


def hovering_at(hover_thrust: float) -> Bench:
    """A vehicle at 2 m whose hover thrust is not the 0.5 of MPC_THR_HOVER."""
    believed = config.vehicle("px4_sih")
    bench = Bench(vehicle=believed.model_copy(update={"hover_thrust": hover_thrust}))
    bench.fly_offboard(2.0)
    return bench


@pytest.mark.parametrize(("hover_thrust", "rise_m"), [(0.125, 0.8), (0.3, 0.0), (0.8, 0.0)])
def test_vehicle_with_a_wrong_hover_thrust_holds_and_lands(
    hover_thrust: float, rise_m: float
) -> None:
    """The integral compensates the difference. SIH of PX4 1.16.1 at a hover thrust of 0.125 rose by
    0.8 m in AUTO.LAND after attitude setpoints, as its estimate reaches only 0.3."""
    bench = hovering_at(hover_thrust)
    hold(bench, 8.0, 2.0)
    for mode in (LOITER, OFFBOARD):
        assert bench.height_m == pytest.approx(2.0, abs=0.05)
        bench.ask_mode(mode)
        bench.run(2.0, lambda: bench.attitude(thrust=hover_thrust))
    bench.command(21)
    before_m = highest_m = bench.height_m
    while bench.armed:
        bench.run(0.1)
        highest_m = max(highest_m, bench.height_m)
        assert bench.time_s < 60.0
    assert highest_m - before_m == pytest.approx(rise_m, abs=0.2)


def test_minimum_thrust_above_hover_prevents_landing() -> None:
    """With a hover thrust of 0.1, SIH of PX4 1.16.1 climbed in AUTO.LAND at 1.7 to 2.3 m/s."""
    bench = hovering_at(0.1)
    bench.command(21)
    bench.run(4.0)
    assert bench.climb_mps == pytest.approx(2.0, abs=0.3)
    bench.set("MPC_THR_MIN", 0.05)
    bench.run_until(lambda: not bench.armed, 60.0)


def test_px4_clips_thrust_and_does_not_check_quaternions() -> None:
    setpoints: tuple[tuple[dict[str, Any], float, float], ...] = (
        ({"thrust": HOVER}, -0.1, 0.1),
        ({"quaternion": (2.0, 0, 0, 0)}, -0.1, 0.1),
        ({"quaternion": (0.0, 0, 0, 0)}, -0.1, 0.1),
        ({"quaternion": (NAN, 0, 0, 0)}, -0.1, 0.1),
        ({"thrust": math.nan}, -5.0, -2.5),
        ({"thrust": HOVER, "mask": 71}, -5.0, -2.5),
        ({"thrust": -1.0}, -5.0, -2.5),
        ({"thrust": 1.5}, 2.5, 6.0),
    )
    bench = engaged()
    for setpoint, low, high in setpoints:
        hold(bench, 3.0)
        before_mps = bench.climb_mps
        bench.run(0.6, lambda given=setpoint: bench.attitude(**given))
        assert low < bench.climb_mps - before_mps < high


def test_setpoints_slower_than_1_hz_trigger_the_failsafe() -> None:
    bench, half = engaged(), math.radians(1.0)
    quaternion = math.cos(half), math.sin(half), 0.0, 0.0
    for period_s in (0.8, 1 / 1.5):
        bench.run(4.0, lambda: bench.attitude(quaternion), period_s)
        assert bench.of("ATTITUDE")[-1][1].roll == pytest.approx(math.radians(2.0), abs=0.01)
        assert bench.mode == OFFBOARD
    assert "Failsafe activated" not in bench.texts()
    bench.run(4.0, bench.attitude, 1 / 0.9)
    assert "Failsafe activated" in bench.texts()


def test_arming_needs_battery_and_a_required_ground_station() -> None:
    bench = Bench(heartbeat_type=None)
    bench.set("NAV_DLL_ACT", 1)
    bench.run(5.0)
    assert bench.command(400, 1) == [1]  # no ground station was ever heard
    bench.heartbeat_type = 6
    for remaining, result in ((0.06, 1), (0.1, 0)):
        bench.instance.autopilot.plant.set_battery(remaining)
        bench.run(1.1)
        assert bench.command(400, 1) == [result]


@pytest.mark.parametrize(
    ("base_mode", "mode"),
    [(4, 0x04040000), (64, 0x00010000), (80, 0x00070000), (72, POSCTL), (16, LOITER)],
)
def test_px4_accepts_a_mode_given_by_base_mode_flags(base_mode: int, mode: int) -> None:
    bench = Bench()
    assert bench.command(176, base_mode) == [0, 0]
    assert bench.mode == mode


def test_px4_has_a_gripper_and_does_not_answer_for_a_gimbal() -> None:
    bench = Bench()
    assert bench.command(211, 1, 1) == [0]
    assert bench.command(1000) == []


def test_px4_landing_continues_without_a_ground_station() -> None:
    """Its pre-arm checks pass, though it could not be armed in this mode."""
    bench = aloft(height_m=30.0)
    bench.set("NAV_DLL_ACT", 2)
    bench.command(21)
    bench.run(0.5)
    assert bench.of("SYS_STATUS")[-1][1].onboard_control_sensors_health & PREARM_CHECK
    bench.heartbeat_type = None
    bench.run(14.0)
    assert (bench.mode, bench.system_status) == (LAND, 4)
    assert "Failsafe activated" not in "".join(bench.texts())


def test_pilot_can_switch_modes_before_the_failsafe_acts() -> None:
    bench = aloft()
    bench.set("COM_LOW_BAT_ACT", 2)
    bench.instance.autopilot.plant.set_battery(0.06)
    bench.run(2.6, bench.attitude)
    assert bench.ask_mode(OFFBOARD) == [0, 0]
    bench.run(5.0, bench.attitude)
    assert (bench.mode, bench.system_status) == (OFFBOARD, 4)


def scenario(*faults: dict[str, Any], **more: Any) -> Scenario:
    return Scenario.model_validate({"name": "x", "faults": faults, **more})


# -- modes and refusals ----------------------------------------------------------------------------


def test_unsupported_scenarios_are_refused() -> None:
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


def test_refusal_fault_rejects_requests_with_its_text() -> None:
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


def test_stuck_message_repeats_its_content_and_optionally_its_stamp() -> None:
    stuck = {"fault": "stuck_message", "message": "ATTITUDE", "for_s": 0.9}
    bench = aloft({**stuck, "at_s": 1.0}, {**stuck, "at_s": 2.0, "stamp_runs": False})
    bench.run(3.0)
    for begin_s, runs in ((1.0, True), (2.0, False)):
        told = [m for at_s, m in bench.of("ATTITUDE", begin_s + 0.05) if at_s < begin_s + 0.9]
        assert len(told) > 50
        assert len({(m.roll, m.pitch, m.rollspeed) for m in told}) == 1
        assert (len({m.time_boot_ms for m in told}) == len(told)) is runs


@pytest.mark.parametrize(("timeout_us", "late"), [(5e6, 895), (2e6, 229)])
def test_gps_loss_drifts_the_estimate_until_the_fix_returns(timeout_us: float, late: int) -> None:
    """PX4 loses it after EKF2_NOAID_TOUT; the estimator's flags then are those before a fix."""
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


def test_stranger_fault_sends_noise_or_spoofed_heartbeats() -> None:
    noise = {"fault": "stranger", "at_s": 1.0, "rate_hz": 1000.0, "size_bytes": 40}
    spoof = {"fault": "stranger", "at_s": 1.0, "rate_hz": 20, "sends": "heartbeat"}
    bench, decoder = Bench(scenario=scenario(noise, spoof)), Decoder()
    bench.run(2.0)
    sent, spoofs = bench.instance.strangers
    assert len(set(sent)) == len(sent) == pytest.approx(1000, abs=4)
    assert {len(datagram) for datagram in sent} == {40}
    messages = [m for each in spoofs for m in decoder.read(each)]
    told = {(m.get_type(), *sender_of(m), m.autopilot) for m in messages}
    assert told == {("HEARTBEAT", 1, 1, 12)}
    assert len(messages) == pytest.approx(20, abs=1)


@pytest.mark.parametrize("firmware", [PX4, ARDUPILOT], ids=lambda firmware: firmware.name)
def test_same_seed_gives_the_same_bytes_with_faults(firmware: Firmware) -> None:
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


def test_thrust_and_mass_changes_scale_the_vertical_force() -> None:
    """Level at hover thrust, the change scales the vertical specific force, which was g before."""
    sinking: tuple[tuple[dict[str, Any], float], ...] = (
        ({"fault": "thrust_change", "thrust_scale": 0.8, "at_s": 2.0}, 0.8),
        ({"fault": "mass_change", "mass_scale": 1.25, "at_s": 6.0}, 0.8),
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


def test_motors_cut_fault_acts_below_its_height() -> None:
    bench = engaged({"fault": "motors_cut", "after": "landing", "below_m": 2.5})
    bench.command(21)
    state = bench.instance.autopilot.state
    bench.run_until(lambda: bench.height_m < 2.6, 20.0)
    assert state.truth.acceleration_ned_mps2[2] < 1.0
    bench.run_until(lambda: bench.height_m < 2.4, 5.0)
    bench.run(0.1)
    assert state.truth.acceleration_ned_mps2[2] > 7.0


def test_vehicle_disarmed_in_flight_falls() -> None:
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


def test_slow_clock_shows_in_truncated_time_stamps() -> None:
    bench = Bench(scenario=Scenario(name="slow", conditions=Conditions(clock_rate=0.9996)))
    bench.run(6.0)
    told = [(m.time_boot_ms, math.floor(at_s * 999.6 + 1e-6)) for at_s, m in bench.of("ATTITUDE")]
    assert all(stamp == expected for stamp, expected in told)
    assert told[-1][0] >= 5980


def test_running_faults_continue_after_a_reboot() -> None:
    """After the reboot the clock counts from zero, without the jump."""
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


def test_flight_starts_at_the_height_of_the_scenario() -> None:
    """A takeoff to 100 m at MPC_TKO_SPEED, 1.5 m/s, takes PX4 more than a minute."""
    bench = Bench(scenario=Scenario(name="high", start=Start(height_m=100.0)))
    assert bench.instance.autopilot.plant.height_m > 99.0
