"""The simulated ArduCopter: its default messages, setpoints and their limits, sticks, turns.

Expected values are those of ArduCopter 4.6.3 SITL.
"""

from __future__ import annotations

import math
from collections import Counter

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from sim_bench import NAN, Bench, aloft

from simulator.firmware.ardupilot import ARDUPILOT
from simulator.firmware.values import MissionItem

AUTO, GUIDED, LAND, THROW = 3, 4, 9, 18
ACCEPTED, FAILED = 0, 4
HOVER = 0.3655
LEVEL = (1.0, 0.0, 0.0, 0.0)


def guided(**options: float) -> Bench:
    """In GUIDED 8 m up, thrust is thrust."""
    bench = aloft(firmware=ARDUPILOT, mode="GUIDED", conditions={"boot_scale": 0.1})
    for name, value in {"GUID_OPTIONS": 8, **options}.items():
        bench.set(name, value)
    return bench


def roll(degrees: float, length: float = 1.0) -> tuple[float, float, float, float]:
    half = math.radians(degrees) / 2.0
    return length * math.cos(half), length * math.sin(half), 0.0, 0.0


def roll_deg(vehicle: Bench) -> float:
    w, x, y, z = vehicle.instance.autopilot.state.truth.attitude
    return math.degrees(math.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y)))


def climb_mps(vehicle: Bench) -> float:
    return -vehicle.velocity[2]


def test_without_requests_it_sends_heartbeat_timesync_and_home() -> None:
    """And texts, once somebody spoke; origin and home when the filter has found them."""
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


@pytest.mark.parametrize(("thrust", "lifts"), [(0.45, True), (0.05, False)])
def test_takeoff_by_setpoints_alone(thrust: float, lifts: bool) -> None:
    """.3 m after 3.3-3.9 s; any thrust is flight, even if it cannot lift."""
    vehicle = Bench(firmware=ARDUPILOT, boot_scale=0.1)
    vehicle.run(4.5)
    vehicle.set("GUID_OPTIONS", 8)
    vehicle.command(176, 1, GUIDED)
    assert vehicle.command(400, 1) == [ACCEPTED]
    vehicle.run(3.2, lambda: vehicle.attitude(thrust=thrust))
    assert vehicle.height_m < 0.3
    vehicle.run(0.7, lambda: vehicle.attitude(thrust=thrust))
    assert (vehicle.height_m > 0.3) is lifts
    assert (vehicle.armed, vehicle.instance.view.landed_state) == (True, 2)


def test_which_attitude_setpoints_are_flown() -> None:
    """A quaternion's sign is of no account; its length is, and so are bits of the mask."""
    vehicle = guided()
    for mask, length, rolls in (
        (7, 1.0, True), (7, -1.0, True), (7, 1.0006, False), (7, 2.0, False), (7, NAN, False),
        (71, 1.0, False), (199, 1.0, False),
    ):  # fmt: skip
        vehicle.run(0.6, lambda m=mask, n=length: vehicle.attitude(roll(8.0, n), HOVER, m))
        assert (abs(roll_deg(vehicle) - 8.0) < 1.0) == rolls
        vehicle.run(1.2, lambda: vehicle.attitude(LEVEL, HOVER))
        assert abs(roll_deg(vehicle)) < 1.0


def test_without_guid_options_thrust_is_a_climb_rate() -> None:
    vehicle = guided(GUID_OPTIONS=0)
    for thrust, climb in ((0.5, 0.0), (1.0, 2.5), (0.75, 1.25), (0.0, -1.5), (2.0, 2.5)):
        vehicle.run(3.0, lambda u=thrust: vehicle.attitude(LEVEL, u))
        assert climb_mps(vehicle) == pytest.approx(climb, abs=0.1)


def test_a_request_of_the_present_mode_changes_nothing_and_disarming_ends_a_takeoff() -> None:
    """Scripts ask for GUIDED until HEARTBEAT shows it; set_mode returns at once in that mode."""
    vehicle = Bench(firmware=ARDUPILOT, boot_scale=0.1)
    vehicle.run(4.5)

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


