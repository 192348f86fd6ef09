"""Arming, targets and forced disarming of the simulated PX4; recordings have the refusals."""

from __future__ import annotations

import pytest
from pymavlink.dialects.v20 import common as mavlink
from sim_bench import HOVER, OFFBOARD, Bench


def armed(bench: Bench) -> None:
    bench.boot()
    bench.command(400, 1)


def flying(bench: Bench) -> None:
    bench.boot()
    bench.take_off()


@pytest.mark.parametrize("to", [(2, 1), (1, 2), (0, 191)])
def test_a_command_to_another_target_is_ignored(to: tuple[int, int]) -> None:
    bench = Bench()
    bench.boot()
    assert bench.command(400, 1, to=to) == []
    assert not bench.armed


def test_command_int() -> None:
    bench = Bench()
    bench.boot()
    bench.send(
        mavlink.MAVLink_command_int_message(1, 1, 0, 400, 0, 0, 1.0, 0.0, 0.0, 0.0, 0, 0, 0.0)
    )
    bench.run(0.02)
    assert bench.armed


def test_heartbeat_and_prearm_bit_show_whether_it_can_arm() -> None:
    """system_status and the pre-arm bit: 3 about 4 s after boot, 0 in OFFBOARD without stream."""
    bench = Bench()
    bench.boot()
    statuses = [(round(t), m.system_status) for t, m in bench.of("HEARTBEAT")]
    assert statuses == [(0, 0), (1, 0), (2, 0), (3, 0), (4, 3), (5, 3)]
    assert bench.of("SYS_STATUS")[-1][1].onboard_control_sensors_health & 0x10000000
    bench.ask_mode(OFFBOARD)
    bench.run(1.0)
    heartbeat = bench.of("HEARTBEAT")[-1][1]
    assert (heartbeat.custom_mode, heartbeat.system_status, heartbeat.base_mode) == (OFFBOARD, 0, 1)
    assert not bench.of("SYS_STATUS")[-1][1].onboard_control_sensors_health & 0x10000000
    bench.run(1.2, bench.attitude)
    heartbeat = bench.of("HEARTBEAT")[-1][1]
    assert (heartbeat.system_status, heartbeat.base_mode) == (3, 17)


def test_forced_disarm_in_the_air_lets_it_fall() -> None:
    bench = Bench()
    flying(bench)
    bench.run(5.0)  # until it hovers
    height_m = bench.height_m
    bench.command(400, 0, 21196)
    bench.run(0.48)
    fallen_m = height_m - bench.height_m
    assert 9.81 * 0.4**2 / 2 < fallen_m < 9.81 * 0.5**2 / 2  # the rotors stop within 0.1 s


def test_after_a_forced_disarm_it_flies_again() -> None:
    bench = Bench()
    flying(bench)
    bench.command(400, 0, 21196)
    bench.run(3.0)
    assert bench.height_m < 0.05
    bench.run(0.6, bench.attitude)
    assert bench.ask_mode(OFFBOARD) == [0, 0]
    assert bench.command(400, 1) == [0]
    bench.run(2.0, lambda: bench.attitude(thrust=1.2 * HOVER))
    assert bench.height_m > 1.0
