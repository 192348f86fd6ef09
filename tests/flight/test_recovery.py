"""Recovery: what is asked of a vehicle without controller, against a table of what it shows."""

from __future__ import annotations

import pytest

from offboard.mavlink.dialects.ardupilot import ARDUPILOT
from offboard.mavlink.dialects.base import Dialect
from offboard.mavlink.dialects.px4 import PX4
from offboard.mavlink.events import CommandAck, Heartbeat, ModeReport
from offboard.supervisor.recovery import LONGEST_S, Recovery

STEP_S = 0.02
FIRMWARES = pytest.mark.parametrize("dialect", [PX4, ARDUPILOT], ids=["px4", "ardupilot"])
HOLD, LAND = 176, 21  # MAV_CMD_DO_SET_MODE, MAV_CMD_NAV_LAND


class Vehicle:
    """Shows its mode once a second, follows what is asked, and lands in `land_s`."""

    def __init__(self, dialect: Dialect, *, obeys: bool = True, land_s: float = 8.0) -> None:
        self.dialect = dialect
        self.mode = dialect.engage_mode
        self.obeys = obeys
        self.acknowledges = obeys
        self.loses = 0  # acknowledgements, on the link
        self.armed = True
        self.heard = True
        self.land_s = land_s
        self.asked: list[tuple[float, int]] = []
        self.pilot: tuple[float, str] | None = None

    def survives(self, before: str | None = None, *, holding: bool = False) -> str:
        """Run to the end of the recovery, which has heard the mode `before` it began."""
        recovery = Recovery(self.dialect, 100.0, holding=holding)
        if before:
            recovery.see(Heartbeat(before, True, 4, 2), 99.6)
        landing_s = 0.0
        for step in range(round((LONGEST_S + 1.0) / STEP_S)):
            time_s = step * STEP_S
            if self.pilot and time_s >= self.pilot[0]:
                self.mode = self.pilot[1]
            elif self.mode == self.dialect.land_mode:
                landing_s += STEP_S
            self.armed = landing_s < self.land_s
            if self.heard and step % 50 == 25:
                recovery.see(Heartbeat(self.mode, self.armed, 4, 2), 100.0 + time_s)
            request = recovery.due(100.0 + time_s)
            if request:
                self.asked.append((round(time_s, 2), request.command.command))
                self.loses -= 1
                if self.acknowledges and self.loses < 0:
                    ack = CommandAck(request.command.command, "ACCEPTED")
                    recovery.see(ack, 100.0 + time_s + STEP_S)
                if self.obeys:
                    landing = request.command.command == LAND
                    self.mode = self.dialect.land_mode if landing else self.dialect.hold_mode
            if recovery.ended:
                return recovery.ended
        return "never"


@FIRMWARES
def test_hold_at_once_then_land_until_disarmed(dialect: Dialect) -> None:
    vehicle = Vehicle(dialect)
    assert vehicle.survives() == "the vehicle is disarmed"
    commands = [command for _, command in vehicle.asked]
    assert vehicle.asked[0] == (0.0, HOLD)
    assert commands == [HOLD] * (len(commands) - 1) + [LAND]
    assert len(commands) <= 4  # hold is repeated until the first report
    assert 5.0 <= vehicle.asked[-1][0] <= 6.6


@FIRMWARES
def test_a_report_of_before_is_enough_to_ask_once(dialect: Dialect) -> None:
    vehicle = Vehicle(dialect)
    assert vehicle.survives(before=dialect.engage_mode) == "the vehicle is disarmed"
    assert [command for _, command in vehicle.asked] == [HOLD, LAND]


@FIRMWARES
@pytest.mark.parametrize("pilot_s", [0.0, 0.2, 0.9, 3.0, 7.0, 12.0])
def test_a_pilot_is_never_overridden(dialect: Dialect, pilot_s: float) -> None:
    """His mode ends it with the first report; nothing is asked after that."""
    mode = {"px4": "POSCTL", "ardupilot": "LOITER"}[dialect.name]
    vehicle = Vehicle(dialect, obeys=pilot_s > 1.0)
    vehicle.pilot = (pilot_s, mode)
    vehicle.land_s = 60.0
    assert vehicle.survives() == f"the vehicle shows {mode}: its pilot or its failsafe has it"
    reported_s = pilot_s + 1.02
    assert all(at_s < reported_s for at_s, _ in vehicle.asked)
    late = [at_s for at_s, _ in vehicle.asked if at_s > pilot_s]
    assert len(late) <= 2  # asked before the first report


@FIRMWARES
@pytest.mark.parametrize("mode", ["hold", "other"])
def test_a_mode_left_before_is_left_alone(dialect: Dialect, mode: str) -> None:
    """Also hold that we did not ask for: somebody decided it."""
    vehicle = Vehicle(dialect)
    left = dialect.hold_mode if mode == "hold" else "ALTCTL"
    assert vehicle.survives(before=left).startswith(f"the vehicle shows {left}")
    assert vehicle.asked == []


@FIRMWARES
def test_a_vehicle_that_the_controller_asked_to_hold_is_landed(dialect: Dialect) -> None:
    vehicle = Vehicle(dialect)
    vehicle.mode = dialect.hold_mode
    assert vehicle.survives(before=dialect.hold_mode, holding=True) == "the vehicle is disarmed"
    assert [command for _, command in vehicle.asked] == [LAND]


