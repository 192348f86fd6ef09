"""Missions: protocol and flight. A recorded session tests pauses, jumps and returns."""

from __future__ import annotations

import math

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from sim_bench import LOITER, NAN, RTL, Bench, aloft, degrees

from simulator.autopilot.firmware import Firmware
from simulator.firmware.ardupilot import ARDUPILOT
from simulator.firmware.px4 import PX4

WAYPOINT, LOITER_TIME, RETURN, TAKEOFF, SPEED = 16, 19, 20, 22, 178
LOITER_TURNS, TO_ALTITUDE, SPLINE, YAW, JUMP = 18, 31, 82, 115, 177
REGION, NO_REGION = 195, 197
RELATIVE_INT, COMMAND_FRAME = 6, 2
Row = tuple[int, tuple[float, float, float, float], float, float, float]  # north, east, height m


def place(command: int, north: float, east: float, up: float, *params: float) -> Row:
    filled = (*params, *(0.0, 0.0, 0.0, NAN)[len(params) :])
    return command, filled, north, east, up


def act(command: int, *params: float) -> Row:
    return command, (*params, *(0.0,) * (4 - len(params))), NAN, NAN, NAN


def item(bench: Bench, seq: int, row: Row, kind: int = 0) -> object:
    command, params, north, east, up = row
    x = y = 0
    if not math.isnan(north):
        x, y = (round(value * 1e7) for value in degrees(bench, north, east))
    frame, z = (COMMAND_FRAME, 0.0) if math.isnan(up) else (RELATIVE_INT, up)
    return mavlink.MAVLink_mission_item_int_message(
        1, 1, seq, frame, command, 0, 1, *params, x, y, z, kind
    )


def send(bench: Bench, message: object, wait_s: float = 0.02) -> None:
    bench.send(message)
    bench.run(wait_s)


def acks(bench: Bench) -> list[int]:
    return [m.type for _, m in bench.of("MISSION_ACK")]


def upload(bench: Bench, rows: list[Row], kind: int = 0) -> int:
    """The answer to a whole upload; each item is sent when it is requested."""
    send(bench, mavlink.MAVLink_mission_count_message(1, 1, len(rows), kind))
    for seq, row in enumerate(rows):
        assert asked(bench)[-1] == seq
        send(bench, item(bench, seq, row, kind))
    return acks(bench)[-1]


def asked(bench: Bench) -> list[int]:
    """Numbers of the items that the vehicle has requested, by either message, in order."""
    kinds = ("MISSION_REQUEST", "MISSION_REQUEST_INT")
    return [m.seq for _, m in bench.received if m.get_type() in kinds]


ROUND = [
    act(SPEED, 1, 2.0, -1, 0),
    place(WAYPOINT, 12, 0, 4, 0, 1.0),
    place(LOITER_TIME, 12, 6, 6, 3.0, 0, 0, -90.0),
    act(RETURN),
]


def test_a_mission_is_downloaded_as_uploaded_and_cleared() -> None:
    """A repeated last item is acknowledged again."""
    bench = Bench()
    assert upload(bench, ROUND) == 0
    send(bench, item(bench, len(ROUND) - 1, ROUND[-1]))
    assert acks(bench) == [0, 0]
    send(bench, mavlink.MAVLink_mission_request_list_message(1, 1))
    assert bench.of("MISSION_COUNT")[-1][1].count == len(ROUND)
    for seq, row in enumerate(ROUND):
        send(bench, mavlink.MAVLink_mission_request_int_message(1, 1, seq))
        given, kept = item(bench, seq, row), bench.of("MISSION_ITEM_INT")[-1][1]
        for name in ("seq", "frame", "command", "x", "y", "z", "param1", "param2"):
            assert getattr(kept, name) == pytest.approx(getattr(given, name), nan_ok=True)
    for emptying in (
        mavlink.MAVLink_mission_clear_all_message(1, 1),
        mavlink.MAVLink_mission_count_message(1, 1, 0),
    ):
        assert upload(bench, ROUND[2:]) == 0
        send(bench, emptying)
        assert acks(bench)[-1] == 0
        send(bench, mavlink.MAVLink_mission_request_list_message(1, 1))
        assert bench.of("MISSION_COUNT")[-1][1].count == 0


