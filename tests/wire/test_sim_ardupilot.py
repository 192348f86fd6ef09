"""The simulated ArduCopter: its default messages, setpoints and their limits; yaw, speed
and places in automatic flight of both autopilots.

ArduCopter 4.6.3 and PX4 1.16.1 SITL gave the expected values for the same requests."""

from __future__ import annotations

import math
from collections import Counter
from typing import Any

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from sim_bench import NAN, Bench, aloft, degrees

from simulator.autopilot.firmware import Firmware
from simulator.autopilot.values import MissionItem
from simulator.config import Scenario
from simulator.firmware.ardupilot import ARDUPILOT
from simulator.firmware.px4 import PX4

AUTO, GUIDED, LAND, BRAKE, THROW = 3, 4, 9, 17, 18
HOLD = 0x03040000  # of PX4
ACCEPTED, DENIED, UNSUPPORTED, FAILED = 0, 2, 3, 4
HOVER = 0.3655
LEVEL = (1.0, 0.0, 0.0, 0.0)


def booted(**more: Any) -> Bench:
    """A vehicle on the ground, ready to arm."""
    bench = Bench(firmware=ARDUPILOT, boot_scale=0.1, **more)
    bench.run(4.5)
    return bench


def guided(**options: float) -> Bench:
    """A vehicle in GUIDED at 8 m that takes thrust as thrust, not as a climb rate."""
    bench = aloft(firmware=ARDUPILOT, mode="GUIDED", conditions={"boot_scale": 0.1})
    for name, value in {"GUID_OPTIONS": 8, **options}.items():
        bench.set(name, value)
    return bench


def roll_deg(vehicle: Bench) -> float:
    w, x, y, z = vehicle.instance.autopilot.state.truth.attitude
    return math.degrees(math.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y)))


def test_arducopter_sends_heartbeat_timesync_and_home_unrequested() -> None:
    """Texts follow once a client has spoken, origin and home once the EKF has found them."""
    vehicle = Bench(firmware=ARDUPILOT, boot_scale=0.1, heartbeat_type=18)
    vehicle.run(20.0)
    counts = Counter(m.get_type() for _, m in vehicle.received)
    counts.pop("STATUSTEXT")
    assert counts == {
        "HEARTBEAT": 21,  # the first at once, where the real one waits a second
        "TIMESYNC": 3,
        "GPS_GLOBAL_ORIGIN": 1,
        "HOME_POSITION": 1,
    }
    vehicle.send(mavlink.MAVLink_autopilot_version_request_message(1, 1))  # of Mission Planner
    vehicle.run(0.02)
    assert len(vehicle.of("AUTOPILOT_VERSION")) == 1


def test_arducopter_streams_a_requested_group_also_after_an_interval_of_0() -> None:
    """Before the first GPS fix, at 10.2 s of the real one, the global position is 0, 0."""
    vehicle = Bench(firmware=ARDUPILOT)
    vehicle.send(mavlink.MAVLink_request_data_stream_message(1, 1, 6, 4, 1))
    for interval_us, rate_hz in ((0, 4), (-1, 0), (0, 4), (1e5, 10)):
        assert vehicle.command(511, 33, interval_us) == [0]
        since_s = vehicle.time_s
        vehicle.run(3.0)
        assert len(vehicle.of("GLOBAL_POSITION_INT", since_s)) == pytest.approx(3 * rate_hz, abs=1)
    vehicle.send(mavlink.MAVLink_request_data_stream_message(1, 1, 0, 4, 1))
    vehicle.run(5.0)
    for name in ("AHRS2", "MEMINFO", "POWER_STATUS", "SCALED_PRESSURE2", "WIND"):
        assert len(vehicle.of(name)) == pytest.approx(20, abs=1), name
    assert vehicle.of("AHRS2")[-1][1].altitude == pytest.approx(ARDUPILOT.origin[2], abs=0.5)
    places = [(m.lat, m.lon) for _, m in vehicle.of("GLOBAL_POSITION_INT")]
    assert places[0] == (0, 0)
    assert places[-1] == pytest.approx([value * 1e7 for value in ARDUPILOT.origin[:2]], abs=100)


