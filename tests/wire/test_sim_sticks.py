"""Sticks of the simulated autopilots: RC_CHANNELS_OVERRIDE and MANUAL_CONTROL.

ArduCopter 4.6.3 and PX4 1.16.1 SITL gave the expected values for the same input."""

from __future__ import annotations

import math

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from sim_bench import LOITER, OFFBOARD, POSCTL, RTL, Bench, aloft, hold

from simulator.firmware.ardupilot import ARDUPILOT

KEEP = 65535
SIMULATED_RC = (1500, 1500, 1000, 1500, 1800, 1000, 1000, 1800)
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


def test_stick_overrides_command_speeds_and_expire() -> None:
    """As on the real one, throttle is a climb rate, pitch accelerates and a centred stick brakes
    (speeds after each second). After the override the simulated remote control, throttle at its
    lower end, makes the vehicle descend."""
    bench = loitering()
    for width, climb in ((1700, 0.63), (1300, -0.68), (1580, 0.0)):
        push(bench, 3.0, 1500, 1500, width, 1500)
        assert bench.climb_mps == pytest.approx(climb, abs=0.08)
        height_m = bench.height_m
        push(bench, 4.0, *MIDDLE)
        assert bench.height_m == pytest.approx(height_m + 0.35 * climb, abs=0.35)
    for pitch, ahead_mps, near in (
        (1400, 0.43, 0.2), (1400, 0.85, 0.2), (1400, 1.15, 0.2), (1400, 1.36, 0.2),
        (1500, 1.0, 0.35), (1500, 0.3, 0.35), (1500, 0.0, 0.2),
    ):  # fmt: skip
        push(bench, 1.0, 1500, pitch, 1500, 1500)
        assert bench.velocity[0] == pytest.approx(ahead_mps, abs=near)
    push(bench, 3.0, 1700, 1500, 1500, 1500)
    assert bench.velocity[1] == pytest.approx(2.65, abs=0.4)
    push(bench, 3.0, *MIDDLE)
    assert seen(bench) == (*MIDDLE, *SIMULATED_RC[4:])
    bench.run(4.5)
    assert seen(bench) == SIMULATED_RC
    assert bench.climb_mps == pytest.approx(-2.4, abs=0.3)


def test_manual_control_overrides_sticks_and_counts_as_presence() -> None:
    """32767 is an axis that is not used; a negative throttle, another target or sender changes
    nothing. A width of zero releases a channel."""
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
    bench.codec.srcSystem = 42
    push(bench, 0.02, 1100, 1100, 1100, 1100)
    assert seen(bench)[:4] == widths
    bench.codec.srcSystem = 255
    push(bench, 0.02, 0, KEEP, 0, KEEP)
    assert seen(bench) == (1500, 1500, 1000, 1500, *SIMULATED_RC[4:])
    bench.set("FS_GCS_ENABLE", 1)
    bench.heartbeat_type = None
    joystick = mavlink.MAVLink_manual_control_message(1, 0, 0, 700, 0, 0)
    bench.run(7.0, lambda: bench.send(joystick), 0.5)
    assert bench.climb_mps == pytest.approx(0.63, abs=0.1)
    assert not [text for text in bench.texts() if text.startswith("GCS Failsafe")]
    bench.run(6.0)
    assert [text for text in bench.texts() if text.startswith("GCS Failsafe")]


# -- PX4 -----------------------------------------------------------------------------------------

OVERRIDE = "Pilot took over using sticks"


class Joystick:
    """Sends MANUAL_CONTROL at 20 Hz; the axes are attributes."""

    def __init__(self, bench: Bench, pitch: int = 0, roll: int = 0, throttle: int = 500) -> None:
        self.bench, self.yaw = bench, 0
        self.pitch, self.roll, self.throttle = pitch, roll, throttle

    def send(self) -> None:
        axes = (self.pitch, self.roll, self.throttle, self.yaw)
        self.bench.send(mavlink.MAVLink_manual_control_message(1, *axes, 0))

    def run(self, duration_s: float, **axes: int) -> None:
        for name, value in axes.items():
            setattr(self, name, value)
        self.bench.run(duration_s, self.send)


