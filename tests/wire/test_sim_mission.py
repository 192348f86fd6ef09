"""Missions: protocol and flight."""

from __future__ import annotations

import math
from typing import Any

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from sim_bench import LOITER, NAN, RTL, Bench

from simulator.firmware.ardupilot import ARDUPILOT
from simulator.firmware.base import Firmware
from simulator.firmware.px4 import PX4

MISSION = 0x04040000
WAYPOINT, LOITER_UNLIMITED, LOITER_TIME, RETURN, LAND, TAKEOFF, SPEED = 16, 17, 19, 20, 21, 22, 178
RELATIVE_INT, COMMAND_FRAME = 6, 2
Row = tuple[int, tuple[float, float, float, float], float, float, float]  # north, east, height m


def place(command: int, north: float, east: float, up: float, *params: float) -> Row:
    filled = (*params, *(NAN,) * (4 - len(params)))
    return command, filled, north, east, up


def act(command: int, *params: float) -> Row:
    return command, (*params, *(0.0,) * (4 - len(params))), NAN, NAN, NAN


def item(seq: int, row: Row, origin: tuple[float, float, float] = PX4.origin) -> object:
    command, params, north, east, up = row
    x = y = 0
    if not math.isnan(north):
        x = round((origin[0] + math.degrees(north / 6_371_000)) * 1e7)
        shrink = math.cos(math.radians(origin[0]))
        y = round((origin[1] + math.degrees(east / 6_371_000 / shrink)) * 1e7)
    frame, z = (COMMAND_FRAME, 0.0) if math.isnan(up) else (RELATIVE_INT, up)
    return mavlink.MAVLink_mission_item_int_message(
        1, 1, seq, frame, command, 0, 1, *params, x, y, z
    )


def upload(bench: Bench, rows: list[Row]) -> int:
    """The answer to a whole upload, item by item as it is asked for."""
    bench.send(mavlink.MAVLink_mission_count_message(1, 1, len(rows)))
    for seq, row in enumerate(rows):
        bench.run(0.02)
        assert asked(bench)[-1] == seq
        bench.send(item(seq, row, bench.instance.autopilot.firmware.origin))
    bench.run(0.05)
    return int(bench.of("MISSION_ACK")[-1][1].type)


def asked(bench: Bench) -> list[int]:
    """Items asked for: the first in the old kind, then as they come."""
    kinds = ("MISSION_REQUEST", "MISSION_REQUEST_INT")
    return [m.seq for _, m in bench.received if m.get_type() in kinds]


def reached(bench: Bench) -> list[int]:
    return [m.seq for _, m in bench.of("MISSION_ITEM_REACHED")]


ROUND = [
    place(TAKEOFF, 0, 0, 4),
    act(SPEED, 1, 2.0, -1, 0),
    place(WAYPOINT, 12, 0, 4, 0, 1.0),
    place(LOITER_TIME, 12, 6, 6, 3.0),
    act(RETURN),
]


def test_a_mission_is_downloaded_as_uploaded_and_cleared() -> None:
    bench = Bench()
    bench.boot()
    assert upload(bench, ROUND) == 0
    bench.send(mavlink.MAVLink_mission_request_list_message(1, 1))
    bench.run(0.02)
    assert bench.of("MISSION_COUNT")[-1][1].count == len(ROUND)
    for seq, row in enumerate(ROUND):
        bench.send(mavlink.MAVLink_mission_request_int_message(1, 1, seq))
        bench.run(0.02)
        sent, kept = item(seq, row), bench.of("MISSION_ITEM_INT")[-1][1]
        for name in ("seq", "frame", "command", "x", "y", "z", "param1", "param2"):
            assert getattr(kept, name) == pytest.approx(getattr(sent, name), nan_ok=True)
    bench.send(mavlink.MAVLink_mission_clear_all_message(1, 1))
    bench.send(mavlink.MAVLink_mission_request_list_message(1, 1))
    bench.run(0.02)
    assert bench.of("MISSION_COUNT")[-1][1].count == 0