def test_mode_change_sends_a_heartbeat_even_just_after_one() -> None:
    vehicle = guided()
    since_s = vehicle.time_s
    while not vehicle.of("HEARTBEAT", since_s):
        vehicle.run(0.004)
    vehicle.command(176, 1, LAND)
    assert [m.custom_mode for _, m in vehicle.of("HEARTBEAT", since_s)] == [GUIDED, LAND]


@pytest.mark.parametrize(("thrust", "lifts"), [(0.45, True), (0.05, False)])
def test_attitude_setpoints_alone_take_off(thrust: float, lifts: bool) -> None:
    """0.3 m is reached after 3.3 to 3.9 s. Any thrust counts as flight, even if it cannot lift."""
    vehicle = booted()
    vehicle.set("GUID_OPTIONS", 8)
    vehicle.command(176, 1, GUIDED)
    assert vehicle.command(400, 1) == [ACCEPTED]
    vehicle.run(3.2, lambda: vehicle.attitude(thrust=thrust))
    assert vehicle.height_m < 0.3
    vehicle.run(0.7, lambda: vehicle.attitude(thrust=thrust))
    assert (vehicle.height_m > 0.3) is lifts
    assert (vehicle.armed, vehicle.instance.view.landed_state) == (True, 2)


def test_heavy_vehicle_takes_off_after_an_interrupted_takeoff() -> None:
    """The vehicle hovers at a thrust of 0.85. Only full throttle limits ArduCopter's altitude
    controller."""
    heavy = {"name": "heavy", "conditions": {"thrust_scale": 0.43, "boot_scale": 0.1}}
    vehicle = booted(scenario=Scenario.model_validate(heavy))
    vehicle.command(176, 1, GUIDED)
    assert vehicle.command(400, 1) == [ACCEPTED]
    assert vehicle.command(22, 0, 0, 0, 0, 0, 0, 5.0) == [ACCEPTED]
    vehicle.run(2.8)
    vehicle.command(176, 1, BRAKE)  # while the throttle rises
    vehicle.run(2.0)
    vehicle.command(176, 1, GUIDED)
    assert vehicle.height_m == pytest.approx(0.0, abs=0.01)
    assert vehicle.command(22, 0, 0, 0, 0, 0, 0, 6.0) == [ACCEPTED]
    vehicle.run(12.0)
    assert vehicle.height_m == pytest.approx(6.0, abs=0.5)


def test_only_valid_attitude_setpoints_are_flown() -> None:
    """The sign of a quaternion does not matter; its length and the bits of the mask do."""
    vehicle, tilts_deg = guided(), np.array([6.0, 6.0])  # roll and pitch, small

    def tilted() -> bool:
        w, *axis, _ = vehicle.instance.autopilot.state.truth.attitude
        return bool((abs(np.degrees(2.0 * np.array(axis) / w) - tilts_deg) < 1.0).all())

    def tilt(length: float) -> tuple[float, ...]:
        x, y = np.radians(tilts_deg) / 2.0
        return tuple(length * np.array((math.sqrt(1.0 - x * x - y * y), x, y, 0.0)))

    for mask, length, flown in (
        (7, 1.0, True), (7, -1.0, True), (7, 1.0006, False), (7, 2.0, False), (7, NAN, False),
        (71, 1.0, False), (199, 1.0, False),
    ):  # fmt: skip
        vehicle.run(0.6, lambda m=mask, n=length: vehicle.attitude(tilt(n), HOVER, m))
        assert tilted() == flown
        vehicle.run(1.2, lambda: vehicle.attitude(LEVEL, HOVER))
        assert abs(roll_deg(vehicle)) < 1.0


def test_without_guid_options_thrust_is_a_climb_rate() -> None:
    vehicle = guided(GUID_OPTIONS=0)
    for thrust, climb in ((0.5, 0.0), (1.0, 2.5), (0.75, 1.25), (0.0, -1.5), (2.0, 2.5)):
        vehicle.run(3.0, lambda u=thrust: vehicle.attitude(LEVEL, u))
        assert vehicle.climb_mps == pytest.approx(climb, abs=0.1)


