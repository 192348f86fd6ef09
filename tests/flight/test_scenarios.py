"""Faults of a flight, one row each: title, fault, exit code, sentence, last phase, and checks.

In every row all setpoints are finite and valid, and none is sent after the end.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from typing import Any

import pytest
from faults import (
    ATTITUDE,
    EXTENDED_SYS_STATE,
    HEARTBEAT,
    PARAM_VALUE,
    POSITION,
    both,
    critical,
    die,
    downlink,
    failing,
    interrupted,
    jump,
    kill_motors,
    losing,
    no_direction,
    noisy,
    not_a_number,
    overturns,
    raises,
    refusing,
    restamped,
    restart,
    shuffling,
    slow,
    stop,
    take_over,
    upside_down,
    with_default,
    without,
)
from pair import Pair, calm_hover, decode, hover, in_phase, make
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from offboard.flight.phases import Phase

SET_MODE, LAND, ARM_DISARM = 176, 21, 400
FLOWN = "flown and landed"
Checks = Iterator[bool]


def lemniscate(**options: Any) -> Pair:
    """One lap, 1 m high, by a vehicle that hovers when its links open."""
    quick = ("reference.laps=1", "reference.height_m=1.0", "reference.period_s=6")
    return make(*quick, **{"aloft": True, **options})


def in_track(action: Callable[[Pair], None], flight: Callable[..., Pair] = lemniscate) -> Any:
    """The flight to which `action` happens one second into the track."""
    return lambda: flight(at=[(in_phase(Phase.TRACK, 1.0), action)])


# --- checks after the flight ---


def never_armed(pair: Pair) -> Checks:
    yield not pair.instance.autopilot.commander.armed
    yield not pair.went_through(Phase.TAKEOFF)


def nothing_sent(pair: Pair) -> Checks:
    yield not pair.setpoints
    yield not pair.commands(SET_MODE)
    yield not pair.commands(ARM_DISARM)


def says_what_it_waits_for(pair: Pair) -> Checks:
    yield from nothing_sent(pair)
    yield "waiting: no LOCAL_POSITION_NED arrives" in pair.companion.announced
    yield len([each for each in pair.companion.announced if each.startswith("waiting:")]) <= 3


def says_once_that_nothing_is_heard(pair: Pair) -> Checks:
    yield from nothing_sent(pair)
    yield pair.companion.announced[:-1] == ["waiting: nothing is heard on this link"]


def disarmed_by_us(pair: Pair) -> Checks:
    yield from never_armed(pair)
    yield pair.commands(ARM_DISARM)[-1].param1 == 0.0


def landed(pair: Pair) -> Checks:
    autopilot = pair.instance.autopilot
    yield not autopilot.commander.armed
    yield autopilot.position_controller.landed
    yield len(pair.commands(LAND)) >= 1


def flown(pair: Pair) -> Checks:
    yield from landed(pair)
    yield pair.went_through(Phase.TRACK)
    yield pair.went_through(Phase.HOVER)


def without_a_gap(pair: Pair) -> Checks:
    """From the first setpoint to the landing, also while phases change."""
    yield from flown(pair)
    times = [at_s for at_s, phase, _ in pair.setpoints if phase is not Phase.LAND]
    yield max(after - before for before, after in pairwise(times)) < 0.2


def soft_landing(pair: Pair) -> Checks:
    """Landed, and the setpoints after the fault were level ones."""
    yield from landed(pair)
    level = [setpoint for _, phase, setpoint in pair.setpoints if phase is Phase.LAND]
    yield len(level) >= 1
    yield all(abs(setpoint.q[1]) + abs(setpoint.q[2]) < 1e-6 for setpoint in level)


def taken_over_by_the_pilot(pair: Pair) -> Checks:
    autopilot = pair.instance.autopilot
    yield autopilot.commander.armed
    yield autopilot.commander.mode.name == "AUTO.LOITER"
    yield not pair.commands(LAND)


def landing_taken_over_by_the_pilot(pair: Pair) -> Checks:
    """No request or setpoint once the heartbeat, at 1 Hz, has shown the pilot's mode."""
    autopilot = pair.instance.autopilot
    yield autopilot.commander.armed
    yield autopilot.commander.mode.name == "AUTO.LOITER"
    (began_s,) = (at_s for at_s, phase in pair.phases if phase is Phase.LAND)
    frames = [(at_s, decode(frame)) for at_s, _, frame in pair.sent if at_s > began_s + 2.6]
    yield len(frames) > 10
    yield not any(m.get_type() in ("COMMAND_LONG", "SET_ATTITUDE_TARGET") for _, m in frames)


