"""The simulated ArduCopter: its default messages, arming rules, setpoints and their limits.

Expected values are those of ArduCopter 4.6.3 SITL. The start is ten times as fast as its 42 s.
"""

from __future__ import annotations

import math
from collections import Counter

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from sim_bench import NAN, Bench

from simulator.firmware.ardupilot import ARDUPILOT
from simulator.vehicle.sensors import EstimatorName

ALT_HOLD, GUIDED, LAND = 2, 4, 9
ACCEPTED, FAILED = 0, 4
ONBOARD = mavlink.MAV_TYPE_ONBOARD_CONTROLLER
BOOT_SCALE = 0.1
HOVER = 0.3655
LEVEL = (1.0, 0.0, 0.0, 0.0)


def bench(
    heartbeat_type: int | None = ONBOARD,
    boot_scale: float = BOOT_SCALE,
    estimator: EstimatorName = EstimatorName.PERFECT,
) -> Bench:
    return Bench(
        estimator,
        heartbeat_type=heartbeat_type,
        firmware=ARDUPILOT,
        boot_scale=boot_scale,
    )


def roll(degrees: float, length: float = 1.0) -> tuple[float, float, float, float]:
    half = math.radians(degrees) / 2.0
    return length * math.cos(half), length * math.sin(half), 0.0, 0.0


def ask_mode(vehicle: Bench, number: int) -> list[int]:
    return vehicle.command(176, 1, number)


def set_parameter(vehicle: Bench, name: str, value: float) -> None:
    vehicle.send(mavlink.MAVLink_param_set_message(1, 1, name.encode(), value, 9))


def roll_deg(vehicle: Bench) -> float:
    w, x, y, z = vehicle.instance.autopilot.state.truth.attitude
    return math.degrees(math.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y)))


def climb_mps(vehicle: Bench) -> float:
    return -float(vehicle.instance.autopilot.state.truth.velocity_ned_mps[2])


def ready(mode: int = GUIDED, estimator: EstimatorName = EstimatorName.PERFECT) -> Bench:
    """Booted and in a mode, thrust is thrust."""
    vehicle = bench(estimator=estimator)
    vehicle.run(4.5)
    set_parameter(vehicle, "GUID_OPTIONS", 8)
    assert ask_mode(vehicle, mode) == [ACCEPTED]
    return vehicle


def flying(height_m: float = 5.0) -> Bench:
    """Hovering in GUIDED after a takeoff by command."""
    vehicle = ready()
    assert vehicle.command(400, 1) == [ACCEPTED]
    assert vehicle.command(22, *(0.0,) * 6, height_m) == [ACCEPTED]
    vehicle.run(9.0)
    assert vehicle.height_m == pytest.approx(height_m, abs=0.2)
    return vehicle


# -- telemetry -------------------------------------------------------------------------------


def test_without_requests_it_sends_heartbeat_timesync_and_home() -> None:
    """And texts, once somebody spoke; origin and home when the filter has found them."""
    vehicle = bench()
    vehicle.run(20.0)
    counts = Counter(m.get_type() for _, m in vehicle.received)
    counts.pop("STATUSTEXT")
    assert counts == {
        "HEARTBEAT": 21,  # the first at once, where the real one waits a second
        "TIMESYNC": 3,
        "GPS_GLOBAL_ORIGIN": 1,
        "HOME_POSITION": 1,
    }


# -- takeoff and landing ---------------------------------------------------------------------


def test_takeoff_by_setpoints_alone() -> None:
    """.3 m after 3.3-3.9 s; any thrust is flight, even if it cannot lift."""
    vehicle = ready()
    vehicle.command(400, 1)
    armed_s = vehicle.time_s
    lifted: list[float] = []

    def push() -> None:
        vehicle.attitude(thrust=0.45)
        if vehicle.height_m > 0.3:
            lifted.append(vehicle.time_s)

    vehicle.run(5.0, push)
    assert 3.3 <= lifted[0] - armed_s <= 3.9

    weak = ready()
    weak.command(400, 1)
    weak.run(12.0, lambda: weak.attitude(thrust=0.05))
    assert weak.height_m < 0.01
    assert weak.instance.view.landed_state == 2
    assert weak.armed