def test_arducopter_refuses_an_item_with_nan_an_unknown_command_or_a_wrong_latitude() -> None:
    bench = Bench(firmware=ARDUPILOT)
    assert upload(bench, [place(WAYPOINT, 12, 0, 4, NAN)]) == 6
    assert upload(bench, [act(SPEED, 1, 2, 0, NAN)]) == 9
    assert upload(bench, [act(31_000)]) == 3
    assert upload(bench, [place(WAYPOINT, 1.5e7, 0, 4)]) == 10  # 135 degrees further north
    assert upload(bench, [place(WAYPOINT, 12, 0, 4)]) == 0


def test_px4_refuses_an_int_frame_in_the_message_with_degrees() -> None:
    for frame, result in ((RELATIVE_INT, 2), (3, 0)):
        bench = Bench()
        send(bench, mavlink.MAVLink_mission_count_message(1, 1, 1))
        fields = (0, frame, WAYPOINT, 0, 1, 0, 0, 0, 0, *degrees(bench, 9, 0), 5)
        send(bench, mavlink.MAVLink_mission_item_message(1, 1, *fields))
        assert acks(bench) == [result]


@pytest.mark.parametrize(("firmware", "mode"), [(PX4, "AUTO.MISSION"), (ARDUPILOT, "AUTO")])
def test_pilot_may_switch_to_a_mission_that_does_not_exist(firmware: Firmware, mode: str) -> None:
    bench = Bench(firmware=firmware, boot_scale=0.1)
    bench.run(6.0)
    bench.command(176, 1, 4)  # GUIDED
    assert bench.command(400, 1) == [0]
    bench.instance.autopilot.commander.switch(mode)
    bench.run(1.0)
    assert bench.armed


def test_px4_holds_when_its_mission_is_cleared() -> None:
    bench = aloft(height_m=5.0)
    assert upload(bench, ROUND) == 0
    assert bench.command(300) == [0]
    bench.run(1.0)
    send(bench, mavlink.MAVLink_mission_clear_all_message(1, 1))
    bench.run(1.0)
    assert bench.mode == LOITER
    assert "No valid mission available, loitering" in bench.texts()


def test_missing_items_are_requested_again_until_a_timeout_or_cancelled() -> None:
    """A client that does not support MISSION_REQUEST is sent MISSION_REQUEST_INT."""
    bench = Bench()
    send(bench, mavlink.MAVLink_mission_count_message(1, 1, 2), 1.0)
    assert asked(bench) == [0] * len(asked(bench))
    assert 3 <= len(asked(bench)) <= 5
    bench.run(5.0)
    assert acks(bench) == [15]
    send(bench, item(bench, 0, ROUND[0]))
    assert acks(bench) == [15, 1]
    begun_s = bench.time_s
    send(bench, mavlink.MAVLink_mission_count_message(1, 1, 2))
    send(bench, mavlink.MAVLink_mission_ack_message(1, 1, 3))  # unsupported
    send(bench, mavlink.MAVLink_mission_ack_message(1, 1, 15), 1.0)  # cancelled
    for kind in ("MISSION_REQUEST", "MISSION_REQUEST_INT"):
        assert [m.seq for _, m in bench.of(kind, begun_s)] == [0]


