"""Setpoints in global coordinates and in the body's frame, and PX4's texts about other frames."""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from sim_bench import NAN, Bench

from simulator.firmware.px4 import PX4

POSITION, VELOCITY, YAWED_POSITION = 2552 | 1024, 0b1101_1100_0111, 2552
GLOBAL, RELATIVE, TERRAIN, BODY = 5, 6, 11, 8
NORTH, EAST, UP = 3.0, -2.0, 4.0


def global_target(
    frame: int, altitude_m: float, mask: int = POSITION, velocity: float = 0.0
) -> object:
    latitude, longitude, _ = PX4.origin
    north_deg = math.degrees(NORTH / 6_371_000)
    east_deg = math.degrees(EAST / 6_371_000 / math.cos(math.radians(latitude)))
    places = (round((latitude + north_deg) * 1e7), round((longitude + east_deg) * 1e7))
    return mavlink.MAVLink_set_position_target_global_int_message(
        0, 1, 1, frame, mask, *places, altitude_m, velocity, *(0.0,) * 7
    )


def body_velocity(ahead: float, aside: float, frame: int = BODY) -> object:
    return mavlink.MAVLink_set_position_target_local_ned_message(
        0, 1, 1, frame, VELOCITY | 1024, 0, 0, 0, ahead, aside, 0, 0, 0, 0, 0, 0
    )


def flown(send: Callable[[Bench], None], duration_s: float) -> Bench:
    bench = Bench()
    bench.fly_offboard()
    bench.run(duration_s, lambda: send(bench))
    return bench


@pytest.mark.parametrize(
    ("frame", "altitude_m"), [(GLOBAL, PX4.origin[2] + UP), (RELATIVE, UP), (TERRAIN, UP)]
)
def test_a_global_position_is_flown_to(frame: int, altitude_m: float) -> None:
    bench = flown(lambda b: b.send(global_target(frame, altitude_m)), 10.0)
    _, here = bench.of("LOCAL_POSITION_NED")[-1]
    assert (here.x, here.y, here.z) == pytest.approx((NORTH, EAST, -UP), abs=0.1)


def test_a_global_velocity_needs_no_position() -> None:
    mask = VELOCITY & ~0b111 | 0b001  # one coordinate ignored: PX4 ignores the place
    bench = flown(lambda b: b.send(global_target(99, UP, mask, 1.0)), 4.0)
    _, here = bench.of("LOCAL_POSITION_NED")[-1]
    assert here.vx == pytest.approx(0.9, abs=0.15)


def test_a_body_velocity_is_rotated_by_yaw() -> None:
    bench = Bench()
    bench.fly_offboard()
    turn = mavlink.MAVLink_set_position_target_local_ned_message(
        0, 1, 1, 1, YAWED_POSITION & ~1024, 0, 0, -3, *(0.0,) * 6, math.radians(120.0), 0
    )
    bench.run(5.0, lambda: bench.send(turn))
    bench.run(4.0, lambda: bench.send(body_velocity(1.0, 0.5)))
    _, here = bench.of("LOCAL_POSITION_NED")[-1]
    c, s = math.cos(math.radians(120.0)), math.sin(math.radians(120.0))
    assert (here.vx, here.vy) == pytest.approx((c - 0.5 * s, s + 0.5 * c), rel=0.25)
    assert here.vy / here.vx == pytest.approx((s + 0.5 * c) / (c - 0.5 * s), rel=0.05)


@pytest.mark.parametrize(
    ("message", "text"),
    [
        (
            body_velocity(1, 0, 9),
            "SET_POSITION_TARGET_LOCAL_NED coordinate frame 9 unsupported",
        ),
        (
            global_target(1, 3.0),
            "SET_POSITION_TARGET_GLOBAL_INT invalid coordinate frame 1",
        ),
        (
            mavlink.MAVLink_set_position_target_local_ned_message(0, 1, 1, 1, 0xFFF, *(0.0,) * 11),
            "SET_POSITION_TARGET_LOCAL_NED invalid",
        ),
    ],
)
def test_other_frames_are_refused_with_a_text_and_keep_no_stream(
    message: object, text: str
) -> None:
    bench = Bench()
    bench.boot()
    bench.send(message)
    bench.run(0.1)
    assert bench.texts() == [text]
    assert not bench.instance.autopilot.stream.alive(bench.time_s)


def test_nan_coordinates_are_not_demanded() -> None:
    bench = flown(lambda b: b.send(global_target(RELATIVE, NAN)), 3.0)
    _, here = bench.of("LOCAL_POSITION_NED")[-1]
    assert all(map(math.isfinite, (here.x, here.y, here.z)))


def test_px4_subtracts_the_height_of_home_with_the_wrong_sign() -> None:
    """Home set 8 m up, 4 m above it asked for: the real one went to the ground."""
    bench = Bench()
    bench.fly_offboard()
    bench.run(9.0, lambda: bench.position(0.0, 0.0, -8.0))
    assert bench.command(179, 1) == [0]
    bench.run(7.0, lambda: bench.send(global_target(RELATIVE, UP)))
    assert bench.height_m < 0.5