def test_repeated_mode_request_keeps_a_takeoff_and_disarming_ends_it() -> None:
    """Scripts request GUIDED until HEARTBEAT shows it; set_mode then returns at once."""
    vehicle = booted()

    def take_off(up_m: float) -> None:
        assert vehicle.command(176, 1, GUIDED) == [ACCEPTED]
        assert vehicle.command(400, 1) == [ACCEPTED]
        assert vehicle.command(22, 0, 0, 0, 0, 0, 0, 5.0) == [ACCEPTED]
        vehicle.run_until(lambda: vehicle.height_m > up_m, 10.0)

    take_off(2.0)
    assert vehicle.command(176, 1, GUIDED) == [ACCEPTED]
    assert vehicle.command(22, 0, 0, 0, 0, 0, 0, 9.0) == [FAILED]  # in the air
    vehicle.run(4.0)
    assert vehicle.height_m == pytest.approx(5.0, abs=0.2)
    vehicle.command(176, 1, LAND)
    vehicle.run_until(lambda: not vehicle.armed, 30.0)
    take_off(0.05)
    assert vehicle.command(400, 0, 21196) == [ACCEPTED]
    vehicle.run(2.0)
    assert vehicle.command(176, 1, GUIDED) == vehicle.command(400, 1) == [ACCEPTED]
    vehicle.run(6.0)
    assert vehicle.height_m == pytest.approx(0.0, abs=0.05)


def test_unusable_modes_are_refused_only_while_armed() -> None:
    """While disarmed the vehicle enters any mode."""
    vehicle = guided()
    mission = vehicle.instance.autopilot.mission
    for number, title in ((AUTO, "AUTO"), (THROW, "THROW")):
        assert vehicle.command(176, 1, number) == [FAILED]
        assert vehicle.texts()[-1] == f"Mode change to {title} failed: init failed"
        assert vehicle.mode == GUIDED
    assert vehicle.command(300) == [FAILED]
    mission.store(tuple(MissionItem(3, 16, (0.0,) * 4, 0, 0, up_m) for up_m in (0.0, 5.0)))
    assert vehicle.command(300) == [ACCEPTED]
    ground = booted()
    ground.instance.autopilot.mission.store(mission.items)
    for number in (THROW, AUTO, GUIDED):
        assert ground.command(176, 1, number) == [ACCEPTED]
    assert ground.command(400, 1) == [ACCEPTED]
    assert ground.command(176, 1, AUTO) == [FAILED]
    failed = "Mode change to AUTO failed: init failed"
    assert ground.texts()[-2:] == ["Auto: Missing Takeoff Cmd", failed]


def test_lost_ground_station_disarms_only_on_the_ground() -> None:
    vehicle = aloft(firmware=ARDUPILOT, height_m=30.0, mode="LOITER")
    vehicle.codec.srcSystem = 255
    vehicle.run(0.2)
    vehicle.set("FS_GCS_ENABLE", 1)
    vehicle.heartbeat_type = None
    vehicle.run(6.0)
    assert (vehicle.mode, vehicle.system_status) == (5, 4)
    assert "GCS Failsafe - Continuing Pilot Control" in vehicle.texts()
    ground = booted()
    ground.codec.srcSystem = 255
    ground.set("FS_GCS_ENABLE", 1)
    ground.run(1.0)
    assert ground.command(176, 1, GUIDED) == [ACCEPTED]
    ground.heartbeat_type = None
    assert ground.command(400, 1) == [ACCEPTED]
    ground.run(6.0)
    assert (ground.armed, ground.mode) == (False, GUIDED)
    assert ground.texts()[-2:] == ["Disarming motors", "GCS Failsafe - Disarming"]


def test_nan_thrust_counts_as_zero_and_prevents_arming() -> None:
    vehicle = guided()
    vehicle.run(0.5, lambda: vehicle.attitude(LEVEL, NAN))
    assert vehicle.climb_mps < -2.0
    assert vehicle.system_status == 5
    vehicle.command(400, 0, 21196)
    vehicle.run(3.0)
    vehicle.command(176, 1, GUIDED)
    assert vehicle.command(400, 1) == [FAILED]
    assert "Arm: Internal Errors 0x400" in vehicle.texts()


