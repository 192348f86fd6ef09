"""Yaw, speed and places in automatic flight, asked of vehicles in the air.

Expected values are those of ArduCopter 4.6.3 and PX4 1.16.1 SITL, asked the same.
"""

from __future__ import annotations

import math

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from sim_bench import NAN, Bench, aloft

from simulator.firmware.ardupilot import ARDUPILOT
from simulator.firmware.base import Firmware
from simulator.firmware.px4 import PX4
from simulator.firmware.values import MissionItem
from simulator.geodesy import EARTH_RADIUS_M

ACCEPTED, DENIED, UNSUPPORTED = 0, 2, 3
POSITION_ALONE, VELOCITY_ALONE = 0xDF8, 0xDC7
RELATIVE, ABSOLUTE = 6, 5  # MAV_FRAME


def copter() -> Bench:
    bench = aloft(firmware=ARDUPILOT, height_m=5.0, mode="GUIDED")
    bench.run(1.0)
    return bench


def degrees(bench: Bench, north: float, east: float) -> tuple[float, float]:
    """Latitude and longitude, so many metres from the origin of the local frame."""
    latitude, longitude, _ = bench.instance.autopilot.firmware.origin
    shrink = math.cos(math.radians(latitude))
    north_deg, east_deg = (math.degrees(way / EARTH_RADIUS_M) for way in (north, east))
    return latitude + north_deg, longitude + east_deg / shrink


def reposition(
    bench: Bench, north: float, east: float, up: float, frame: int, yaw: float = NAN
) -> int:
    x, y = (round(value * 1e7) for value in degrees(bench, north, east))
    return command_int(bench, frame, 192, -1.0, 1, 0, yaw, x, y, up)


def command_int(bench: Bench, frame: int, number: int, *params: float) -> int:
    """The result of a COMMAND_INT."""
    bench.send(mavlink.MAVLink_command_int_message(1, 1, frame, number, 0, 0, *params))
    bench.run(0.02)
    return int(bench.of("COMMAND_ACK")[-1][1].result)


def off_deg(bench: Bench, wanted_deg: float) -> float:
    return abs(math.remainder(bench.heading_deg - wanted_deg, 360.0))


def fastest_mps(bench: Bench, duration_s: float) -> float:
    speeds = []
    bench.run(duration_s, lambda: speeds.append(math.hypot(*bench.velocity[:2])))
    return max(speeds)


def test_a_turn_has_the_requested_rate() -> None:
    bench = copter()
    for params, wanted_deg, took_s in (((90, 25, 1), 90.0, 4.0), ((45, 10, -1, 1), 45.0, 4.5)):
        begun_s = bench.time_s
        assert bench.command(115, *params) == [ACCEPTED]
        done_s = bench.run_until(lambda to=wanted_deg: off_deg(bench, to) < 3.0, 12.0)
        assert done_s - begun_s == pytest.approx(took_s, abs=0.6)
        bench.run(2.0)


def test_a_requested_speed_holds_until_a_setpoint_of_another_kind() -> None:
    """4 m/s asked on the way, 4.1 flown."""
    bench = copter()

    def go(north: float) -> None:
        bench.position(north, 0.0, -5.0, POSITION_ALONE)

    go(30.0)
    assert bench.command(178, 1, 4.0, -1) == [ACCEPTED]
    assert fastest_mps(bench, 12.0) == pytest.approx(4.1, abs=0.4)
    assert bench.place[0] == pytest.approx(30.0, abs=0.3)
    go(0.0)
    assert fastest_mps(bench, 6.0) == pytest.approx(4.1, abs=0.4)
    bench.position(0.0, 0.0, 0.0, VELOCITY_ALONE)
    bench.run(3.0)
    go(60.0)
    assert fastest_mps(bench, 6.0) > 7.0