def held_then_silent(pair: Pair) -> Checks:
    """Level while the mode is known, landing requests, then nothing."""
    after = [(at_s - pair.heard_s, s) for at_s, _, s in pair.setpoints if at_s > pair.heard_s + 0.2]
    yield 15 <= len(after) <= 25
    yield after[-1][0] < 2.6
    yield all(abs(setpoint.q[1]) + abs(setpoint.q[2]) < 1e-6 for _, setpoint in after)
    yield len(pair.commands(LAND)) >= 1


def landing_requested(pair: Pair) -> Checks:
    """Level setpoints without telemetry; the first follows within 0.5 s. The vehicle lands."""
    yield not pair.instance.autopilot.commander.armed
    yield abs(pair.instance.autopilot.plant.height_m) < 0.05
    blind_s = pair.heard_s
    after = [(at_s, s) for at_s, _, s in pair.setpoints if at_s > blind_s + 0.2]
    yield len(after) >= 5 and after[0][0] < blind_s + 0.5
    yield all(abs(setpoint.q[1]) + abs(setpoint.q[2]) < 1e-6 for _, setpoint in after)


def smooth(pair: Pair) -> Checks:
    """After the jump the tilt stays within the law's own limit."""
    yield from flown(pair)
    yield max(math.hypot(s.q[1], s.q[2]) for _, _, s in pair.setpoints) < math.sin(0.5 * 0.7)


def continued_in_the_air(pair: Pair) -> Checks:
    yield from flown(pair)
    yield not pair.commands(ARM_DISARM)
    yield not pair.went_through(Phase.TAKEOFF)
    # never less thrust than flies: the vehicle was in the air all the time
    yield min(setpoint.thrust for _, _, setpoint in pair.setpoints) > 0.3


def bridged(pair: Pair) -> Checks:
    """Two missed decisions are bridged; the next good one resets their count."""
    yield from flown(pair)
    texts = [frame for _, _, frame in pair.sent if b"decision missed" in frame]
    yield len(texts) == 4
    missed_s = [at_s for at_s, _, frame in pair.sent if b"decision missed" in frame]
    bridges = [s for at_s, _, s in pair.setpoints if at_s in missed_s]
    yield len(bridges) == 4  # level, and not the setpoint before
    yield all(abs(s.q[1]) + abs(s.q[2]) < 1e-6 for s in bridges)


def stayed_down(pair: Pair) -> Checks:
    """Stopped before lift-off: disarmed at once, and no setpoint asks for more thrust."""
    yield not pair.instance.autopilot.commander.armed
    yield pair.commands(LAND) == []
    yield [each.param1 for each in pair.commands(ARM_DISARM)] == [1.0, 0.0]
    reached = [s.thrust for _, phase, s in pair.setpoints if phase is Phase.TAKEOFF][-1]
    yield 0.0 < reached < 0.3
    yield all(s.thrust == 0.0 for _, phase, s in pair.setpoints if phase is Phase.STAND_DOWN)
    began_s = next(at_s for at_s, phase in pair.phases if phase is Phase.STAND_DOWN)
    yield pair.time_s - began_s < 2.5


def landed_by_failsafe(pair: Pair) -> Checks:
    """After a refused landing the setpoints stop, so that the vehicle's failsafe acts."""
    yield pair.went_through(Phase.HOVER)
    yield 25 <= sum(phase is Phase.LAND for _, phase, _ in pair.setpoints) <= 32
    yield len(pair.commands(LAND)) > 3


@dataclass(frozen=True)
class Row:
    title: str
    flight: Callable[[], Pair]
    code: int
    says: str
    end: Phase
    checks: Callable[[Pair], Checks]


def already_flying() -> Pair:
    """A vehicle that hovers at 2.5 m before the flight begins."""
    pair = hover("reference.height_m=2.5")
    instance = pair.instance
    nan = math.nan
    while instance.time_s < 5.0:
        instance.step()
    pair.ground(22, 0, 0, 0, nan, nan, nan, instance.autopilot.firmware.origin[2] + 2.5)
    pair.ground(ARM_DISARM, 1)
    while instance.time_s < 17.0:
        instance.step()
    assert instance.autopilot.commander.mode.name == "AUTO.LOITER"
    assert not instance.autopilot.position_controller.landed
    return pair