@pytest.mark.parametrize("firmware", [PX4, ARDUPILOT], ids=["px4", "ardupilot"])
def test_fences_and_rally_points_are_kept_beside_the_mission(firmware: Firmware) -> None:
    """An inclusion fence and a rally point are stored as the mission is, and do not change it. Only
    PX4 returns an item of frame 6 in that frame, as MISSION_ITEM_INT; only ArduCopter refuses a
    waypoint in a rally point's place, and MAV_MISSION_TYPE 255 (all), and has no frame 2."""
    bench = Bench(firmware=firmware)
    assert upload(bench, ROUND) == 0
    kept = {1: [place(5001, n, e, 0, 3) for n, e in ((9, 9), (9, -9), (-9, 0))],
            2: [place(5100, 3, 4, 5)]}  # fmt: skip
    for kind, rows in kept.items():
        assert upload(bench, rows, kind) == 0
    for kind, rows in {0: ROUND, **kept}.items():
        send(bench, mavlink.MAVLink_mission_request_list_message(1, 1, kind))
        send(bench, mavlink.MAVLink_mission_request_int_message(1, 1, len(rows) - 1, kind))
        listed, last = bench.of("MISSION_COUNT")[-1][1], bench.of("MISSION_ITEM_INT")[-1][1]
        assert (listed.count, listed.mission_type) == (len(rows), kind)
        assert (last.command, last.mission_type) == (rows[-1][0], kind)
    send(bench, mavlink.MAVLink_mission_request_int_message(1, 1, 1))
    send(bench, mavlink.MAVLink_mission_request_message(1, 1, 1))
    send(bench, mavlink.MAVLink_mission_request_int_message(1, 1, 3))
    frames = [m.frame for _, m in bench.received if m.get_type().startswith("MISSION_ITEM")]
    assert frames[-3:] == ([6, 3, 2] if firmware is PX4 else [3, 3, 0])
    send(bench, mavlink.MAVLink_mission_clear_all_message(1, 1, 1))
    for kind, count in enumerate((len(ROUND), 0, 1)):
        send(bench, mavlink.MAVLink_mission_request_list_message(1, 1, kind))
        assert bench.of("MISSION_COUNT")[-1][1].count == count
    send(bench, mavlink.MAVLink_mission_count_message(1, 1, 1, 3))
    assert [(m.type, m.mission_type) for _, m in bench.of("MISSION_ACK")][-2:] == [(0, 1), (3, 3)]
    refused = 0 if firmware is PX4 else 3
    assert upload(bench, [place(WAYPOINT, 3, 4, 5)], 2) == refused
    send(bench, mavlink.MAVLink_mission_clear_all_message(1, 1, 255))
    assert acks(bench)[-1] == refused
    assert (bench.instance.autopilot.mission.items == ()) is (firmware is PX4)


@pytest.mark.parametrize(
    ("firmware", "radius", "wide"), [(PX4, "NAV_ACC_RAD", 8.0), (ARDUPILOT, "WPNAV_RADIUS", 800.0)]
)
def test_waypoint_radius_follows_the_parameter(
    firmware: Firmware, radius: str, wide: float
) -> None:
    """With 8 m instead of the default 2 m a waypoint 20 m away is reached after 12 m."""
    bench = aloft(firmware=firmware, height_m=5.0)
    bench.set(radius, wide)
    upload(bench, [place(WAYPOINT, 0, 0, 5, 0, 0), *[place(WAYPOINT, 20, 0, 5, 0, 0)] * 2])
    assert bench.command(300) == [0]
    bench.run_until(lambda: bench.instance.autopilot.mission.reached == 1, 20.0)
    assert bench.place[0] == pytest.approx(12.0, abs=0.5)


def test_the_first_item_of_arducopter_is_home() -> None:
    """Scripts that download an empty mission wait for home, which is zero until it is set.
    MIS_TOTAL counts it, too."""
    bench = Bench(firmware=ARDUPILOT, boot_scale=0.1)
    bench.run(1.0)
    send(bench, mavlink.MAVLink_mission_request_message(1, 1, 0))
    home = bench.of("MISSION_ITEM")[-1][1]
    assert (home.x, home.y, home.z) == (0, 0, 0)
    assert bench.command(179, 0, 0, 0, 0, *degrees(bench, 9, 0), 584) == [4]
    assert (bench.command(410), bench.command(512, 242)) == ([4], [0])
    assert not bench.of("HOME_POSITION")
    bench.run(1.5)
    for _ in range(2):
        send(bench, mavlink.MAVLink_mission_request_message(1, 1, 0))
        home = bench.of("MISSION_ITEM")[-1][1]
        assert (home.seq, home.frame, home.command) == (0, 0, WAYPOINT)
        assert (home.x, home.y, home.z) == pytest.approx(ARDUPILOT.origin, abs=1e-2)
        assert upload(bench, [place(WAYPOINT, 50, 50, 0), place(WAYPOINT, 9, 0, 5)]) == 0
    assert bench.instance.autopilot.parameters["MIS_TOTAL"] == 2
    send(bench, mavlink.MAVLink_mission_request_message(1, 1, 2))
    assert acks(bench)[-1] == 1