def test_reposition_of_arducopter_accelerates_and_brakes_as_the_real_one() -> None:
    """Metres from the start, second by second. It takes it as COMMAND_INT alone."""
    bench = copter()
    assert bench.command(192, -1, 1, 0, NAN, 0, 0, 10) == [UNSUPPORTED]
    assert reposition(bench, 40.0, 0.0, 5.0, RELATIVE) == ACCEPTED
    flown, speeds = [], []
    for _ in range(8):
        speeds.append(fastest_mps(bench, 1.0))
        flown.append(bench.place[0])
    assert flown == pytest.approx((1.0, 4.4, 11.0, 19.3, 27.1, 33.5, 38.0, 40.4), abs=3.5)
    assert max(speeds) == pytest.approx(7.7, abs=1.0)
    bench.run(6.0)
    assert bench.place == pytest.approx((40.0, 0.0, -5.0), abs=0.9)


@pytest.mark.parametrize(
    ("firmware", "x", "frame", "result"),
    [
        (PX4, 2**31 - 1, ABSOLUTE, ACCEPTED),  # "no place": the present one
        (ARDUPILOT, 2**31 - 1, RELATIVE, DENIED),
        (ARDUPILOT, 950_000_000, RELATIVE, DENIED),
    ],
)
def test_a_reposition_without_a_place_flies_nowhere(
    firmware: Firmware, x: int, frame: int, result: int
) -> None:
    bench = aloft(firmware=firmware, height_m=5.0, mode="GUIDED" if firmware is ARDUPILOT else None)
    bench.run(1.0)
    up_m = 5.0 + (bench.instance.autopilot.firmware.origin[2] if frame == ABSOLUTE else 0.0)
    assert command_int(bench, frame, 192, -1.0, 1, 0, NAN, x, x, up_m) == result
    bench.run(3.0)
    assert bench.place == pytest.approx((0.0, 0.0, -5.0), abs=0.5)


@pytest.mark.parametrize("item", [False, True], ids=["command", "item"])
@pytest.mark.parametrize(("firmware", "obeys"), [(PX4, True), (ARDUPILOT, False)])
def test_a_climb_speed_is_one_across_for_px4_alone(
    firmware: Firmware, obeys: bool, item: bool
) -> None:
    bench = aloft(firmware=firmware, height_m=5.0, mode="GUIDED" if firmware is ARDUPILOT else None)
    autopilot = bench.instance.autopilot
    x, y = (round(value * 1e7) for value in degrees(bench, 30.0, 0.0))
    up_m = autopilot.firmware.origin[2] + 5.0
    if item:
        home = MissionItem(5, 16, (0.0,) * 4, x, y, up_m)
        speed = MissionItem(2, 178, (2.0, 1.5, -1.0, 0.0), 0, 0, 0.0)
        autopilot.mission.store((home, speed, home)[firmware is PX4 :])
        assert bench.command(300) == [ACCEPTED]
    else:
        assert command_int(bench, ABSOLUTE, 192, -1.0, 1, 0, NAN, x, y, up_m) == ACCEPTED
        assert bench.command(178, 2, 1.5, -1) == [ACCEPTED]
    assert (fastest_mps(bench, 6.0) < 2.0) is obeys


@pytest.mark.parametrize(
    ("mode", "number", "frame", "params", "result"),
    [
        ("GUIDED", 115, RELATIVE, (400.0, 10.0, 1.0, 0.0), 4),
        ("GUIDED", 115, RELATIVE, (90.0, 10.0, 1.0, 0.5), 4),
        ("GUIDED", 300, RELATIVE, (0.0, 1.0, 0.0, 0.0), DENIED),
        ("GUIDED", 22, ABSOLUTE, (0.0, 0.0, 0.0, 0.0), DENIED),
        ("GUIDED", 192, RELATIVE, (-1.0, 0.0, 0.0, NAN), ACCEPTED),
        ("LOITER", 192, RELATIVE, (-1.0, 0.0, 0.0, NAN), DENIED),
        ("GUIDED", 510, RELATIVE, (60_000.0, 0.0, 0.0, 0.0), 4),
    ],
)
def test_what_arducopter_refuses(
    mode: str, number: int, frame: int, params: tuple[float, ...], result: int
) -> None:
    bench = aloft(firmware=ARDUPILOT, height_m=5.0, mode=mode)
    x, y = (round(value * 1e7) for value in degrees(bench, 5.0, 0.0))
    assert command_int(bench, frame, number, *params, x, y, 5.0) == result