# -- setpoints -------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("mask", "length", "rolls"),
    [
        (7, 1.0, True),
        (7, -1.0, True),
        (7, 1.0006, False),
        (7, 2.0, False),
        (7, NAN, False),
        (71, 1.0, False),
        (199, 1.0, False),
    ],
)
def test_which_attitude_setpoints_are_flown(mask: int, length: float, rolls: bool) -> None:
    vehicle = flying()
    vehicle.run(0.6, lambda: vehicle.attitude(roll(8.0, length), HOVER, mask))
    assert (abs(roll_deg(vehicle) - 8.0) < 1.0) == rolls


@pytest.mark.parametrize(
    ("thrust", "climb"), [(0.5, 0.0), (1.0, 2.5), (0.75, 1.25), (0.0, -1.5), (2.0, 2.5)]
)
def test_without_guid_options_thrust_is_a_climb_rate(thrust: float, climb: float) -> None:
    vehicle = flying()
    set_parameter(vehicle, "GUID_OPTIONS", 0)
    vehicle.run(2.0, lambda: vehicle.attitude(LEVEL, thrust))
    assert climb_mps(vehicle) == pytest.approx(climb, abs=0.1)


def test_a_nan_thrust_is_zero_and_prevents_arming_until_reboot() -> None:
    vehicle = flying()
    vehicle.run(0.5, lambda: vehicle.attitude(LEVEL, NAN))
    assert climb_mps(vehicle) < -2.0
    assert vehicle.system_status == 5
    vehicle.command(400, 0, 21196)
    vehicle.run(3.0)
    ask_mode(vehicle, GUIDED)
    assert vehicle.command(400, 1) == [FAILED]
    assert "Arm: Internal Errors 0x400" in vehicle.texts()


@pytest.mark.parametrize(("period_s", "levels"), [(2.94, False), (3.3, True)])
def test_one_setpoint_in_three_seconds_is_enough(period_s: float, levels: bool) -> None:
    vehicle = flying()
    vehicle.attitude(roll(3.0), HOVER)
    vehicle.run(1.0)
    seen_deg = []
    for step in range(round(7.0 / 0.02)):
        if step % round(period_s / 0.02) == 0:
            vehicle.attitude(roll(3.0), HOVER)
        vehicle.run(0.02)
        seen_deg.append(roll_deg(vehicle))
    assert (min(seen_deg) < 1.5) == levels
    assert max(seen_deg) == pytest.approx(3.0, abs=0.1)


# -- parameters ------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("action", "mode", "texts"),
    [
        (0, GUIDED, []),
        (1, LAND, ["EKF variance", "EKF Failsafe: changed to LAND Mode"]),
        (2, ALT_HOLD, ["EKF variance", "EKF Failsafe: changed to ALT_HOLD Mode"]),
    ],
)
def test_without_gps_the_position_is_lost_after_eight_seconds(
    action: int, mode: int, texts: list[str]
) -> None:
    vehicle = flying()
    set_parameter(vehicle, "FS_EKF_ACTION", action)
    vehicle.command(511, 193, 100_000)
    autopilot, begun_s = vehicle.instance.autopilot, vehicle.time_s
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
    assert vehicle.texts(begun_s) == ([*texts, "EKF Failsafe Cleared"] if texts else [])


def test_parameters_carry_values_whatever_their_type() -> None:
    vehicle = bench()
    for name, sent in (("GUID_OPTIONS", 8.6), ("GUID_TIMEOUT", 50.0), ("DISARM_DELAY", 1.1e-44)):
        set_parameter(vehicle, name, sent)
    set_parameter(vehicle, "GUID_TIMEOUT", NAN)
    set_parameter(vehicle, "NO_SUCH", 1.0)
    vehicle.run(0.1)
    told = [(m.param_id, m.param_value, m.param_type, m.param_index)
            for _, m in vehicle.of("PARAM_VALUE")]  # fmt: skip
    assert told[:3] == [
        ("GUID_OPTIONS", 8.0, 6, 65535),
        ("GUID_TIMEOUT", 50.0, 9, 65535),
        ("DISARM_DELAY", 0.0, 2, 65535),
    ]
    assert all(name != "NO_SUCH" for name, *_ in told)
