"""Commands in flight, as measured on PX4 1.16.1 and ArduCopter 4.6.3."""

from __future__ import annotations

import math

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from sim_bench import NAN, Bench

from simulator.firmware.ardupilot import ARDUPILOT
from simulator.firmware.base import Firmware
from simulator.firmware.px4 import PX4

ACCEPTED, LATER, DENIED, FAILED = 0, 1, 2, 4
GUIDED = 4
CHANGE_SPEED, TURN, REPOSITION, INTERVAL, REQUEST = 178, 115, 192, 511, 512
SEA_LEVEL_INT = 5


def flying(firmware: Firmware) -> Bench:
    """In the mode that holds and may be told where, some metres up."""
    bench = Bench(firmware=firmware, boot_scale=0.1 if firmware is ARDUPILOT else 1.0)
    bench.boot()
    bench.command(176, 1, *((GUIDED,) if firmware is ARDUPILOT else (4, 3)))
    assert bench.command(400, 1) == [ACCEPTED]
    height_m = 5.0 if firmware is ARDUPILOT else PX4.origin[2] + 5.0
    assert bench.command(22, 0, 0, 0, 0, NAN, NAN, height_m) == [ACCEPTED]
    bench.run(13.0)
    assert bench.height_m == pytest.approx(5.0, abs=0.3)
    return bench


def yaw_rad(bench: Bench) -> float:
    return float(bench.of("ATTITUDE")[-1][1].yaw)


def go_north(bench: Bench, north_m: float, yaw: float) -> None:
    latitude, longitude, height_m = bench.instance.autopilot.firmware.origin
    bench.send(
        mavlink.MAVLink_command_int_message(
            *(1, 1, SEA_LEVEL_INT, REPOSITION, 0, 0, -1, 1, 0, yaw),
            round((latitude + math.degrees(north_m / 6_371_000)) * 1e7),
            *(round(longitude * 1e7), height_m + 5.0),
        )
    )


@pytest.mark.parametrize("firmware", [PX4, ARDUPILOT], ids=["px4", "ardupilot"])
def test_a_changed_speed_is_flown_until_another_mode(firmware: Firmware) -> None:
    """ArduCopter forgets one that was asked for before its first place to go to."""
    bench = flying(firmware)
    go_north(bench, 0.0, NAN)
    assert bench.command(CHANGE_SPEED, 1, 2.0, -1) == [ACCEPTED]
    go_north(bench, 40.0, NAN)
    bench.run(8.0)
    speed_mps = bench.instance.autopilot.state.truth.velocity_ned_mps[0]
    assert speed_mps == pytest.approx(1.9, abs=0.15)  # against drag
    bench.command(21)
    bench.command(176, 1, *((GUIDED,) if firmware is ARDUPILOT else (4, 3)))
    go_north(bench, 40.0, NAN)
    bench.run(3.0)
    assert bench.instance.autopilot.state.truth.velocity_ned_mps[0] > 3.0


@pytest.mark.parametrize(("firmware", "answer"), [(PX4, ACCEPTED), (ARDUPILOT, FAILED)])
def test_a_speed_that_is_not_positive_restores_the_default(firmware: Firmware, answer: int) -> None:
    bench = Bench(firmware=firmware)
    asked = ((1, -1.0), (1, NAN), (0, 3.0), (2, 3.0))
    answers = [bench.command(CHANGE_SPEED, *params)[0] for params in asked]
    assert answers == [answer, answer, ACCEPTED, ACCEPTED]


def test_px4_takes_the_yaw_of_a_reposition_and_keeps_coordinates_that_are_nan() -> None:
    bench = flying(PX4)
    go_north(bench, 3.0, math.pi / 2)
    bench.run(6.0)
    assert yaw_rad(bench) == pytest.approx(math.pi / 2, abs=0.03)
    for nothing in (NAN, math.inf):
        assert bench.command(REPOSITION, -1, 1, 0, *(nothing,) * 4) == [ACCEPTED]
        bench.run(3.0)
        truth = bench.instance.autopilot.state.truth
        assert truth.position_ned_m[[0, 2]] == pytest.approx([3.0, -5.0], abs=0.3)


def test_arducopter_lifts_off_to_a_reposition_without_a_finite_yaw() -> None:
    bench = Bench(firmware=ARDUPILOT, boot_scale=0.1)
    bench.boot()
    bench.command(176, 1, GUIDED)
    assert bench.command(400, 1) == [ACCEPTED]
    go_north(bench, 0.0, math.inf)
    bench.run(8.0)
    assert bench.height_m > 2.0


def test_arducopter_turns_to_a_yaw_and_by_an_angle() -> None:
    bench = flying(ARDUPILOT)
    bench.command(INTERVAL, 30, 100_000)
    assert bench.command(TURN, 90, 0, 1, 0) == [ACCEPTED]
    bench.run(4.0)
    assert yaw_rad(bench) == pytest.approx(math.pi / 2, abs=0.03)
    assert bench.command(TURN, 30, 20, -1, 1) == [ACCEPTED]
    bench.run(4.0)
    assert yaw_rad(bench) == pytest.approx(math.pi / 3, abs=0.03)