def test_a_client_may_ask_for_the_int_messages_and_may_cancel() -> None:
    bench = Bench()
    bench.send(mavlink.MAVLink_mission_count_message(1, 1, 2))
    bench.send(mavlink.MAVLink_mission_ack_message(1, 1, 3))  # unsupported
    bench.run(0.02)
    assert [m.seq for _, m in bench.of("MISSION_REQUEST")] == [0]
    assert [m.seq for _, m in bench.of("MISSION_REQUEST_INT")] == [0]
    bench.send(mavlink.MAVLink_mission_ack_message(1, 1, 15))  # cancelled
    bench.run(1.0)
    assert asked(bench) == [0, 0]


def test_missing_items_are_requested_again_until_a_timeout() -> None:
    bench = Bench()
    bench.send(mavlink.MAVLink_mission_count_message(1, 1, 2))
    bench.run(1.0)
    assert asked(bench) == [0] * len(asked(bench))
    assert 3 <= len(asked(bench)) <= 5
    bench.run(5.0)
    assert [m.type for _, m in bench.of("MISSION_ACK")] == [15]
    bench.send(item(0, ROUND[0]))
    bench.run(0.1)
    assert [m.type for _, m in bench.of("MISSION_ACK")] == [15, 1]


def test_a_repeated_last_item_is_acknowledged_again() -> None:
    bench = Bench()
    assert upload(bench, ROUND[:1]) == 0
    bench.send(item(0, ROUND[0]))
    bench.run(0.02)
    assert [m.type for _, m in bench.of("MISSION_ACK")] == [0, 0]


@pytest.mark.parametrize("firmware", [PX4, ARDUPILOT], ids=["px4", "ardupilot"])
@pytest.mark.parametrize("kind", [1, 2], ids=["fence", "rally points"])
def test_fences_and_rally_points_are_refused_and_there_are_none(
    firmware: Firmware, kind: int
) -> None:
    bench = Bench(firmware=firmware)
    bench.boot()
    bench.send(mavlink.MAVLink_mission_count_message(1, 1, 1, kind))
    bench.send(mavlink.MAVLink_mission_request_list_message(1, 1, kind))
    bench.run(0.1)
    assert [(m.type, m.mission_type) for _, m in bench.of("MISSION_ACK")] == [(3, kind)]
    assert [(m.count, m.mission_type) for _, m in bench.of("MISSION_COUNT")] == [(0, kind)]


def test_the_first_item_of_arducopter_is_home() -> None:
    """Scripts that download an empty mission wait for it."""
    bench = Bench(firmware=ARDUPILOT)
    bench.boot()
    for _ in range(2):
        bench.send(mavlink.MAVLink_mission_request_message(1, 1, 0))
        bench.run(0.02)
        home = bench.of("MISSION_ITEM")[-1][1]
        assert (home.seq, home.frame, home.command) == (0, 0, WAYPOINT)
        assert (home.x, home.y, home.z) == pytest.approx(ARDUPILOT.origin, abs=1e-2)
        assert upload(bench, [place(WAYPOINT, 50, 50, 0), place(WAYPOINT, 9, 0, 5)]) == 0
    bench.send(mavlink.MAVLink_mission_request_message(1, 1, 2))
    bench.run(0.02)
    assert bench.of("MISSION_ACK")[-1][1].type == 13


def _is_near(position: Any, place_ned_m: tuple[float, float, float]) -> bool:
    """Within NAV_ACC_RAD and NAV_MC_ALT_RAD."""
    north, east, down = place_ned_m
    across_m = math.hypot(position.x - north, position.y - east)
    return across_m < 2.0 and abs(position.z - down) < 0.8


