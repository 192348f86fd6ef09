"""Yaw and speed in automatic flight: body frames, direction of flight, requested turns and speeds.

Expected values are those of ArduCopter 4.6.3 and PX4 1.16.1 SITL, asked the same.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from sim_bench import LOITER, NAN, Bench
from sim_courses import copter, heading_deg, place, velocity

from simulator.geodesy import EARTH_RADIUS_M

ACCEPTED, UNSUPPORTED = 0, 3
POSITION_ALONE, VELOCITY_ALONE = 0xDF8, 0xDC7
LOCAL = 1  # MAV_FRAME
RELATIVE, ABSOLUTE = 6, 5


def px4() -> Bench:
    """A PX4 that holds 3 m."""
    bench = Bench()
    bench.fly_offboard()
    bench.ask_mode(LOITER)
    return bench


def ask(
    bench: Bench,
    frame: int,
    place: tuple[float, float, float] = (0.0, 0.0, 0.0),
    velocity: tuple[float, float, float] = (0.0, 0.0, 0.0),
    *,
    mask: int = POSITION_ALONE,
    yaw: float = 0.0,
) -> None:
    bench.send(
        mavlink.MAVLink_set_position_target_local_ned_message(
            0, 1, 1, frame, mask, *place, *velocity, 0, 0, 0, yaw, 0
        )
    )


def degrees(bench: Bench, north: float, east: float) -> tuple[float, float]:
    """Latitude and longitude, so many metres from the origin of the local frame."""
    latitude, longitude, _ = bench.instance.autopilot.firmware.origin
    shrink = math.cos(math.radians(latitude))
    north_deg, east_deg = (math.degrees(way / EARTH_RADIUS_M) for way in (north, east))
    return latitude + north_deg, longitude + east_deg / shrink


def reposition(
    bench: Bench,
    north: float,
    east: float,
    up: float,
    frame: int,
    yaw: float = NAN,
    speed: float = -1.0,
) -> int:
    x, y = (round(value * 1e7) for value in degrees(bench, north, east))
    asked = (frame, 192, 0, 0, speed, 1, 0, yaw, x, y, up)
    bench.send(mavlink.MAVLink_command_int_message(1, 1, *asked))
    bench.run(0.02)
    return int(bench.of("COMMAND_ACK")[-1][1].result)


def off_deg(bench: Bench, wanted_deg: float) -> float:
    return abs(math.remainder(heading_deg(bench) - wanted_deg, 360.0))


def fastest_mps(bench: Bench, duration_s: float) -> float:
    speeds = []
    bench.run(duration_s, lambda: speeds.append(math.hypot(*velocity(bench)[:2])))
    return max(speeds)


@pytest.mark.parametrize(
    ("params", "wanted_deg", "took_s"), [((90, 25, 1), 90.0, 4.0), ((45, 10, -1, 1), -45.0, 4.5)]
)
def test_a_turn_has_the_requested_rate(
    params: tuple[float, ...], wanted_deg: float, took_s: float
) -> None:
    bench = copter()
    begun_s, begun_deg = bench.time_s, heading_deg(bench)
    assert bench.command(115, *params) == [ACCEPTED]
    from_deg = begun_deg if len(params) == 4 else 0.0
    done_s = bench.run_until(lambda: off_deg(bench, from_deg + wanted_deg) < 3.0, 12.0)
    assert done_s - begun_s == pytest.approx(took_s, abs=0.6)


def test_a_requested_speed_holds_until_a_setpoint_of_another_kind() -> None:
    """4 m/s asked on the way, 4.1 flown; asked before, it is forgotten: the takeoff was another."""
    bench = copter()
    ask(bench, LOCAL, (30.0, 0.0, -5.0))
    assert bench.command(178, 1, 4.0, -1) == [ACCEPTED]
    assert fastest_mps(bench, 12.0) == pytest.approx(4.1, abs=0.4)
    assert place(bench)[0] == pytest.approx(30.0, abs=0.3)
    ask(bench, LOCAL, (0.0, 0.0, -5.0))
    assert fastest_mps(bench, 6.0) == pytest.approx(4.1, abs=0.4)
    ask(bench, LOCAL, velocity=(0.0, 0.0, 0.0), mask=VELOCITY_ALONE)
    bench.run(3.0)
    ask(bench, LOCAL, (60.0, 0.0, -5.0))
    assert fastest_mps(bench, 6.0) > 7.0


def test_reposition_of_arducopter_needs_a_frame() -> None:
    """ArduCopter takes it as COMMAND_INT alone."""
    bench = copter()
    assert bench.command(192, -1, 1, 0, NAN, 0, 0, 10) == [UNSUPPORTED]
    assert reposition(bench, 0.0, 20.0, 8.0, RELATIVE) == ACCEPTED
    bench.run(10.0)
    assert place(bench) == pytest.approx((0.0, 20.0, -8.0), abs=0.3)


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
    assert place(bench) == pytest.approx((0.0, 20.0, -8.0), abs=0.7)  # degrees as floats: 0.4 m
    bench.command(176, 1, 9)  # LAND
    bench.send(asked)
    bench.run(0.02)
    assert bench.of("MISSION_ACK")[-1][1].type == 1


def test_px4_faces_its_goal_and_then_takes_the_requested_yaw() -> None:
    bench = px4()
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
    ("vehicle", "frame", "places_m", "fastest"),
    [
        # metres from the start, second by second, as the real ones went 40 m
        (copter, RELATIVE, (1.0, 4.4, 11.0, 19.3, 27.1, 33.5, 38.0, 40.4), 7.7),
        (px4, ABSOLUTE, (0.3, 1.0, 3.9, 7.6, 11.6, 15.8, 20.0, 24.2, 28.5, 32.4, 35.5, 37.8), 4.5),
    ],
    ids=["ardupilot", "px4"],
)
def test_acceleration_and_braking_on_the_way_to_a_place(
    vehicle: Callable[[], Bench], frame: int, places_m: tuple[float, ...], fastest: float
) -> None:
    bench = vehicle()
    height_m = bench.height_m
    up = height_m if frame == RELATIVE else bench.instance.autopilot.firmware.origin[2] + height_m
    assert reposition(bench, 40.0, 0.0, up, frame) == ACCEPTED
    flown, speeds = [], []
    for _ in places_m:
        speeds.append(fastest_mps(bench, 1.0))
        flown.append(place(bench)[0])
    assert flown == pytest.approx(places_m, abs=3.5)
    assert max(speeds) == pytest.approx(fastest, abs=1.0)
    bench.run(6.0)
    assert place(bench)[0] == pytest.approx(40.0, abs=0.9)