def flown_by_another() -> Pair:
    """The same in OFFBOARD, with another companion's stream of level setpoints."""
    pair = already_flying()
    codec = mavlink.MAVLink(None, srcSystem=1, srcComponent=195)
    level = mavlink.MAVLink_set_attitude_target_message(0, 1, 1, 7, [1, 0, 0, 0], 0, 0, 0, 0.49)

    def streaming(_: float, datagrams: list[bytes]) -> list[bytes]:
        pair.instance.feed(level.pack(codec))
        return datagrams

    pair.down = streaming
    for second in range(300):
        streaming(0.0, [])
        if second == 150:
            pair.ground(SET_MODE, 1, 6)
        pair.instance.step()
    assert pair.instance.autopilot.commander.mode.name == "OFFBOARD"
    return pair


def already_armed_on_ground() -> Pair:
    return hover(at=[(in_phase(Phase.STREAM, 0.5), lambda pair: pair.ground(ARM_DISARM, 1))])


def silent_vehicle() -> Pair:
    return hover(dead=True, limits={"connect_s": 14.0})


def stopped(phase: Phase, for_s: float, end: Phase, checks: Callable[[Pair], Checks]) -> Row:
    flight = lambda: hover(at=[(in_phase(phase, for_s), stop)])  # noqa: E731
    code = 3 if end is Phase.FAILED else 4
    says = "stop requested by the operator"
    return Row(f"stop in {phase.value}", flight, code, says, end, checks)