def test_a_mission_is_flown_and_returns_and_is_flown_again() -> None:
    bench = Bench()
    bench.boot()
    upload(bench, ROUND)
    for _ in range(2):
        begun_s = bench.time_s
        assert bench.command(300) == [0]
        assert (bench.armed, bench.mode) == (True, MISSION)
        bench.run_until(lambda: bench.instance.autopilot.mission.current == 2, 20.0)
        assert bench.height_m == pytest.approx(4.0, abs=1.0)
        leg_s = bench.time_s
        bench.run_until(lambda: bench.instance.autopilot.mission.current == 4, 30.0)
        speeds = [math.hypot(m.vx, m.vy) for _, m in bench.of("LOCAL_POSITION_NED", leg_s)]
        assert max(speeds) == pytest.approx(1.9, abs=0.3)
        at_s, here = bench.of("LOCAL_POSITION_NED")[-1]
        assert (here.x, here.y, here.z) == pytest.approx((12, 6, -6), abs=1.0)
        near = [t for t, m in bench.of("LOCAL_POSITION_NED", leg_s) if _is_near(m, (12, 6, -6))]
        assert at_s - near[0] == pytest.approx(3.0, abs=0.1)
        told_s = [t for t, m in bench.of("MISSION_ITEM_REACHED") if m.seq == 3][-1]
        assert told_s == pytest.approx(at_s, abs=0.05)  # when its time is over
        bench.run(0.1)
        assert bench.mode == RTL
        bench.run_until(lambda: not bench.armed, 60.0)
        _, here = bench.of("LOCAL_POSITION_NED")[-1]
        assert (here.x, here.y) == pytest.approx((0, 0), abs=0.7)
        bench.run(0.5)
        texts = bench.texts(begun_s)
        assert texts[:1] == ["Armed by mission start"]
        assert texts[-1] == "Disarmed by landing"
    assert reached(bench) == [1, 2, 3] * 2


def test_a_mission_is_paused_by_hold_and_continues() -> None:
    bench = Bench()
    bench.boot()
    upload(bench, [place(WAYPOINT, 0, 0, 3), place(LOITER_UNLIMITED, 40, 0, 3)])
    bench.command(300)
    bench.run_until(lambda: bench.instance.autopilot.mission.current == 1, 20.0)
    bench.run(4.0)  # to 8 m, as PX4 gathers speed
    bench.ask_mode(LOITER)
    bench.run(14.0)  # it gathers speed, and so comes back to the place where it was to stop
    _, here = bench.of("LOCAL_POSITION_NED")[-1]
    assert 5.0 < here.x < 25.0
    assert abs(here.vx) < 0.1
    bench.ask_mode(MISSION)
    bench.run(20.0)
    _, here = bench.of("LOCAL_POSITION_NED")[-1]
    assert here.x == pytest.approx(40, abs=0.5)
    assert reached(bench) == [0]  # and there it stays


def test_arducopter_faces_its_direction_of_flight_and_returns_within_its_mission() -> None:
    """The fourth parameter is no heading there; the mode is AUTO until it has landed, and after."""
    bench = Bench(firmware=ARDUPILOT, boot_scale=0.1)
    bench.run(4.5)
    rows = [
        place(WAYPOINT, 0, 0, 0, 0, 0, 0, 0),
        place(TAKEOFF, 0, 0, 5, 0, 0, 0, 0),
        place(WAYPOINT, 0, 20, 5, 0, 0, 0, 0),
        (RETURN, (0.0,) * 4, NAN, NAN, NAN),
    ]
    assert upload(bench, rows) == 0
    bench.command(176, 1, 4)
    assert bench.command(400, 1) == [0]
    assert bench.command(300) == [0]
    bench.run_until(lambda: bench.instance.autopilot.mission.finished, 30.0)
    heading_deg = math.degrees(bench.instance.autopilot.state.estimate.yaw_rad)
    assert heading_deg == pytest.approx(90.0, abs=6.0)
    bench.run_until(lambda: not bench.armed, 70.0)
    assert bench.mode == 3
    x, y, _ = bench.instance.autopilot.state.truth.position_ned_m.tolist()
    assert math.hypot(x, y) < 0.5


def test_px4_takes_the_yaw_of_an_item() -> None:
    bench = Bench()
    bench.boot()
    upload(bench, [place(WAYPOINT, 0, 0, 3), place(LOITER_TIME, 0, 12, 3, 5.0, 0, 0, -90.0)])
    bench.command(300)
    bench.run_until(lambda: bench.instance.autopilot.mission.reached == 1, 30.0)
    bench.run(2.0)
    heading_deg = math.degrees(bench.instance.autopilot.state.estimate.yaw_rad)
    assert heading_deg == pytest.approx(-90.0, abs=5.0)
