"""Faults of authority, age, landing and clock, and vehicles that start in the air.

Each is observed in the datagrams of the companion's link or in the true state.
"""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import pytest
from sim_bench import HOVER, LOITER, OFFBOARD, POSCTL, Bench

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
    return Bench(firmware=firmware, scenario=Scenario.model_validate(content))


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


def test_in_a_failsafe_mode_and_intention_differ() -> None:
    bench = engaged()
    bench.command(511, 436, 50_000)
    bench.run(2.0)
    assert modes(bench)[-1][1:] == (POSCTL, OFFBOARD)


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
@pytest.mark.parametrize("place", [(1e38, 8.5, 500.0), (47.0, -3e38, 500.0), (47.0, 8.5, 3e38)])
def test_home_at_an_impossible_place_does_not_end_the_process(
    firmware: Firmware, place: tuple[float, float, float]
) -> None:
    bench = flying(firmware=firmware, start=HIGH)
    bench.run(0.1)
    assert len(bench.command(179, 0, 0, 0, 0, *place)) == 1
    bench.command(20)
    bench.run(5.0)
    bench.command(512, 242)
    assert bench.of("HOME_POSITION") != []


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
