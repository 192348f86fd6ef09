"""Recovery: what the supervisor asks of a vehicle without controller.

The first tests use scripts of what the vehicle reports; the others a simulated PX4, whose own
failsafe for missing setpoints acts, too. `test_supervisor.py` tests the process and its sockets.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import pytest
from pair import LEAN, QUICK_LANDING
from watch import scenario_of

from offboard.mavlink.dialects.ardupilot import ARDUPILOT
from offboard.mavlink.dialects.base import Dialect
from offboard.mavlink.dialects.px4 import PX4
from offboard.mavlink.events import CommandAck, Event, Heartbeat, ModeReport, VehicleFound
from offboard.mavlink.outgoing import AttitudeTarget, CommandLong
from offboard.mavlink.session import Session, SessionSettings
from offboard.model.command import Command
from offboard.supervisor.recovery import LONGEST_S, Recovery, Supervised
from simulator import config
from simulator.instance import Instance
from simulator.steps import STEP_S

HOLD, LAND = 176, 21  # MAV_CMD_DO_SET_MODE, MAV_CMD_NAV_LAND
FIRMWARES = pytest.mark.parametrize("dialect", [PX4, ARDUPILOT], ids=["px4", "ardupilot"])
VEHICLE = VehicleFound(1, 1, "px4")
OURS = Supervised(VEHICLE, ours=True, flying=True, reported_s=math.inf, setpoint_s=0.0)
DISARMED, TOO_LONG = "the vehicle is disarmed", f"not landed after {LONGEST_S:.0f} s"
Timed = tuple[float, Event]
ACCEPTED = (0.05, CommandAck(HOLD, "ACCEPTED"))


def asked(
    dialect: Dialect, *events: Timed, shown: str = "", known: Supervised = OURS
) -> tuple[list[tuple[float, int]], str]:
    """Run a recovery that begins at 0 s, with a vehicle that showed the mode `shown` 0.4 s before
    and reports `events`. Return the times and numbers of the commands, and why it ended."""
    recovery, waiting = Recovery(dialect, known, 0.0), sorted(events, key=lambda each: each[0])
    if shown:
        recovery.see(Heartbeat(shown, True, 4, 2), -0.4)
    commands: list[tuple[float, int]] = []
    now_s, end_s = 0.0, 1.0 + (waiting[-1][0] if waiting else LONGEST_S)
    while not recovery.end_reason and now_s < end_s:
        request = recovery.due(now_s)
        commands += [(now_s, request.command)] if request else []
        while waiting and waiting[0][0] <= now_s:
            at_s, event = waiting.pop(0)
            recovery.see(event, at_s)
        now_s = round(now_s + 0.02, 2)
    return commands, recovery.end_reason


def beats(mode: str, first_s: float, last_s: float, *, armed: bool = True) -> list[Timed]:
    """Return HEARTBEATs that show this mode, one per second."""
    count = math.floor(last_s - first_s) + 1
    return [(first_s + number, Heartbeat(mode, armed, 4, 2)) for number in range(count)]


def words(commands: list[tuple[float, int]]) -> list[int]:
    return [command for _, command in commands]


@FIRMWARES
@pytest.mark.parametrize("answered_s", [0.05, 0.55], ids=["at once", "the second request"])
def test_recovery_requests_hold_then_land_until_disarmed(
    dialect: Dialect, answered_s: float
) -> None:
    """Also if the first COMMAND_ACK is missing; with a real PX4 the controller had read it."""
    commands, ended = asked(
        dialect,
        (answered_s, CommandAck(HOLD, "ACCEPTED")),
        *beats(dialect.hold_mode, 0.5, 5.5),
        *beats(dialect.land_mode, 6.5, 13.5),
        *beats(dialect.land_mode, 14.5, 14.5, armed=False),
        shown=dialect.engage_mode,
    )
    assert ended == DISARMED
    assert commands[0] == (0.0, HOLD)
    assert set(words(commands[:-1])) == {HOLD}
    assert commands[-1][1] == LAND
    assert 5.0 <= commands[-1][0] <= 6.6
    assert len(commands) <= 3


@FIRMWARES
def test_recovery_lands_a_vehicle_that_refuses_to_hold(dialect: Dialect) -> None:
    """PX4 by motion capture has no global position, which its hold needs."""
    refused = 0.05, CommandAck(HOLD, "TEMPORARILY_REJECTED")
    shown = beats(dialect.engage_mode, 0.5, 1.5)
    commands, _ = asked(dialect, refused, *shown, shown=dialect.engage_mode)
    assert commands[0] == (0.0, HOLD)
    assert commands[1:2] == [(pytest.approx(0.52), LAND)]
    assert HOLD not in words(commands[1:])


@FIRMWARES
def test_recovery_commands_only_a_vehicle_in_our_modes(dialect: Dialect) -> None:
    """A hold mode that the vehicle has not acknowledged, or showed before, was chosen by somebody
    else. A hold that the controller had requested is ours."""
    holds = beats(dialect.hold_mode, 0.5, 20.5)
    commands, ended = asked(dialect, *holds, shown=dialect.engage_mode)
    assert set(words(commands)) == {HOLD}
    assert ended.startswith(f"the vehicle shows {dialect.hold_mode}, and has not acknowledged")
    for shown in (dialect.hold_mode, "ALTCTL"):
        commands, ended = asked(dialect, shown=shown)
        assert (commands, ended.startswith(f"the vehicle shows {shown}")) == ([], True)
    holding = replace(OURS, holding=True)
    lands = [*holds[:5], *beats(dialect.land_mode, 5.5, 9.5, armed=False)]
    commands, ended = asked(dialect, *lands, shown=dialect.hold_mode, known=holding)
    assert (words(commands), ended) == ([LAND], DISARMED)


@FIRMWARES
def test_recovery_continues_a_landing(dialect: Dialect) -> None:
    """Regression: a landing was interrupted by 5 s of hold, and a pilot's hold was taken for the
    answer."""
    landing = replace(OURS, landing=True)
    down = beats(dialect.land_mode, 8.5, 8.5, armed=False)
    for mode in (dialect.land_mode, dialect.engage_mode):
        commands, ended = asked(dialect, *beats(mode, 0.5, 7.5), *down, known=landing)
        assert (set(words(commands)), ended) == ({LAND}, DISARMED)
    commands, ended = asked(dialect, *beats(dialect.hold_mode, 0.5, 9.5), known=landing)
    assert (set(words(commands)), ended[:17]) == ({LAND}, "the vehicle shows")
    assert commands[-1][0] < 0.5


@FIRMWARES
def test_recovery_limits_requests_to_an_unresponsive_vehicle(dialect: Dialect) -> None:
    """If nothing at all is heard, three requests are sent; else one per report, at last to land."""
    commands, ended = asked(dialect)
    assert (words(commands), ended) == ([HOLD] * 3, TOO_LONG)
    commands, ended = asked(dialect, *beats(dialect.engage_mode, 0.5, LONGEST_S + 1.0))
    assert ended == TOO_LONG
    assert {command for at_s, command in commands if at_s < 5.0} == {HOLD}
    assert {command for at_s, command in commands if at_s > 5.0} == {LAND}
    assert len(commands) <= 3 + LONGEST_S


@FIRMWARES
@pytest.mark.parametrize("pilot_s", [0.2, 3.5, 12.5])
def test_recovery_never_overrides_a_pilot(dialect: Dialect, pilot_s: float) -> None:
    """Nothing is requested after the first report of the pilot's mode: before hold, in hold, and in
    the landing."""
    mode = {"px4": "POSCTL", "ardupilot": "LOITER"}[dialect.name]
    obeyed = [*beats(dialect.hold_mode, 0.5, 5.5), *beats(dialect.land_mode, 6.5, 13.5)]
    before = [(at_s, event) for at_s, event in obeyed if at_s < pilot_s]
    commands, ended = asked(dialect, ACCEPTED, *before, *beats(mode, pilot_s, 20.5))
    assert ended == f"the vehicle shows {mode}: its pilot or its failsafe has it"
    assert all(at_s <= pilot_s for at_s, _ in commands)


HOLD_REPORTS = [(0.5 + 0.5 * n, ModeReport(PX4.hold_mode)) for n in range(22)]
IN_LANDING = [*HOLD_REPORTS[:10], *((5.9 + 0.5 * n, ModeReport(PX4.land_mode)) for n in range(3))]


@pytest.mark.parametrize(
    ("commands", "reports"),
    [
        # another mode between our request and its effect, which the vehicle has acknowledged
        *(([HOLD], [(s, ModeReport("POSCTL")), *HOLD_REPORTS]) for s in (0.01, 0.31, 3.1)),
        # hold that arrived before the request left, and was read after it
        ([HOLD], [(-0.01, ModeReport(PX4.hold_mode)), *HOLD_REPORTS]),
        # hold after the landing mode
        ([HOLD, LAND], [*IN_LANDING, *((6.92 + 0.1 * n, HOLD_REPORTS[0][1]) for n in range(51))]),
    ],
)
def test_unrequested_mode_ends_the_recovery(commands: list[int], reports: list[Timed]) -> None:
    """It is final whatever is reported afterwards."""
    beat = [(12.1, Heartbeat(reports[-1][1].mode, True, 4, 2))]  # type: ignore[attr-defined]
    done, ended = asked(PX4, ACCEPTED, *reports, *beat, shown=PX4.engage_mode)
    assert words(done) == commands
    assert ended.startswith("the vehicle shows ")


def test_setpoint_loss_failsafe_may_act_slightly_early() -> None:
    """The newest setpoint was sent before the controller's newest beat, and may have been lost."""
    loss = PX4.setpoint_loss({"COM_OF_LOSS_T": 1.0, "COM_OBL_RC_ACT": POSCTL})
    for at_s, end in ((0.6, "the vehicle shows POSCTL"), (0.8, DISARMED)):
        falls = [(at_s, Heartbeat("POSCTL", True, 5, 2)), *beats("POSCTL", 2.0, 2.0, armed=False)]
        known = replace(OURS, setpoint_loss=loss)
        _, ended = asked(PX4, *falls, shown=PX4.engage_mode, known=known)
        assert ended.startswith(end)


