"""Recovery: what is asked of a vehicle without controller, against a table of what it shows."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest

from offboard.mavlink.dialects.ardupilot import ARDUPILOT
from offboard.mavlink.dialects.base import Dialect
from offboard.mavlink.dialects.px4 import PX4
from offboard.mavlink.events import CommandAck, Heartbeat, ModeReport, VehicleFound
from offboard.supervisor.recovery import LONGEST_S, Recovery, Supervised

STEP_S = 0.02
FIRMWARES = pytest.mark.parametrize("dialect", [PX4, ARDUPILOT], ids=["px4", "ardupilot"])
HOLD, LAND = 176, 21  # MAV_CMD_DO_SET_MODE, MAV_CMD_NAV_LAND
OURS = Supervised(VehicleFound(7, 1, "px4"), ours=True, flying=True, reported_s=math.inf)


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
        recovery = Recovery(self.dialect, replace(OURS, holding=holding), 100.0)
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


DISARMED, TOO_LONG = "the vehicle is disarmed", f"not landed after {LONGEST_S:.0f} s"
NOT_ASKED = "the vehicle shows {hold}, and has not acknowledged the request"


@FIRMWARES
@pytest.mark.parametrize(
    ("vehicle", "before", "ended", "commands"),
    [
        ({}, "engage", DISARMED, [HOLD, LAND]),
        ({"heard": False}, None, TOO_LONG, [HOLD, HOLD, HOLD]),
        # every request was lost, and its pilot or its failsafe has chosen hold
        ({"acknowledges": False}, "engage", NOT_ASKED, [HOLD] * 5),
        # as on a real PX4: the controller continued, and read the acknowledgement
        ({"loses": 1}, "engage", DISARMED, [HOLD, HOLD, LAND]),
        # also hold that we did not ask for: somebody decided it
        ({}, "hold", "the vehicle shows {hold}", []),
        ({}, "ALTCTL", "the vehicle shows ALTCTL", []),
    ],
    ids=["obeys", "not heard", "not acknowledged", "acknowledgement lost", "holds", "left"],
)
def test_what_is_asked(
    dialect: Dialect, vehicle: dict[str, int], before: str | None, ended: str, commands: list[int]
) -> None:
    flown, modes = Vehicle(dialect), {"engage": dialect.engage_mode, "hold": dialect.hold_mode}
    vars(flown).update(vehicle)
    shown = modes.get(before or "", before)
    assert flown.survives(before=shown).startswith(ended.format(**modes))
    assert [command for _, command in flown.asked] == commands


@FIRMWARES
def test_hold_at_once_then_land_until_disarmed(dialect: Dialect) -> None:
    vehicle = Vehicle(dialect)
    assert vehicle.survives() == DISARMED
    commands = [command for _, command in vehicle.asked]
    assert vehicle.asked[0] == (0.0, HOLD)
    assert commands == [HOLD] * (len(commands) - 1) + [LAND]
    assert len(commands) <= 4  # hold is repeated until the first report
    assert 5.0 <= vehicle.asked[-1][0] <= 6.6
    holding = Vehicle(dialect)  # as the controller has asked
    holding.mode = dialect.hold_mode
    assert holding.survives(before=dialect.hold_mode, holding=True) == DISARMED
    assert [command for _, command in holding.asked] == [LAND]


@FIRMWARES
def test_a_pilot_is_never_overridden(dialect: Dialect) -> None:
    """His mode ends it with the first report; nothing is asked after that."""
    mode = {"px4": "POSCTL", "ardupilot": "LOITER"}[dialect.name]
    for pilot_s in (0.0, 0.2, 0.9, 3.0, 7.0, 12.0):
        vehicle = Vehicle(dialect, obeys=pilot_s > 1.0, land_s=60.0)
        vehicle.pilot = (pilot_s, mode)
        assert vehicle.survives() == f"the vehicle shows {mode}: its pilot or its failsafe has it"
        assert all(at_s < pilot_s + 1.02 for at_s, _ in vehicle.asked)
        late = [at_s for at_s, _ in vehicle.asked if at_s > pilot_s]
        assert len(late) <= 2  # asked before the first report


@FIRMWARES
def test_a_vehicle_that_refuses_to_hold_is_asked_to_land(dialect: Dialect) -> None:
    vehicle = Vehicle(dialect, obeys=False)
    assert vehicle.survives() == TOO_LONG
    assert {command for at_s, command in vehicle.asked if at_s < 5.0} == {HOLD}
    assert {command for at_s, command in vehicle.asked if at_s > 5.0} == {LAND}
    assert len(vehicle.asked) <= 3 + LONGEST_S  # once for each report


def asked(*reports: tuple[float, str], armed: bool = True) -> tuple[list[int], str]:
    """What is asked of a PX4 that acknowledges hold 0.05 s after the request at 100 s, and shows
    these modes at these times, and in its next HEARTBEAT whether it is `armed`; and how it
    ended."""
    recovery = Recovery(PX4, OURS, 100.0)
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


def test_hold_of_before_the_request_or_after_the_landing_mode_is_the_pilots() -> None:
    """The first arrived before the request left, and was read after it."""
    assert set(asked(*HOLDS)[0]) == {HOLD, LAND}
    commands, ended = asked((99.99, PX4.hold_mode), *HOLDS)
    assert (commands, ended[:30]) == ([HOLD], "the vehicle shows AUTO.LOITER:")
    landing = [*((t, m) for t, m in HOLDS if t < 105.8), *LANDS[:3]]
    assert asked(*landing) == ([HOLD, LAND], "")
    commands, ended = asked(*landing, *((106.92 + 0.1 * n, PX4.hold_mode) for n in range(51)))
    assert (commands, ended[:30]) == ([HOLD, LAND], "the vehicle shows AUTO.LOITER:")
    left_as_it_disarms = asked(*landing, (107.5, PX4.hold_mode), armed=False)
    assert left_as_it_disarms == ([HOLD, LAND], DISARMED)


def test_a_refusal_is_kept_to_be_said() -> None:
    recovery = Recovery(PX4, OURS, 0.0)
    for result, refusal in (("ACCEPTED", ""), ("DENIED", "DENIED")):
        recovery.see(CommandAck(HOLD, result), 0.1)
        assert recovery.refusal == refusal