TRACK = Phase.TRACK
ROWS = (
    Row("hover", calm_hover, 0, FLOWN, Phase.DISARMED, flown),
    Row("armed by another", already_armed_on_ground, 0, FLOWN, Phase.DISARMED, flown),
    Row(
        "flown by another",
        flown_by_another,
        3,
        "the vehicle is armed and in OFFBOARD already: another controller flies it",
        Phase.FAILED,
        lambda pair: iter([not pair.setpoints]),
    ),
    Row("found in the air", already_flying, 0, FLOWN, Phase.DISARMED, continued_in_the_air),
    # the operator
    Row(
        "stop before a vehicle is heard",
        lambda: hover(dead=True, at=[(in_phase(Phase.CONNECT, 0.5), stop)]),
        3,
        "stop requested by the operator",
        Phase.FAILED,
        nothing_sent,
    ),
    stopped(Phase.HEALTH, 1.0, Phase.FAILED, nothing_sent),
    stopped(Phase.STREAM, 0.5, Phase.FAILED, never_armed),
    stopped(Phase.ENGAGE, 0.0, Phase.FAILED, never_armed),
    stopped(Phase.ARM, 0.0, Phase.FAILED, disarmed_by_us),
    stopped(Phase.ARM, 0.3, Phase.FAILED, disarmed_by_us),
    Row(
        "stop in arm, and it cannot be disarmed",
        lambda: hover(
            firmware=refusing("disarm", "Disarming denied"),
            at=[(in_phase(Phase.ARM, 0.3), stop)],
        ),
        4,
        "stop requested by the operator; still armed after 5 s",
        Phase.FAILED,
        lambda pair: iter([pair.instance.autopilot.commander.armed]),
    ),
    stopped(Phase.TAKEOFF, 0.3, Phase.FAILED, stayed_down),
    # its land detector reports flight before it lifts off
    stopped(Phase.TAKEOFF, 0.5, Phase.DISARMED, landed),
    stopped(Phase.TAKEOFF, 1.5, Phase.DISARMED, landed),
    stopped(Phase.CLIMB, 0.5, Phase.DISARMED, landed),
    stopped(Phase.TRACK, 1.0, Phase.DISARMED, landed),
    stopped(Phase.HOVER, 0.2, Phase.DISARMED, landed),
    # the vehicle refuses or is not there
    Row(
        "no vehicle",
        silent_vehicle,
        3,
        "no vehicle heard in 14 s",
        Phase.FAILED,
        says_once_that_nothing_is_heard,
    ),
    Row(
        "the land detector is not heard",
        lambda: hover(down=without(EXTENDED_SYS_STATE), limits={"health_s": 5.0}),
        3,
        "not ready: it does not report whether it flies (EXTENDED_SYS_STATE)",
        Phase.FAILED,
        nothing_sent,
    ),
    Row(
        "it receives nothing any more",
        lambda: hover(
            at=[(in_phase(Phase.HEALTH, 0.2), lambda pair: setattr(pair, "up", lambda *_: []))],
            limits={"health_s": 5.0},
        ),
        3,
        "not ready: TIMESYNC is not answered for 5 s: does the vehicle receive what is sent?",
        Phase.FAILED,
        nothing_sent,
    ),
    Row(
        "no HEARTBEAT on the ground",
        lambda: hover(
            at=[(in_phase(Phase.HEALTH, 0.2), downlink(without(HEARTBEAT)))],
            limits={"health_s": 9.0},
            boot_scale=1.0,
        ),
        3,
        "not ready: no HEARTBEAT arrives",
        Phase.FAILED,
        nothing_sent,
    ),
    Row(
        "no HEARTBEAT from the request for the mode on",
        lambda: hover(at=[(in_phase(Phase.ENGAGE), downlink(without(HEARTBEAT)))]),
        4,
        "it is not known whether the vehicle has armed; "
        "no HEARTBEAT shows whether it is armed after 5 s",
        Phase.FAILED,
        disarmed_by_us,
    ),
    Row(
        "arming refused",
        lambda: hover(firmware=refusing("arm", "Arming denied: no joystick")),
        3,
        "the vehicle did not arm in 15 s; the vehicle said: command 400 TEMPORARILY_REJECTED; "
        "unhealthy by SYS_STATUS: RC_RECEIVER (PX4 says why to ground stations alone: see "
        "QGroundControl)",
        Phase.FAILED,
        never_armed,
    ),
    Row(
        "mode refused",
        lambda: hover(
            firmware=refusing("mode", "Switching to Offboard is not available"),
        ),
        3,
        "the vehicle did not enter OFFBOARD in 10 s (it shows AUTO.LOITER); "
        "the vehicle said: command 176 TEMPORARILY_REJECTED; unhealthy by SYS_STATUS: RC_",
        Phase.FAILED,
        never_armed,
    ),
    Row(
        "parameter wrong",
        # said before the vehicle has a position
        lambda: hover(firmware=with_default("COM_OF_LOSS_T", 30.0), down=without(POSITION)),
        3,
        "COM_OF_LOSS_T is 30: seconds without setpoints before the failsafe. "
        "Fix: param set COM_OF_LOSS_T 1",
        Phase.FAILED,
        nothing_sent,
    ),
    Row(
        "parameters not answered",
        lambda: hover(down=without(PARAM_VALUE)),
        0,
        FLOWN,
        Phase.DISARMED,
        flown,
    ),
    Row(
        "no position",
        lambda: hover(down=without(POSITION), limits={"health_s": 8}),
        3,
        "not ready: no LOCAL_POSITION_NED arrives",
        Phase.FAILED,
        says_what_it_waits_for,
    ),
    Row(
        "telemetry too slow",
        lambda: hover(firmware=slow(4.0), limits={"health_s": 8}),
        3,
        "not ready: ATTITUDE_QUATERNION arrives at 4.0 Hz, at least 10 Hz are needed",
        Phase.FAILED,
        nothing_sent,
    ),
    Row(
        "restart on the ground",
        lambda: hover(at=[(in_phase(Phase.STREAM, 0.5), restart)]),
        3,
        "the vehicle restarted",
        Phase.FAILED,
        never_armed,
    ),
    Row(
        "restart while waiting for health",
        lambda: hover(at=[(in_phase(Phase.HEALTH, 3.0), restart)]),
        0,
        FLOWN,
        Phase.DISARMED,
        flown,
    ),
    Row(
        "landing refused",
        lambda: hover(firmware=refusing("land", "No.")),
        4,
        "the vehicle's own failsafe flew it, in POSCTL; the vehicle said: ",
        Phase.DISARMED,
        landed_by_failsafe,
    ),
    # the pilot
    Row(
        "pilot takes over the landing while a failsafe shows",
        lambda: hover(
            "reference.height_m=3.0",
            limits={"land_s": 20.0},
            at=[
                (in_phase(Phase.HOVER, 0.2), downlink(critical())),
                (in_phase(Phase.LAND, 1.5), take_over),
            ],
        ),
        4,
        "not landed and disarmed after 20 s",
        Phase.FAILED,
        landing_taken_over_by_the_pilot,
    ),
    Row(
        "pilot takes over as it arms",
        lambda: hover(at=[(in_phase(Phase.ARM), take_over)]),
        4,
        "the vehicle left OFFBOARD for AUTO.LOITER as it armed",
        Phase.YIELDED,
        taken_over_by_the_pilot,
    ),
    Row(
        "pilot takes over while landing",
        lambda: hover(at=[(in_phase(Phase.LAND, 1.2), take_over)]),
        4,
        "the vehicle left AUTO.LAND for AUTO.LOITER",
        Phase.YIELDED,
        lambda pair: iter([pair.instance.autopilot.commander.mode.name == "AUTO.LOITER"]),
    ),
    Row(
        "motors cut in flight",
        in_track(kill_motors),
        4,
        "the vehicle disarmed in flight",
        Phase.DISARMED,
        lambda pair: iter([not pair.instance.autopilot.commander.armed]),
    ),
    # the link
    Row("20 Hz", lambda: lemniscate(firmware=slow(20.0)), 0, FLOWN, Phase.DISARMED, flown),
    Row(
        "a fifth is lost, both ways",
        lambda: lemniscate(down=losing(0.2), up=losing(0.2, seed=4)),
        0,
        FLOWN,
        Phase.DISARMED,
        without_a_gap,
    ),
    Row(
        "duplicated, reordered, some 2.5 s late, with garbage between",
        lambda: lemniscate(down=both(shuffling(), noisy)),
        0,
        FLOWN,
        Phase.DISARMED,
        flown,
    ),
    Row(
        "dies in flight",
        in_track(die),
        4,
        "not heard for 300 s while landing; last known: armed in OFFBOARD, ",
        Phase.FAILED,
        held_then_silent,
    ),
    Row(
        "restart in flight",
        in_track(restart, partial(lemniscate, aloft=False)),
        4,
        "the vehicle restarted in flight",
        Phase.DISARMED,
        lambda pair: iter([not pair.instance.autopilot.commander.armed]),
    ),
    Row(
        "restart in flight of a vehicle that stays armed",
        in_track(downlink(restamped(10.0))),
        4,
        "the vehicle restarted in flight",
        Phase.DISARMED,
        soft_landing,
    ),
    Row(
        "position and attitude stop, heartbeats go on",
        in_track(downlink(without(POSITION, ATTITUDE))),
        4,
        "no telemetry for 1.0 s; disarmed, landing not confirmed: ",
        Phase.FAILED,
        landing_requested,
    ),
    Row(
        "position stops",
        in_track(downlink(without(POSITION))),
        4,
        "disarmed, landing not confirmed: no LOCAL_POSITION_NED shows it",
        Phase.FAILED,
        soft_landing,
    ),
    Row(
        "attitude stops",
        in_track(downlink(without(ATTITUDE))),
        4,
        "no new ATTITUDE_QUATERNION for 0.",
        Phase.DISARMED,
        soft_landing,
    ),
    Row(
        "everything stops for 0.8 s",
        in_track(downlink(interrupted(0.8))),
        0,
        FLOWN,
        Phase.DISARMED,
        flown,
    ),
    # the estimate
    Row("a jump of 1 m", in_track(jump(1.0)), 0, FLOWN, Phase.DISARMED, smooth),
    Row(
        "a jump of 9 m",
        in_track(jump(9.0)),
        4,
        "the estimated position jumped by 9.0 m",
        Phase.DISARMED,
        landed,
    ),
    Row(
        "upside down",
        in_track(downlink(upside_down())),
        4,
        "tilt 180 deg",
        Phase.DISARMED,
        soft_landing,
    ),
    # the law
    *(
        Row(
            f"a law that {fail.__name__.replace('_', ' ')}",
            lambda fail=fail: lemniscate(wrap=failing(fail)),
            4,
            f"the controller failed: {says}",
            Phase.DISARMED,
            soft_landing,
        )
        for fail, says in (
            (raises, "ZeroDivisionError: nothing to divide by"),
            (not_a_number, "unusable Command(thrust_mps2=nan"),
            (no_direction, "unusable Command"),
        )
    ),
    Row(
        "a law that fails twice, and twice more",
        lambda: lemniscate(wrap=lambda law: failing(raises, 2, 34)(failing(raises, 2, 30)(law))),
        0,
        FLOWN,
        Phase.DISARMED,
        bridged,
    ),
    Row(
        "a law that overturns for a moment",
        lambda: lemniscate(wrap=failing(overturns, times=1)),
        0,
        FLOWN,
        Phase.DISARMED,
        flown,
    ),
)


@pytest.mark.parametrize("row", ROWS, ids=lambda row: row.title)
def test_flight(row: Row) -> None:
    pair = row.flight()
    outcome = pair.fly()
    assert outcome.exit_code == row.code, outcome
    assert row.says in outcome.sentence
    assert pair.companion.phase is row.end
    for index, check in enumerate(row.checks(pair)):
        assert check, f"check {index} of {row.checks.__name__} ({pair.phases})"
    for _, phase, setpoint in pair.setpoints:
        assert phase not in (Phase.YIELDED, Phase.FAILED, Phase.DISARMED)
        assert all(math.isfinite(value) for value in (*setpoint.q, setpoint.thrust))
        assert 0.0 <= setpoint.thrust <= 1.0
        assert setpoint.type_mask == 7