def test_px4_arms_takes_off_and_lands_by_sticks() -> None:
    bench = Bench()
    bench.run(5.0)
    assert bench.ask_mode(POSCTL) == [0, 0]
    assert bench.command(400, 1) == [1]
    radio = mavlink.MAV_SYS_STATUS_SENSOR_RC_RECEIVER
    assert not bench.of("SYS_STATUS")[-1][1].onboard_control_sensors_health & radio
    stick = Joystick(bench, throttle=800)
    stick.run(1.0)
    assert bench.of("SYS_STATUS")[-1][1].onboard_control_sensors_health & radio
    assert bench.command(400, 1) == [1]
    stick.run(0.5, throttle=500)
    assert bench.command(400, 1) == [0]
    assert bench.texts()[-3:] == [
        "Arming denied: Resolve system health failures first",
        "Arming denied: throttle above center",
        "Armed by external command",
    ]
    stick.run(2.0)
    assert bench.height_m == pytest.approx(0.0, abs=0.02)
    stick.run(6.0, throttle=1000)
    assert 4.0 < bench.height_m < 12.0
    stick.run(2.0, throttle=500)
    assert bench.climb_mps == pytest.approx(0.0, abs=0.1)
    stick.run(3.0, throttle=0)
    assert bench.climb_mps == pytest.approx(-1.5, abs=0.1)
    stick.run(9.0)
    assert not bench.armed
    assert bench.texts()[-2:] == ["Landing detected", "Disarmed by landing"]


def test_px4_sticks_demand_speed_and_turn_rate() -> None:
    bench = aloft()
    stick = Joystick(bench)
    stick.run(0.5)
    assert bench.ask_mode(POSCTL) == [0, 0]
    for seconds, ahead_mps in ((1.0, 2.0), (1.0, 3.8), (2.0, 6.0), (2.0, 7.2)):
        stick.run(seconds, pitch=1000)
        assert bench.velocity[0] == pytest.approx(ahead_mps, rel=0.2)
    stick.run(1.5, pitch=0)
    assert bench.velocity[0] == pytest.approx(2.7, abs=0.7)
    stick.run(4.0)
    assert math.hypot(*bench.velocity) < 0.4
    for axis, turn_degps in ((500, 32.0), (1000, 145.0)):
        before = bench.heading_deg
        stick.run(1.0, yaw=axis)
        stick.run(2.0, yaw=0)
        assert (bench.heading_deg - before) % 360.0 == pytest.approx(turn_degps, abs=10.0)


def test_px4_sticks_end_automatic_modes_and_offboard_if_allowed() -> None:
    """A stick that moves slowly, or stands away from its centre, ends nothing."""
    bench = aloft()
    stick = Joystick(bench, throttle=700)
    stick.run(1.0)
    for axis in range(0, 200, 5):
        stick.run(0.05, roll=axis)
    assert (bench.mode, bench.texts()) == (LOITER, [])
    stick.run(0.5, roll=0)
    assert (bench.mode, bench.texts()) == (POSCTL, [OVERRIDE])
    stick.run(1.0, throttle=500)
    for override, mode in ((1, OFFBOARD), (3, POSCTL)):
        bench.set("COM_RC_OVERRIDE", override)
        hold(bench, 0.6)
        assert bench.ask_mode(OFFBOARD)[-1] == 0
        stick.send()
        bench.run(0.05)
        stick.pitch = 600
        stick.send()
        bench.run(0.05)
        assert bench.mode == mode
        stick.run(0.4, pitch=0)


@pytest.mark.parametrize(
    ("mode", "except_modes", "ends"),
    [
        (POSCTL, 7, RTL),
        (LOITER, 0, RTL),
        (LOITER, 2, LOITER),
        (OFFBOARD, 0, RTL),
        (OFFBOARD, 4, OFFBOARD),
    ],
)
def test_px4_returns_after_it_has_lost_the_sticks(mode: int, except_modes: int, ends: int) -> None:
    """With NAV_RCL_ACT 2; COM_RCL_EXCEPT exempts modes. A vehicle that never had sticks flies on.
    After the failsafe the sticks alone do not take it back."""
    bench = aloft()
    bench.set("COM_RCL_EXCEPT", except_modes)
    hold(bench, 2.0)
    assert not bench.texts()
    stick = Joystick(bench)
    stick.run(0.3)
    hold(bench, 0.3)
    assert bench.ask_mode(mode)[-1] == 0
    hold(bench, 1.0)
    lost = [] if ends == mode else ["Failsafe activated: entering Hold for 5 seconds"]
    assert bench.texts() == lost
    assert bench.mode == (mode if ends == mode else LOITER)
    hold(bench, 5.0)
    stick.run(0.5)
    assert bench.mode == ends