def test_px4_takes_the_yaw_of_a_mission_item() -> None:
    """A recorded session tests the item's time, and speed and return of other items."""
    bench = aloft(height_m=4.0)
    upload(bench, ROUND)
    assert bench.command(300) == [0]
    bench.run_until(lambda: bench.mode == RTL, 40.0)
    assert bench.heading_deg == pytest.approx(-90.0, abs=5.0)
    assert bench.place == pytest.approx((12, 6, -6), abs=1.0)


def current(bench: Bench) -> tuple[int, int, int]:
    """Number, state and mode of MISSION_CURRENT, on request."""
    bench.command(512, 42)
    _, message = bench.of("MISSION_CURRENT")[-1]
    return message.seq, message.mission_state, message.mission_mode


def test_arducopter_mission_ignores_item_yaw_and_returns_in_auto() -> None:
    """param4 is no heading for ArduCopter. The mode is AUTO, with an active mission, until the
    landing, and AUTO after it. Each item is announced when it begins."""
    bench = Bench(firmware=ARDUPILOT, boot_scale=0.1)
    bench.run(4.5)
    rows = [
        place(WAYPOINT, 0, 0, 0, 0, 0, 0, 0),
        place(TAKEOFF, 0, 0, 5, 0, 0, 0, 0),
        place(WAYPOINT, 0, 20, 5, 0, 0, 0, 0),
        act(RETURN, 0.0),
    ]
    assert upload(bench, rows) == 0
    bench.command(176, 1, 4)
    assert bench.command(400, 1) == [0]
    assert bench.command(300) == [0]
    bench.run_until(lambda: bool(bench.of("MISSION_ITEM_REACHED")), 15.0)
    assert bench.height_m == pytest.approx(5.0, abs=0.2)
    send(bench, mavlink.MAVLink_mission_clear_all_message(1, 1))
    assert acks(bench)[-1] == 1  # a mission that is flown is not cleared
    bench.run_until(lambda: bench.instance.autopilot.mission.finished, 30.0)
    assert bench.heading_deg == pytest.approx(90.0, abs=6.0)
    assert current(bench) == (3, 3, 1)
    bench.run_until(lambda: not bench.armed, 70.0)
    assert bench.mode == 3
    assert math.hypot(*bench.place[:2]) < 0.5
    begun = ["Mission: 1 Takeoff", "Mission: 2 WP", "Reached command #2", "Mission: 3 RTL"]
    assert [text for text in bench.texts() if "ission: " in text or "Reached" in text] == begun
    assert current(bench) == (0, 5, 1)  # complete, although disarming resets it


def test_arducopter_mission_restarted_in_the_air_stays_level() -> None:
    """Scripts reset a mission with MISSION_SET_CURRENT 0. For ArduCopter 4.6.3 SITL at 6 m item 1
    is then reached at once, and the vehicle flies level to item 2."""
    bench = aloft(firmware=ARDUPILOT, height_m=6.0, mode="GUIDED")
    home = place(WAYPOINT, 0, 0, 0, 0, 0, 0, 0)
    upload(bench, [home, place(TAKEOFF, 0, 0, 3), place(WAYPOINT, 12, 0, 6)])
    send(bench, mavlink.MAVLink_mission_set_current_message(1, 1, 0))
    assert bench.command(176, 1, 3) == [0]
    heights_m: list[float] = []
    bench.run(10.0, lambda: heights_m.append(bench.height_m))
    assert [m.seq for _, m in bench.of("MISSION_ITEM_REACHED")] == [1, 2]
    assert 5.7 < min(heights_m) < max(heights_m) < 6.3
    assert bench.place[0] == pytest.approx(12.0, abs=1.0)


