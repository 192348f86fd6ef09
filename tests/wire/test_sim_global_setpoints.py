"""Setpoints in global coordinates and in the body's frame, and PX4's texts about other frames."""

from __future__ import annotations

import math
from collections.abc import Callable

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


def flown(send: Callable[[Bench], None], duration_s: float) -> Bench:
    bench = Bench()
    bench.fly_offboard()
    bench.run(duration_s, lambda: send(bench))
    return bench


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
