"""Sticks by RC_CHANNELS_OVERRIDE and MANUAL_CONTROL, as ArduCopter 4.6.3 SITL flew them."""

from __future__ import annotations

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from sim_bench import Bench
from sim_courses import copter, place, velocity

LOITER = 5
KEEP = 65535
FEIGNED = (1500, 1500, 1000, 1500, 1800, 1000, 1000, 1800)
MIDDLE = (1500, 1500, 1500, 1500)


def push(bench: Bench, *widths: int, system: int = 255) -> None:
    bench.codec.srcSystem = system
    filled = (*widths, *(KEEP,) * (8 - len(widths)))
    bench.send(mavlink.MAVLink_rc_channels_override_message(1, 1, *filled))


def pushed(bench: Bench, duration_s: float, *widths: int) -> None:
    bench.run(duration_s, lambda: push(bench, *widths), 0.2)


def loitering() -> Bench:
    bench = copter()
    push(bench, *MIDDLE)
    bench.command(176, 1, LOITER)
    return bench


def seen(bench: Bench) -> tuple[int, ...]:
    bench.command(512, 65)
    _, channels = bench.of("RC_CHANNELS")[-1]
    return tuple(getattr(channels, f"chan{i}_raw") for i in range(1, 9))


def test_centred_throttle_holds_the_height_and_no_throttle_descends() -> None:
    bench = loitering()
    pushed(bench, 4.0, *MIDDLE)
    assert place(bench) == pytest.approx((0.0, 0.0, -5.0), abs=0.2)
    assert seen(bench) == (*MIDDLE, *FEIGNED[4:])
    bench.run(4.5)  # an override lasts three seconds
    assert seen(bench) == FEIGNED
    assert velocity(bench)[2] == pytest.approx(2.4, abs=0.3)


@pytest.mark.parametrize(("width", "climb_mps"), [(1700, 0.63), (1300, -0.68), (1580, 0.0)])
def test_the_throttle_is_a_climb_rate(width: int, climb_mps: float) -> None:
    bench = loitering()
    pushed(bench, 3.0, 1500, 1500, width, 1500)
    assert -velocity(bench)[2] == pytest.approx(climb_mps, abs=0.08)
    height_m = bench.height_m
    pushed(bench, 4.0, *MIDDLE)
    assert bench.height_m == pytest.approx(height_m + 0.35 * climb_mps, abs=0.35)


def test_a_stick_accelerates_and_the_vehicle_stops_when_it_is_centred() -> None:
    """Pitch 1400: 0.43, 0.85, 1.15 and 1.36 m/s ahead second by second; released after five it
    went on at 1.1 m/s for a second and stood after two."""
    bench = loitering()
    speeds = []
    for _ in range(4):
        pushed(bench, 1.0, 1500, 1400, 1500, 1500)
        speeds.append(velocity(bench)[0])
    assert speeds == pytest.approx([0.43, 0.85, 1.15, 1.36], abs=0.2)
    pushed(bench, 1.0, 1500, 1400, 1500, 1500)
    pushed(bench, 1.0, *MIDDLE)
    assert velocity(bench)[0] == pytest.approx(1.14, abs=0.25)
    pushed(bench, 2.0, *MIDDLE)
    assert velocity(bench)[0] == pytest.approx(0.0, abs=0.2)
    assert abs(velocity(bench)[1]) < 0.1


def test_roll_flies_sideways_also_by_manual_control() -> None:
    bench = loitering()
    pushed(bench, 3.0, 1700, 1500, 1500, 1500)
    assert velocity(bench)[1] == pytest.approx(2.65, abs=0.4)
    bench.codec.srcSystem = 255
    joystick = mavlink.MAVLink_manual_control_message(1, 0, 0, 700, 0, 0)
    bench.run(3.0, lambda: bench.send(joystick), 0.2)
    assert seen(bench)[:4] == (1500, 1500, 1700, 1500)
    assert -velocity(bench)[2] == pytest.approx(0.63, abs=0.1)


def test_only_the_ground_station_may_send_sticks_and_zero_releases_them() -> None:
    bench = loitering()
    push(bench, 1700, 1700, 1700, 1700, system=42)
    assert seen(bench) == (*MIDDLE, *FEIGNED[4:])
    push(bench, 0, KEEP, 0, KEEP)
    assert seen(bench) == (*FEIGNED[:1], 1500, 1000, *FEIGNED[3:])