@pytest.mark.parametrize("mode", ["GUIDED", "AUTO"])
def test_arducopter_pauses_and_continues(mode: str) -> None:
    """MAV_CMD_DO_PAUSE_CONTINUE stops the vehicle on the way to a place; a place that it receives
    meanwhile is flown to afterwards. Other modes refuse it."""
    bench = aloft(firmware=ARDUPILOT, height_m=5.0, mode="GUIDED")
    upload(bench, [place(TAKEOFF, 0, 0, 5)] * 2 + [place(WAYPOINT, 60, 0, 5)])
    bench.position(60.0, 0.0, -5.0, 3576)
    bench.instance.autopilot.commander.switch(mode)
    bench.position(60.0, 0.0, -5.0, 3576)
    bench.run(4.0)
    assert bench.command(193, 0) == [0]
    bench.run(5.0)
    bench.position(40.0, 0.0, -5.0, 3576)
    paused_m = bench.place[0]
    bench.run(4.0)
    assert bench.place[0] == pytest.approx(paused_m, abs=0.5)
    assert bench.command(193, 1) == [0]
    bench.run(9.0)
    assert bench.place[0] == pytest.approx(40.0 if mode == "GUIDED" else 60.0, abs=3.0)
    bench.instance.autopilot.commander.switch("LOITER")
    assert [bench.command(193, resumes) for resumes in (0, 1)] == [[4], [4]]
    assert bench.texts()[-2:] == ["Failed to pause", "Failed to resume"]


@pytest.mark.parametrize("firmware", [PX4, ARDUPILOT])
def test_a_jump_repeats_a_part_of_the_mission(firmware: Firmware) -> None:
    """A jump is not reported as reached. A jump to an item that does not exist is skipped.
    ArduCopter says which items begin, how often it has jumped, and how long it waits."""
    bench = aloft(firmware=firmware, height_m=5.0)
    points = [place(WAYPOINT, north, 0, 5, 0, 0, 0, 0) for north in (0, 0, 8)]
    jumps = [act(JUMP, 1, 2), act(JUMP, 99, -1)]
    upload(bench, [*points, *jumps, place(WAYPOINT, 0, 8, 5), act(93, 1, -1, -1, -1)])
    send(bench, mavlink.MAVLink_mission_set_current_message(1, 1, 1))
    bench.command(300)
    bench.run_until(lambda: bench.instance.autopilot.mission.finished, 60.0)
    assert [m.seq for _, m in bench.of("MISSION_ITEM_REACHED")] == [1, 2] * 3 + [5, 6]
    told = [text for text in bench.texts() if "Jump" in text or "Delay" in text]
    said = ["Mission: 3 Jump 1/2", "Mission: 3 Jump 2/2"]
    assert told == ([] if firmware is PX4 else [*said, "Mission: 6 Delay", "Delaying 1 sec"])


@pytest.mark.parametrize("firmware", [PX4, ARDUPILOT])
def test_a_loop_of_jumps_without_a_place_ends(firmware: Firmware) -> None:
    bench = aloft(firmware=firmware, height_m=5.0)
    upload(bench, [place(WAYPOINT, 0, 0, 5, 0, 0, 0, 0)] * 2 + [act(SPEED, 1, 2), act(JUMP, 2, -1)])
    bench.command(300)
    bench.run(5.0)
    assert bench.armed
    assert bench.place == pytest.approx((0, 0, -5), abs=0.5)


def test_arducopter_flies_a_spline_circles_and_climbs() -> None:
    """It circles at 20 deg/s with its nose to the centre, clockwise for a positive radius."""
    bench = aloft(firmware=ARDUPILOT, height_m=5.0)
    home = place(WAYPOINT, 0, 0, 0, 0, 0, 0, 0)
    circle = place(LOITER_TURNS, 10, 4, 5, 1, 0, 4, 0)
    upload(
        bench,
        [
            home,
            place(SPLINE, 10, -8, 5, 0, 0, 0, 0),
            circle,
            place(TO_ALTITUDE, 10, 0, 9, 0, 0, 0, 0),
        ],
    )
    bench.command(300)
    reached = bench.instance.autopilot.mission
    bench.run_until(lambda: reached.reached == 1, 20.0)
    assert bench.place == pytest.approx((10, -8, -5), abs=2.5)
    bench.run(8.0)
    assert math.dist(bench.place[:2], (10, 4)) == pytest.approx(4.0, abs=0.6)
    north, east = bench.place[0] - 10, bench.place[1] - 4
    to_centre = math.degrees(math.atan2(-east, -north))
    assert abs(math.remainder(bench.heading_deg - to_centre, 360.0)) < 15.0
    bench.run(2.0)
    turned = math.atan2(bench.place[1] - 4, bench.place[0] - 10) - math.atan2(east, north)
    assert math.remainder(turned, math.tau) == pytest.approx(math.radians(40.0), abs=0.15)
    bench.run_until(lambda: reached.finished, 40.0)
    assert bench.height_m == pytest.approx(9.0, abs=1.2)