@pytest.mark.parametrize(
    ("action", "mode", "texts"),
    [
        (0, GUIDED, []),
        (1, LAND, ["EKF variance", "EKF Failsafe: changed to LAND Mode", "EKF Failsafe Cleared"]),
    ],
)
def test_arducopter_loses_its_position_8_s_after_gps_loss(
    action: int, mode: int, texts: list[str]
) -> None:
    vehicle = guided(FS_EKF_ACTION=action)
    vehicle.command(511, 193, 100_000)
    autopilot = vehicle.instance.autopilot
    autopilot.plant.gps_healthy = False
    vehicle.run(7.8)
    assert (vehicle.mode, vehicle.system_status) == (GUIDED, 4)
    vehicle.run(0.5)
    assert (vehicle.mode, vehicle.system_status) == (mode, 5 if texts else 4)
    assert vehicle.of("EKF_STATUS_REPORT")[-1][1].flags == 167
    autopilot.plant.gps_healthy = True
    vehicle.run(0.5)
    assert vehicle.of("EKF_STATUS_REPORT")[-1][1].flags == 831
    assert (vehicle.mode, vehicle.system_status) == (mode, 4)
    assert vehicle.texts() == texts


# -- yaw, speed and places in automatic flight ---------------------------------------------------

POSITION_ALONE, VELOCITY_ALONE = 0xDF8, 0xDC7
RELATIVE, ABSOLUTE = 6, 5  # MAV_FRAME


def flying(firmware: Firmware = ARDUPILOT) -> Bench:
    """A vehicle at 5 m in GUIDED or AUTO.LOITER."""
    mode = "GUIDED" if firmware is ARDUPILOT else None
    bench = aloft(firmware=firmware, height_m=5.0, mode=mode)
    bench.run(1.0)
    return bench


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


def test_turn_has_the_requested_rate_and_direction() -> None:
    """A turn to a heading has them, too, and so may go the longer way round."""
    bench = flying()
    for params, wanted_deg, took_s in (
        ((90, 25, 1), 90.0, 4.0),
        ((45, 10, -1, 1), 45.0, 4.5),
        ((60, 50, -1), 60.0, 7.1),
    ):
        begun_s = bench.time_s
        assert bench.command(115, *params) == [ACCEPTED]
        done_s = bench.run_until(lambda to=wanted_deg: off_deg(bench, to) < 3.0, 12.0)
        assert done_s - begun_s == pytest.approx(took_s, abs=0.6)
        bench.run(2.0)


def test_arducopter_faces_a_region_of_interest_until_its_next_goal() -> None:
    bench = flying()
    bench.send(mavlink.MAVLink_request_data_stream_message(1, 1, 0, 4, 1))
    (north, _), (_, east) = degrees(bench, 40.0, 0.0), degrees(bench, 0.0, 10.0)
    home = degrees(bench, 0.0, 0.0)
    assert bench.command(201, 0, 0, 0, 0, home[0], east) == [ACCEPTED]
    bench.run(4.0)
    assert off_deg(bench, 90.0) < 3.0
    assert reposition(bench, 40.0, 0.0, 5.0, RELATIVE) == ACCEPTED
    assert bench.command(183, 9, 1700) == [ACCEPTED]
    assert bench.command(179, 1) == [ACCEPTED]
    bench.run(2.0)

    def newest(kind: str) -> Any:
        return bench.of(kind)[-1][1]

    away_m = 40.0 - bench.place[0]
    assert newest("NAV_CONTROLLER_OUTPUT").wp_dist == pytest.approx(away_m, abs=1.5)
    assert newest("NAV_CONTROLLER_OUTPUT").target_bearing in (359, 0, 1)
    goal, home = newest("POSITION_TARGET_GLOBAL_INT"), newest("HOME_POSITION")
    assert (goal.lat_int * 1e-7, goal.type_mask) == (pytest.approx(north, abs=1e-6), 0xFDF8)
    assert goal.alt == pytest.approx(ARDUPILOT.origin[2] + 5.0, abs=0.1)
    assert (home.x, home.z) == pytest.approx((0.0, -5.0), abs=0.3)
    outputs = newest("SERVO_OUTPUT_RAW")
    assert (outputs.servo1_raw, outputs.servo9_raw) == (pytest.approx(1580, abs=60), 1700)
    assert newest("VFR_HUD").airspeed == pytest.approx(math.hypot(*bench.velocity), abs=0.5)
    assert newest("RAW_IMU").zacc == pytest.approx(-980, abs=60)
    bench.run(2.0)
    assert off_deg(bench, 0.0) < 8.0
    assert bench.command(197) == [ACCEPTED]
    assert reposition(bench, 40.0, 0.0, 5.0, RELATIVE) == ACCEPTED
    bench.run(4.0)
    assert off_deg(bench, 0.0) < 20.0  # it turns to the place again