def test_failsafe_mode_after_hold_is_a_pilots_choice() -> None:
    """The controller has requested hold. HEARTBEAT shows another failsafe, such as an empty
    battery."""
    loss = PX4.setpoint_loss({"COM_OF_LOSS_T": 1.0, "COM_OBL_RC_ACT": POSCTL})
    switched = [(2.0 + n, Heartbeat("POSCTL", True, 5, 2)) for n in range(10)]
    known = replace(OURS, setpoint_loss=loss, holding=True)
    commands, ended = asked(PX4, *switched, shown=PX4.hold_mode, known=known)
    assert ended.startswith("the vehicle shows POSCTL")
    assert commands == []


def test_mode_change_while_disarming_is_not_a_pilots_choice() -> None:
    left = [(7.5, ModeReport(PX4.hold_mode)), *beats(PX4.hold_mode, 12.1, 12.1, armed=False)]
    commands, ended = asked(PX4, ACCEPTED, *IN_LANDING, *left, shown=PX4.engage_mode)
    assert (words(commands), ended) == ([HOLD, LAND], DISARMED)


def test_refused_command_is_reported() -> None:
    recovery = Recovery(PX4, OURS, 0.0)
    for result, said in (("ACCEPTED", []), ("DENIED", ["the vehicle answers DENIED"])):
        recovery.see(CommandAck(HOLD, result), 0.1)
        assert recovery.news == said