@FIRMWARES
def test_a_vehicle_that_refuses_to_hold_is_asked_to_land(dialect: Dialect) -> None:
    vehicle = Vehicle(dialect, obeys=False)
    assert vehicle.survives() == f"not landed after {LONGEST_S:.0f} s"
    assert {command for at_s, command in vehicle.asked if at_s < 5.0} == {HOLD}
    assert {command for at_s, command in vehicle.asked if at_s > 5.0} == {LAND}
    assert len(vehicle.asked) <= 3 + LONGEST_S  # once for each report


@FIRMWARES
def test_of_a_vehicle_that_is_not_heard_hold_is_asked_three_times(dialect: Dialect) -> None:
    vehicle = Vehicle(dialect)
    vehicle.heard = False
    assert vehicle.survives() == f"not landed after {LONGEST_S:.0f} s"
    assert [command for _, command in vehicle.asked] == [HOLD] * 3
    assert [at_s for at_s, _ in vehicle.asked] == pytest.approx([0.0, 0.3, 0.6], abs=0.03)


@FIRMWARES
def test_hold_that_the_vehicle_has_not_acknowledged_is_left_alone(dialect: Dialect) -> None:
    """Every request was lost, and its pilot or its failsafe has chosen hold: nothing but hold is
    asked."""
    vehicle = Vehicle(dialect)
    vehicle.acknowledges = False
    assert vehicle.survives(before=dialect.engage_mode).startswith(
        f"the vehicle shows {dialect.hold_mode}, and has not acknowledged the request"
    )
    assert {command for _, command in vehicle.asked} == {HOLD}
    assert len(vehicle.asked) <= 5


@FIRMWARES
def test_a_lost_acknowledgement_of_hold_does_not_leave_the_vehicle_there(dialect: Dialect) -> None:
    """As on a real PX4: the controller continued, and read the acknowledgement."""
    vehicle = Vehicle(dialect)
    vehicle.loses = 1
    assert vehicle.survives(before=dialect.engage_mode) == "the vehicle is disarmed"
    assert [command for _, command in vehicle.asked] == [HOLD, HOLD, LAND]


def asked(*reports: tuple[float, str], armed: bool = True) -> tuple[list[int], str]:
    """What is asked of a PX4 that acknowledges hold 0.05 s after the request at 100 s, and shows
    these modes at these times, and in its next HEARTBEAT whether it is `armed`; and how it
    ended."""
    recovery = Recovery(PX4, 100.0)
    recovery.see(Heartbeat(PX4.engage_mode, True, 4, 2), 99.6)
    commands = []
    events = [(100.05, CommandAck(HOLD, "ACCEPTED")), *((t, ModeReport(m)) for t, m in reports)]
    for step in range(601):
        now_s = 100.0 + STEP_S * step
        request = recovery.due(now_s)
        commands += [request.command.command] if request else []
        for at_s, event in events:
            if now_s - STEP_S < at_s <= now_s + 1e-9 or (not step and at_s <= now_s):
                recovery.see(event, at_s)
    if not recovery.ended:
        recovery.see(Heartbeat(reports[-1][1], armed, 4, 2), 112.1)
        request = recovery.due(112.1)
        commands += [request.command.command] if request else []
    return commands, recovery.ended


HOLDS = [(100.5 + 0.5 * n, PX4.hold_mode) for n in range(22)]
LANDS = [(105.9 + 0.5 * n, PX4.land_mode) for n in range(12)]


@pytest.mark.parametrize("left_s", [100.01, 100.2, 100.31, 103.0])
def test_a_pilot_who_switches_and_then_holds_is_left_alone(left_s: float) -> None:
    """Also within 0.3 s of our request, and although the vehicle has acknowledged it."""
    later = [(t, m) for t, m in HOLDS if t > left_s]
    commands, ended = asked((left_s, "POSCTL"), (left_s + 0.001, PX4.hold_mode), *later)
    assert commands == [HOLD]
    assert ended.startswith("the vehicle shows POSCTL")


def test_hold_of_before_the_request_is_the_pilots() -> None:
    """It arrived before the request left, and was read after it."""
    assert set(asked(*HOLDS)[0]) == {HOLD, LAND}
    commands, ended = asked((99.99, PX4.hold_mode), *HOLDS)
    assert commands == [HOLD]
    assert ended.startswith("the vehicle shows AUTO.LOITER")


def test_hold_after_the_landing_mode_is_the_pilots() -> None:
    landing = [*((t, m) for t, m in HOLDS if t < 105.8), *LANDS[:3]]
    assert asked(*landing) == ([HOLD, LAND], "")
    commands, ended = asked(*landing, *((106.92 + 0.1 * n, PX4.hold_mode) for n in range(51)))
    assert commands == [HOLD, LAND]
    assert ended.startswith("the vehicle shows AUTO.LOITER")


def test_a_px4_that_shows_another_mode_as_it_disarms_has_landed() -> None:
    reports = [*((t, m) for t, m in HOLDS if t < 105.8), *LANDS[:3], (107.5, PX4.hold_mode)]
    assert asked(*reports, armed=False) == ([HOLD, LAND], "the vehicle is disarmed")


def test_a_refusal_is_kept_to_be_said() -> None:
    recovery = Recovery(PX4, 0.0)
    recovery.see(CommandAck(HOLD, "ACCEPTED"), 0.1)
    assert recovery.refusal == ""
    recovery.see(CommandAck(HOLD, "DENIED"), 0.1)
    assert recovery.refusal == "DENIED"