def test_modes_that_do_not_start_while_armed() -> None:
    """Disarmed any mode is entered."""
    vehicle = guided()
    mission = vehicle.instance.autopilot.mission
    for number, title in ((AUTO, "AUTO"), (THROW, "THROW")):
        assert vehicle.command(176, 1, number) == [FAILED]
        assert vehicle.texts()[-1] == f"Mode change to {title} failed: init failed"
        assert vehicle.mode == GUIDED
    assert vehicle.command(300) == [FAILED]
    mission.store(tuple(MissionItem(3, 16, (0.0,) * 4, 0, 0, up_m) for up_m in (0.0, 5.0)))
    assert vehicle.command(300) == [ACCEPTED]
    ground = Bench(firmware=ARDUPILOT, boot_scale=0.1)
    ground.run(4.5)
    ground.instance.autopilot.mission.store(mission.items)
    for number in (THROW, AUTO, GUIDED):
        assert ground.command(176, 1, number) == [ACCEPTED]
    assert ground.command(400, 1) == [ACCEPTED]
    assert ground.command(176, 1, AUTO) == [FAILED]
    failed = "Mode change to AUTO failed: init failed"
    assert ground.texts()[-2:] == ["Auto: Missing Takeoff Cmd", failed]


def test_a_lost_ground_station_disarms_on_the_ground_and_leaves_the_pilot_his_mode() -> None:
    vehicle = loitering()
    vehicle.set("FS_GCS_ENABLE", 1)
    vehicle.heartbeat_type = None
    vehicle.run(6.0)
    assert (vehicle.mode, vehicle.system_status) == (5, 4)
    assert "GCS Failsafe - Continuing Pilot Control" in vehicle.texts()
    ground = Bench(firmware=ARDUPILOT, boot_scale=0.1)
    ground.codec.srcSystem = 255
    ground.set("FS_GCS_ENABLE", 1)
    ground.run(4.5)
    assert ground.command(176, 1, GUIDED) == [ACCEPTED]
    ground.heartbeat_type = None
    assert ground.command(400, 1) == [ACCEPTED]
    ground.run(6.0)
    assert (ground.armed, ground.mode) == (False, GUIDED)
    assert ground.texts()[-2:] == ["Disarming motors", "GCS Failsafe - Disarming"]


def test_a_nan_thrust_is_zero_and_prevents_arming_until_reboot() -> None:
    vehicle = guided()
    vehicle.run(0.5, lambda: vehicle.attitude(LEVEL, NAN))
    assert climb_mps(vehicle) < -2.0
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
def test_without_gps_the_position_is_lost_after_eight_seconds(
    action: int, mode: int, texts: list[str]
) -> None:
    vehicle = guided(FS_EKF_ACTION=action)
    vehicle.command(511, 193, 100_000)
    autopilot = vehicle.instance.autopilot
    autopilot.state.gps_healthy = False
    vehicle.run(7.8)
    assert (vehicle.mode, vehicle.system_status) == (GUIDED, 4)
    vehicle.run(0.5)
    assert (vehicle.mode, vehicle.system_status) == (mode, 5 if texts else 4)
    assert vehicle.of("EKF_STATUS_REPORT")[-1][1].flags == 167
    autopilot.state.gps_healthy = True
    vehicle.run(0.5)
    assert vehicle.of("EKF_STATUS_REPORT")[-1][1].flags == 831
    assert (vehicle.mode, vehicle.system_status) == (mode, 4)
    assert vehicle.texts() == texts


# -- sticks, by RC_CHANNELS_OVERRIDE and MANUAL_CONTROL ------------------------------------------

KEEP = 65535
FEIGNED = (1500, 1500, 1000, 1500, 1800, 1000, 1000, 1800)
MIDDLE = (1500, 1500, 1500, 1500)


def loitering() -> Bench:
    bench = aloft(firmware=ARDUPILOT, mode="LOITER")
    bench.codec.srcSystem = 255
    push(bench, 0.2, *MIDDLE)
    return bench


def push(bench: Bench, duration_s: float, *widths: int) -> None:
    filled = (*widths, *(KEEP,) * (8 - len(widths)))
    message = mavlink.MAVLink_rc_channels_override_message(1, 1, *filled)
    bench.run(duration_s, lambda: bench.send(message), 0.2)