def test_requested_speed_holds_until_another_kind_of_setpoint() -> None:
    """4 m/s were requested on the way, and the real one flew 4.1."""
    bench = flying()

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


def test_arducopter_integrates_an_acceleration_to_a_velocity() -> None:
    """The real one had flown 2.0 m after 3 s of setpoints; without them it flies on for 3 s."""
    bench = flying()
    fields = (0, 1, 1, 1, 0xC3F, *(0.0,) * 6, 0.5, *(0.0,) * 4)
    setpoint = mavlink.MAVLink_set_position_target_local_ned_message(*fields)
    bench.run(3.0, lambda: bench.send(setpoint), 0.1)
    assert bench.place == pytest.approx((2.0, 0.0, -5.0), abs=0.4)
    bench.run(2.8)
    assert bench.velocity == pytest.approx((2.9, 0.0, 0.0), abs=0.3)
    assert bench.place == pytest.approx((8.4, 0.0, -5.0), abs=0.9)
    bench.run(4.0)
    assert bench.velocity == pytest.approx((0.0, 0.0, 0.0), abs=0.3)


@pytest.mark.parametrize(
    ("speed_mps", "ends", "stops_m"),
    [(3.0, "stream", 2.9), (8.0, "stream", 15.5), (3.0, "zero", 3.0), (8.0, "zero", 16.5),
     (3.0, "BRAKE", 3.5), (8.0, "BRAKE", 15.5)],
)  # fmt: skip
def test_arducopter_stops_as_far_as_the_real_one(
    speed_mps: float, ends: str, stops_m: float
) -> None:
    """When velocity setpoints end, GUID_TIMEOUT after the last one; when they demand zero; and in
    BRAKE."""
    bench = flying()

    def go(north_mps: float) -> None:
        fields = (0, 1, 1, 1, VELOCITY_ALONE, 0, 0, 0, north_mps, *(0.0,) * 7)
        bench.send(mavlink.MAVLink_set_position_target_local_ned_message(*fields))

    bench.run(6.0, lambda: go(speed_mps), 0.1)
    if ends == "stream":
        bench.run(2.9)
    elif ends == "BRAKE":
        bench.command(176, 1, BRAKE)
    begun_m = bench.place[0]
    bench.run(7.0, lambda: go(0.0) if ends == "zero" else None, 0.1)
    assert bench.place[0] - begun_m == pytest.approx(stops_m, rel=0.15)


def test_arducopter_reposition_moves_as_on_the_real_one() -> None:
    """Expected are metres from the start after each second. Only COMMAND_INT is accepted."""
    bench = flying()
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
        (PX4, 2**31 - 1, RELATIVE, ACCEPTED),  # above mean sea level, whatever the frame
        (ARDUPILOT, 2**31 - 1, RELATIVE, DENIED),
        (ARDUPILOT, 950_000_000, RELATIVE, DENIED),
    ],
)
def test_reposition_without_a_valid_place_does_not_move(
    firmware: Firmware, x: int, frame: int, result: int
) -> None:
    bench = flying(firmware)
    up_m = 5.0 + (bench.instance.autopilot.firmware.origin[2] if firmware is PX4 else 0.0)
    assert command_int(bench, frame, 192, -1.0, 1, 0, NAN, x, x, up_m) == result
    bench.run(3.0)
    assert bench.place == pytest.approx((0.0, 0.0, -5.0), abs=0.5)