def test_arducopter_keeps_the_yaw_of_a_condition_until_the_next_place() -> None:
    bench = aloft(firmware=ARDUPILOT, height_m=5.0)
    points = [place(WAYPOINT, north, 0, 5, 0, 0, 0, 0) for north in (0, 12, 24)]
    upload(bench, [points[0], act(YAW, 90, 0, 1, 0), *points[1:]])
    bench.command(300)
    bench.run_until(lambda: bench.instance.autopilot.mission.reached == 2, 20.0)
    assert bench.heading_deg == pytest.approx(90.0, abs=5.0)
    bench.run_until(lambda: bench.instance.autopilot.mission.reached == 3, 20.0)
    assert bench.heading_deg == pytest.approx(0.0, abs=8.0)


@pytest.mark.parametrize("firmware", [PX4, ARDUPILOT])
def test_a_mission_faces_a_region_of_interest_until_there_is_none(firmware: Firmware) -> None:
    bench = aloft(firmware=firmware, height_m=5.0)
    points = [place(WAYPOINT, north, 0, 5) for north in (0, 9, 18, 36)]
    region, none = place(REGION, 18, 9, 0, 0, 0, 0, 0), act(NO_REGION)
    upload(bench, [points[0], region, *points[1:3], none, points[3]])
    bench.command(300)
    bench.run_until(lambda: bench.instance.autopilot.mission.reached == 2, 20.0)
    assert bench.heading_deg == pytest.approx(45.0, abs=15.0)
    bench.run_until(lambda: bench.instance.autopilot.mission.finished, 30.0)
    assert bench.heading_deg == pytest.approx(0.0, abs=10.0)


def test_arducopter_replaces_a_part_of_its_mission() -> None:
    """MAVProxy's `wp changealt`, `wp move` and others do so. PX4 has no such message."""
    bench = aloft(firmware=ARDUPILOT, height_m=5.0)
    points = [place(WAYPOINT, north, 0, 5) for north in (0, 0, 20, 30)]
    upload(bench, points)
    send(bench, mavlink.MAVLink_mission_set_current_message(1, 1, 2))
    send(bench, mavlink.MAVLink_mission_write_partial_list_message(1, 1, 2, 2))
    assert asked(bench)[-1] == 2
    send(bench, item(bench, 2, place(WAYPOINT, 0, 9, 7)))
    assert acks(bench) == [0, 0]
    mission = bench.instance.autopilot.mission
    assert (mission.current, len(mission.items)) == (2, 4)
    assert [each.z for each in mission.items] == [5, 5, 7, 5]
    send(bench, mavlink.MAVLink_mission_write_partial_list_message(1, 1, 5, 5))
    assert acks(bench)[-1] == 1


@pytest.mark.parametrize(("firmware", "keeps_present"), [(PX4, False), (ARDUPILOT, True)])
def test_a_home_that_a_client_sets_is_kept_when_the_vehicle_arms(
    firmware: Firmware, *, keeps_present: bool
) -> None:
    """PX4 does not keep the present position as home, ArduCopter does."""
    bench = Bench(firmware=firmware, boot_scale=0.1)
    bench.run(4.5)
    guidance = bench.instance.autopilot.guidance
    height_m = firmware.origin[2] + 3.0
    for params in ((0, 0, 0, 0, *degrees(bench, 12.0, 0.0), height_m), (1,)):
        assert bench.command(179, *params) == [0]
        before = guidance.home_ned_m
        if firmware is ARDUPILOT:
            assert bench.command(176, 1, 4) == [0]
        assert bench.command(400, 1) == [0]
        assert (guidance.home_ned_m == before) is (params[0] == 0 or keeps_present)
        bench.command(400, 0)
        bench.run(1.0)