# -- against the failsafe for missing setpoints ----------------------------------------------------

POSCTL, RETURN, LANDS, LOITER = 0, 3, 4, 5  # COM_OBL_RC_ACT
STREAM_S = 1.5


@dataclass
class Recovered:
    """How a recovery ended, and its commands: time, number, height of the vehicle."""

    ended: str = ""
    armed: bool = True
    asked: list[tuple[float, int, float]] = field(default_factory=list)


def recovered(
    fallback: int,
    silent_s: float,
    arrives: Callable[[int], bool] = lambda command: True,
    pilot: tuple[float, str] = (math.inf, ""),
) -> Recovered:
    """Run a recovery of a PX4 that hovers at 4 m in OFFBOARD. The last setpoint is sent at 0 s, and
    the supervisor acts at `silent_s`. Its commands arrive if `arrives` returns True. `pilot` is the
    time and the mode of a pilot's switch."""
    start = scenario_of(start={"height_m": 4.0, "mode": "OFFBOARD"})
    vehicle, conditions = config.vehicle("px4_sih"), start.conditions
    instance = Instance(LEAN, vehicle, conditions, 3, ground_link=False, start=start.start)
    autopilot, commander = instance.autopilot, instance.autopilot.commander
    for name, value in {"COM_OBL_RC_ACT": fallback, **QUICK_LANDING}.items():
        autopilot.parameters.set(name, value)
    session, result = Session(SessionSettings()), Recovered()
    session.senders.set_vehicle(VEHICLE, "vehicle")
    instance.feed(session.encode(CommandLong.message_interval(436, 50.0)))  # CURRENT_MODE
    level = session.encode(AttitudeTarget(0.0, Command(9.81, (0.0, 0.0, 1.0), 0.0), 0.489, 9.81))
    loss = PX4.setpoint_loss({"COM_OF_LOSS_T": 1.0, "COM_OBL_RC_ACT": fallback})
    known = replace(OURS, reported_s=0.0, setpoint_loss=loss)
    recovery: Recovery | None = None
    for step in range(round(90.0 / STEP_S)):
        now_s = step * STEP_S - STREAM_S
        if now_s < 1e-9 and step % 25 == 0:
            instance.feed(level)
        if recovery is None and now_s >= silent_s:
            recovery = Recovery(PX4, known, now_s)
        if now_s >= pilot[0]:
            commander.switch(pilot[1])
            pilot = (math.inf, "")
        for datagram in instance.step():
            for event in session.receive(datagram, "vehicle", 100.0 + now_s).events:
                if recovery:
                    recovery.see(event, now_s)
        request = recovery.due(now_s) if recovery else None
        if request:
            command, height_m = request.command, -autopilot.state.truth.position_ned_m[2]
            result.asked.append((now_s, command, height_m))
            if arrives(command):
                instance.feed(session.encode(request))
        if recovery and recovery.end_reason:
            result.ended, result.armed = recovery.end_reason, commander.armed
            return result
    raise AssertionError(result)