@pytest.mark.parametrize("item", [False, True], ids=["command", "item"])
@pytest.mark.parametrize(("firmware", "obeys"), [(PX4, True), (ARDUPILOT, False)])
def test_only_px4_applies_a_climb_speed_to_horizontal_flight(
    firmware: Firmware, obeys: bool, item: bool
) -> None:
    bench = flying(firmware)
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
        ("LOITER", 192, RELATIVE, (-1.0, 0.0, 0.0, NAN), DENIED),
        ("GUIDED", 510, RELATIVE, (60_000.0, 0.0, 0.0, 0.0), 4),
        ("GUIDED", 178, RELATIVE, (1.0, 3.0, 0.0, 0.0), ACCEPTED),
        ("LOITER", 178, RELATIVE, (1.0, 3.0, 0.0, 0.0), FAILED),
        ("GUIDED", 209, RELATIVE, (1.0, 0.0, 5.0, 1.0), FAILED),  # motor test in the air
        ("GUIDED", 241, RELATIVE, (1.0, 0.0, 0.0, 0.0), FAILED),  # calibration while armed
        ("GUIDED", 42424, RELATIVE, (0.0, 0.0, 1.0, 0.0), FAILED),
        ("GUIDED", 1000, RELATIVE, (0.0, 0.0, 0.0, 0.0), FAILED),  # no gimbal
    ],
)
def test_arducopter_answers_unusual_commands_as_the_real_one(
    mode: str, number: int, frame: int, params: tuple[float, ...], result: int
) -> None:
    bench = aloft(firmware=ARDUPILOT, height_m=5.0, mode=mode)
    x, y = (round(value * 1e7) for value in degrees(bench, 5.0, 0.0))
    assert command_int(bench, frame, number, *params, x, y, 5.0) == result


@pytest.mark.parametrize("kind", ["", "_int"])
def test_arducopter_flies_to_a_guided_mission_item_at_once(kind: str) -> None:
    """DroneKit's simple_goto sends such an item."""
    bench = flying()
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


@pytest.mark.parametrize("radius_m", [10.0, -10.0])
def test_px4_flies_an_orbit_with_its_nose_to_the_centre(radius_m: float) -> None:
    """The real one was 9.6 to 10.5 m from the centre and flew 1.5 to 1.7 m/s when 2 were asked."""
    bench = aloft(height_m=3.0)
    amsl_m = bench.instance.autopilot.firmware.origin[2] + 3.0
    x, y = (round(value * 1e7) for value in degrees(bench, 0.0, 0.0))
    assert command_int(bench, ABSOLUTE, 34, radius_m, 2.0, 0.0, NAN, x, y, amsl_m) == ACCEPTED
    bench.run(20.0)
    assert bench.of("HEARTBEAT")[-1][1].custom_mode == 0x01030000
    (north, east, down), (v_north, v_east, _) = bench.place, bench.velocity
    assert math.hypot(north, east) == pytest.approx(10.0, abs=0.7)
    assert down == pytest.approx(-3.0, abs=0.4)
    turned = (north * v_east - east * v_north) / math.hypot(north, east)
    assert turned == pytest.approx(math.copysign(1.6, radius_m), abs=0.25)
    assert off_deg(bench, math.degrees(math.atan2(-east, -north))) < 12.0
    assert bench.command(186, amsl_m + 4.0) == [ACCEPTED]  # ends the orbit
    bench.run(8.0)
    assert bench.mode == HOLD
    assert bench.height_m == pytest.approx(7.0, abs=0.5)


@pytest.mark.parametrize(
    ("firmware", "beats", "later", "said"),
    [
        # base_mode, custom_mode, system_status after the fall, answer to arming
        (PX4, (1, 0xA0000, 8), 1, ["Failsafe activated"]),
        (ARDUPILOT, (89, 4, 3), 0, ["Disarming motors"]),
    ],
    ids=["px4", "ardupilot"],
)
def test_flight_termination_prevents_rearming_only_on_px4(
    firmware: Firmware, beats: tuple[int, ...], later: int, said: list[str]
) -> None:
    """MAV_CMD_DO_FLIGHTTERMINATION. PX4 stays in its mode until it is started again."""
    bench = flying(firmware)
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
