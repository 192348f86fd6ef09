"""Arming, modes and refusals of the simulated PX4, one row per situation measured on PX4 1.16."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import pytest
from pymavlink.dialects.v20 import common as mavlink
from sim_bench import HOVER, LAND, LOITER, NAN, OFFBOARD, POSCTL, RTL, TAKEOFF, Bench

ACCEPTED, LATER, DENIED, UNSUPPORTED, FAILED = range(5)
DENIED_TEXT = "Arming denied: Resolve system health failures first"


def asleep(bench: Bench) -> None:
    bench.run(1.0)


def streaming(bench: Bench) -> None:
    bench.boot()
    bench.run(0.6, bench.attitude)


def offboard(bench: Bench) -> None:
    streaming(bench)
    bench.ask_mode(OFFBOARD)


def offboard_without_stream(bench: Bench) -> None:
    bench.boot()
    bench.ask_mode(OFFBOARD)


def armed(bench: Bench) -> None:
    bench.boot()
    bench.command(400, 1)


def landing_mode(bench: Bench) -> None:
    bench.boot()
    bench.command(21)


def posctl(bench: Bench) -> None:
    bench.boot()
    bench.ask_mode(POSCTL)


def flying(bench: Bench) -> None:
    bench.boot()
    bench.take_off()


@dataclass(frozen=True)
class Row:
    title: str
    before: Callable[[Bench], None]
    command: tuple[float, ...]
    acks: list[int]
    mode: int
    armed: bool
    says: str | None = None


SET_OFFBOARD, SET_HOLD = (176, 1, 6, 0), (176, 1, 4, 3)
ROWS = [
    Row("offboard, disarmed, no stream", Bench.boot, SET_OFFBOARD, [0, 0], OFFBOARD, False),
    Row("offboard, disarmed, with stream", streaming, SET_OFFBOARD, [0, 0], OFFBOARD, False),
    Row("offboard, as MAVSDK asks", streaming, (176, 129, 6, 0), [0, 0], OFFBOARD, False),
    Row("arm, offboard without stream", offboard_without_stream, (400, 1), [LATER], OFFBOARD,
        False, DENIED_TEXT),
    Row("arm, offboard with stream", offboard, (400, 1), [0], OFFBOARD, True,
        "Armed by external command"),
    Row("arm before health", asleep, (400, 1), [LATER], LOITER, False, DENIED_TEXT),
    Row("arm before health, forced", asleep, (400, 1, 21196), [0], LOITER, True),
    Row("arm in hold", Bench.boot, (400, 1, NAN, NAN, NAN, NAN, NAN), [0], LOITER, True),
    Row("arm in land mode", landing_mode, (400, 1), [LATER], LAND, False, DENIED_TEXT),
    Row("arm twice", armed, (400, 1), [0], LOITER, True),
    Row("disarm when disarmed", Bench.boot, (400, 0), [0], LOITER, False),
    Row("disarm on the ground", armed, (400, 0), [0], LOITER, False,
        "Disarmed by external command"),
    Row("disarm in the air", flying, (400, 0), [LATER], LOITER, True,
        "Disarming denied: not landed"),
    Row("disarm in the air, forced", flying, (400, 0, 21196), [0], LOITER, False),
    Row("arm with a strange wish", Bench.boot, (400, 2), [], LOITER, False,
        "Unsupported ARM_DISARM param: 2.000"),
    Row("arm with half a wish, which is rounded", Bench.boot, (400, 0.6), [0], LOITER, True),
    Row("arm with NaN, which disarms", armed, (400, NAN), [0], LOITER, False),
    Row("offboard in the air, no stream", flying, SET_OFFBOARD, [0, LATER], LOITER, True),
    Row("position control without sticks", flying, (176, 1, 3, 0), [0, LATER], LOITER, True),
    Row("position control, disarmed", Bench.boot, (176, 1, 3, 0), [0, 0], POSCTL, False),
    Row("hold from offboard", Bench.fly_offboard, SET_HOLD, [0, 0], LOITER, True),
    Row("land", flying, (21, 0, 0, 0, NAN), [0], LAND, True, "Landing at current position"),
    Row("return", flying, (20,), [0], RTL, True, "Returning to launch"),
    Row("takeoff, disarmed", Bench.boot, (22, *(NAN,) * 7)[:8], [0], TAKEOFF, False),
    Row("unknown main mode", Bench.boot, (176, 1, 99, 0), [0, 0], LOITER, False),
    Row("unknown auto mode", Bench.boot, (176, 1, 4, 99), [0, LATER], LOITER, False,
        "Unsupported auto mode"),
    Row("mode without custom flag", Bench.boot, (176, 0, 6, 0), [0, 0], LOITER, False),
    Row("mode of NaN", Bench.boot, (176, *(NAN,) * 7)[:8], [0, 0], LOITER, False),
    Row("arm in position control", posctl, (400, 1), [LATER], POSCTL, False, DENIED_TEXT),
    Row("reboot, which SITL cannot", Bench.boot, (246, 1), [DENIED], LOITER, False),
    Row("taken and not carried out", Bench.boot, (80,), [0], LOITER, False),
    Row("not answered", Bench.boot, (93,), [], LOITER, False),
    Row("reposition on the ground", Bench.boot, (192, -1, 1, 0, NAN, 47.4, 8.5, 500), [0, ],
        LOITER, False),
    Row("reposition without a change of mode", flying, (192, -1, 0), [UNSUPPORTED], LOITER, True),
    Row("unknown command", Bench.boot, (31000,), [UNSUPPORTED], LOITER, False),
]  # fmt: skip


@pytest.mark.parametrize("row", ROWS, ids=lambda row: row.title)
def test_command(row: Row) -> None:
    bench = Bench()
    row.before(bench)
    since_s = bench.time_s
    number, *params = row.command
    assert bench.command(int(number), *params) == row.acks
    assert (bench.mode, bench.armed) == (row.mode, row.armed)
    assert row.says in [None, *bench.texts(since_s)]


@pytest.mark.parametrize("to", [(2, 1), (1, 2), (0, 191)])
def test_a_command_to_another_target_is_ignored(to: tuple[int, int]) -> None:
    bench = Bench()
    bench.boot()
    assert bench.command(400, 1, to=to) == []
    assert not bench.armed


@pytest.mark.parametrize("to", [(1, 1), (1, 0), (0, 0)])
def test_acknowledgements_carry_the_ids_of_the_sender(to: tuple[int, int]) -> None:
    bench = Bench()
    bench.boot()
    assert bench.command(400, 1, to=to) == [ACCEPTED]
    ((_, ack),) = bench.of("COMMAND_ACK")
    assert (ack.target_system, ack.target_component) == (1, 191)


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


def test_an_armed_vehicle_that_does_not_fly_disarms_after_ten_seconds() -> None:
    bench = Bench()
    armed(bench)
    begun_s = bench.time_s
    ended_s = bench.run_until(lambda: not bench.armed, 11.0)
    assert ended_s - begun_s == pytest.approx(10.0, abs=0.05)
    bench.run(0.1)
    assert bench.texts()[-1] == "Disarmed by auto preflight disarming"


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