def seen(bench: Bench) -> tuple[int, ...]:
    bench.command(512, 65)
    _, channels = bench.of("RC_CHANNELS")[-1]
    return tuple(getattr(channels, f"chan{i}_raw") for i in range(1, 9))


def test_the_throttle_is_a_climb_rate_and_an_override_lasts_three_seconds() -> None:
    """Then the throttle of the feigned remote control, at its lower end, descends."""
    bench = loitering()
    for width, climb in ((1700, 0.63), (1300, -0.68), (1580, 0.0)):
        push(bench, 3.0, 1500, 1500, width, 1500)
        assert climb_mps(bench) == pytest.approx(climb, abs=0.08)
        height_m = bench.height_m
        push(bench, 4.0, *MIDDLE)
        assert bench.height_m == pytest.approx(height_m + 0.35 * climb, abs=0.35)
    assert seen(bench) == (*MIDDLE, *FEIGNED[4:])
    bench.run(4.5)
    assert seen(bench) == FEIGNED
    assert climb_mps(bench) == pytest.approx(-2.4, abs=0.3)


def test_a_stick_accelerates_and_the_vehicle_stops_when_it_is_centred() -> None:
    """Pitch 1400: 0.43, 0.85, 1.15 and 1.36 m/s ahead second by second; released after five it
    went on at 1.1 m/s for a second and stood after two."""
    bench = loitering()
    speeds = []
    for _ in range(4):
        push(bench, 1.0, 1500, 1400, 1500, 1500)
        speeds.append(bench.velocity[0])
    assert speeds == pytest.approx([0.43, 0.85, 1.15, 1.36], abs=0.2)
    push(bench, 1.0, 1500, 1400, 1500, 1500)
    push(bench, 1.0, *MIDDLE)
    assert bench.velocity[0] == pytest.approx(1.14, abs=0.25)
    push(bench, 2.0, *MIDDLE)
    assert bench.velocity[:2] == pytest.approx((0.0, 0.0), abs=0.2)


def test_roll_flies_sideways_also_by_manual_control_of_the_ground_station_alone() -> None:
    bench = loitering()
    push(bench, 3.0, 1700, 1500, 1500, 1500)
    assert bench.velocity[1] == pytest.approx(2.65, abs=0.4)
    joystick = mavlink.MAVLink_manual_control_message(1, 0, 0, 700, 0, 0)
    bench.run(3.0, lambda: bench.send(joystick), 0.2)
    assert seen(bench)[:4] == (1500, 1500, 1700, 1500)
    assert climb_mps(bench) == pytest.approx(0.63, abs=0.1)
    bench.codec.srcSystem = 42
    push(bench, 0.02, 1100, 1100, 1100, 1100)
    assert seen(bench)[:4] == (1500, 1500, 1700, 1500)
    bench.codec.srcSystem = 255
    push(bench, 0.02, 0, KEEP, 0, KEEP)  # zero releases
    assert seen(bench) == (1500, 1500, 1000, 1500, *FEIGNED[4:])


def test_manual_control_releases_axes_and_keeps_the_ground_station_present() -> None:
    """32767 is an axis that is not used; a negative throttle or another target changes nothing."""
    bench = loitering()
    for target, throttle, roll_axis, widths in (
        (1, 700, 0, (1500, 1500, 1700, 1500)),
        (1, -1, 500, (1500, 1500, 1700, 1500)),
        (2, 300, 500, (1500, 1500, 1700, 1500)),
        (1, 700, 32767, (1500, 1500, 1700, 1500)),
        (1, 32767, 500, (1750, 1500, 1000, 1500)),
    ):
        bench.send(mavlink.MAVLink_manual_control_message(target, 0, roll_axis, throttle, 0, 0))
        bench.run(0.02)
        assert seen(bench)[:4] == widths
    bench.set("FS_GCS_ENABLE", 1)
    bench.heartbeat_type = None
    joystick = mavlink.MAVLink_manual_control_message(1, 0, 0, 500, 0, 0)
    bench.run(7.0, lambda: bench.send(joystick), 0.5)
    assert not [text for text in bench.texts() if text.startswith("GCS Failsafe")]
    bench.run(6.0)
    assert [text for text in bench.texts() if text.startswith("GCS Failsafe")]