@pytest.mark.parametrize("kind", ["", "_int"])
def test_arducopter_flies_to_a_guided_mission_item_at_once(kind: str) -> None:
    """As DroneKit's simple_goto asks."""
    bench = copter()
    x, y = degrees(bench, 0.0, 20.0)
    where = (round(x * 1e7), round(y * 1e7)) if kind else (x, y)
    pack = getattr(mavlink, f"MAVLink_mission_item{kind}_message")
    asked = pack(0, 0, 0, 3, 16, 2, 0, 0, 0, 0, 0, *where, 8.0)
    bench.send(asked)
    bench.run(12.0)
    assert [m.type for _, m in bench.of("MISSION_ACK")] == [0]
    assert bench.place == pytest.approx((0.0, 20.0, -8.0), abs=0.7)  # degrees as floats: 0.4 m
    bench.command(176, 1, 9)  # LAND
    bench.send(asked)
    bench.run(0.02)
    assert bench.of("MISSION_ACK")[-1][1].type == 1


def test_px4_faces_its_goal_and_then_takes_the_requested_yaw() -> None:
    bench = aloft(height_m=3.0)
    amsl_m = bench.instance.autopilot.firmware.origin[2] + 3.0
    assert reposition(bench, 0.0, 30.0, amsl_m, ABSOLUTE) == ACCEPTED
    bench.run(4.0)
    assert off_deg(bench, 90.0) < 6.0
    bench.run(10.0)
    assert reposition(bench, 0.0, 30.0, amsl_m, ABSOLUTE, math.radians(-45)) == ACCEPTED
    bench.run(0.5)  # 135 degrees at 45 a second
    assert off_deg(bench, 90.0) < 30.0
    bench.run(4.5)
    assert off_deg(bench, -45.0) < 3.0
    assert reposition(bench, 1.0, 30.0, amsl_m, ABSOLUTE) == ACCEPTED  # nearer than NAV_ACC_RAD
    bench.run(4.0)
    assert off_deg(bench, -45.0) < 3.0


@pytest.mark.parametrize(
    ("firmware", "beats", "later", "said"),
    [
        # base_mode, custom_mode, system_status after the fall, answer to arming
        (PX4, (1, 0xA0000, 8), 1, ["Failsafe activated"]),
        (ARDUPILOT, (89, 4, 3), 0, ["Disarming motors"]),
    ],
    ids=["px4", "ardupilot"],
)
def test_a_terminated_flight_falls_and_only_px4_does_not_arm_again(
    firmware: Firmware, beats: tuple[int, ...], later: int, said: list[str]
) -> None:
    """MAV_CMD_DO_FLIGHTTERMINATION. PX4 stays in its mode until it is started again."""
    bench = aloft(firmware=firmware, height_m=5.0, mode="GUIDED" if firmware is ARDUPILOT else None)
    assert bench.command(185, 0) == [2 if firmware is PX4 else 4]
    assert bench.armed
    begun_s = bench.time_s
    assert bench.command(185, 1) == [ACCEPTED]
    bench.run(3.0)
    assert (bench.armed, bench.height_m) == (False, pytest.approx(0.0, abs=0.1))
    assert bench.texts(begun_s) == said
    beat = bench.of("HEARTBEAT")[-1][1]
    assert (beat.base_mode, beat.custom_mode, beat.system_status) == beats
    assert bench.command(176, 1, 4, 3)[-1] == later
    assert bench.command(400, 1) == [later]