@pytest.mark.parametrize(
    ("after_s", "fallback"),
    [(-0.4, POSCTL), (-0.004, POSCTL), (0.0, LOITER), (0.004, RETURN), (0.02, LANDS)],
)
def test_vehicle_is_landed_just_before_or_after_its_failsafe(after_s: float, fallback: int) -> None:
    """The supervisor acts `after_s` after the failsafe; by itself it acts 0.4 s before. Regression:
    it took the mode of the failsafe for a pilot's, and gave up."""
    loss = PX4.setpoint_loss({"COM_OF_LOSS_T": 1.0, "COM_OBL_RC_ACT": fallback})
    assert replace(OURS, setpoint_loss=loss).silent_s == pytest.approx(0.6)
    result = recovered(fallback, 1.0 + after_s)
    assert (result.ended, result.armed) == (DISARMED, False)


@pytest.mark.parametrize(("fallback", "silent_s"), [(POSCTL, 1.2), (LOITER, 0.6)])
def test_vehicle_in_its_failsafe_is_landed_unless_it_descends(
    fallback: int, silent_s: float
) -> None:
    """Every request to hold is lost. In POSCTL without sticks the vehicle sinks by itself."""
    result = recovered(fallback, silent_s, arrives=lambda command: command != HOLD)
    assert (result.ended, result.armed) == (DISARMED, False)
    landings_s = [at_s for at_s, command, height_m in result.asked
                  if command == LAND and height_m > 0.1]  # fmt: skip
    assert bool(landings_s) is (fallback == LOITER)
    assert all(5.0 < at_s < 7.5 for at_s in landings_s)


@pytest.mark.parametrize(("mode", "pilot_s"), [("POSCTL", 0.5), ("POSCTL", 3.0), ("ALTCTL", 1.3)])
def test_pilots_mode_is_final_before_and_in_the_failsafe(mode: str, pilot_s: float) -> None:
    """POSCTL is also the mode of the failsafe, but HEARTBEAT shows no failsafe once a pilot has
    chosen it. No command arrives."""
    result = recovered(POSCTL, 1.2, arrives=lambda command: False, pilot=(pilot_s, mode))
    assert result.ended == f"the vehicle shows {mode}: its pilot or its failsafe has it"
    assert all(at_s < max(pilot_s, 1.2) + 1.1 for at_s, _, _ in result.asked)
