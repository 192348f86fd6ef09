"""Faults in flight, one row each: exit code, last phase, sentence, checks, and the fault.

`watch.flown` also checks what must hold in every flight.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from itertools import pairwise
from typing import Any

import faults
import pytest
from pair import LEAN_COPTER, Filter, Pair, frame_id, frames_of
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from watch import (
    HIGH,
    Check,
    Row,
    aborts,
    announced,
    begun_s,
    copter,
    early,
    ends,
    flies,
    judged,
    landed,
    px4,
    refusal,
    said,
    scenario_of,
    sent_after,
    then,
    tracking,
)

from offboard.analysis.score_table import summary
from offboard.flight.phases import TRACKING, Phase
from offboard.mavlink.events import Heartbeat
from simulator import config
from simulator.autopilot.firmware import Rule
from simulator.autopilot.values import Result, Severity, StatusText
from simulator.firmware.ardupilot import ARDUPILOT

TAKEOFF = 22  # MAV_CMD
SYS_STATUS, ESTIMATOR_STATUS = 1, 230
LOW_BATTERY = scenario_of({"fault": "battery_drop", "remaining": 0.5})
STILL_ARMED = "it has stood still for 15 s and is armed: its land detector reports that it flies"
CLOCK_SET_BACK = {"fault": "clock_jump", "jump_s": -3, "after": "landing", "at_s": 0.5}


def flown_by_external_vision(gps: bool = False) -> Filter:
    """Return a filter that makes a PX4 report no use of GPS (unless `gps`), and pre-arm checks that
    pass in OFFBOARD only: AUTO.LOITER needs a global position."""
    modes = [0]

    def change(message: Any) -> None:
        if message.get_msgId() == faults.HEARTBEAT:
            modes[0] = message.custom_mode
        elif message.get_msgId() == ESTIMATOR_STATUS:
            message.flags &= ~0 if gps else ~512
        elif modes[0] != 6 << 16:
            message.onboard_control_sensors_health &= ~0x10000000

    return faults.rewritten(change, faults.HEARTBEAT, SYS_STATUS, ESTIMATOR_STATUS)


def late_both_ways(pair: Pair) -> None:
    pair.down, pair.up = faults.late(4.0), faults.late(4.0)


def in_turn(*acts: Callable[[Pair], object]) -> Callable[[Pair], None]:
    def change(pair: Pair) -> None:
        for act in acts:
            act(pair)

    return change


def never_disarms(pair: Pair) -> None:
    pair.instance.autopilot.parameters.set("COM_DISARM_LAND", -1.0)


def loses_commands(for_s: float) -> Callable[[Pair], None]:
    return faults.cut(for_s, mavlink.MAVLINK_MSG_ID_COMMAND_LONG, ways=["up"])


# --- checks after the flight ---


def nothing_sent(pair: Pair) -> None:
    assert pair.setpoints == pair.modes == pair.armings == []


def says_once_that_nothing_is_heard(pair: Pair) -> None:
    nothing_sent(pair)
    waits = "waiting: nothing is heard on this link"
    assert list(announced(pair))[:-1] == [waits]
    assert pair.history().events()[0].what == waits


def says_each_change_once(pair: Pair) -> None:
    said = [each for each in announced(pair) if "COM_OF_LOSS_T" in each]
    assert said == [f"COM_OF_LOSS_T was changed from {a}" for a in ("1 to 2", "2 to 1")]


def names_the_key_soon(pair: Pair) -> None:
    nothing_sent(pair)
    assert any("their signature does not match" in said for said in announced(pair)[:-1])


def on_the_ground(pair: Pair) -> None:
    assert not pair.went_through(Phase.TAKEOFF)


def disarmed_by_us(pair: Pair) -> None:
    on_the_ground(pair)
    assert pair.armings[-1] == 0.0


def asked_to_disarm(pair: Pair) -> None:
    assert set(pair.armings) == {1.0, 0.0}


def stayed_down(pair: Pair) -> None:
    """After a stop before lift-off, the vehicle is disarmed at once without more thrust."""
    assert pair.armings == [1.0, 0.0]
    reached = [s.thrust for _, phase, s in pair.setpoints if phase is Phase.TAKEOFF][-1]
    assert 0.0 < reached < 0.3
    assert all(s.thrust == 0.0 for _, phase, s in pair.setpoints if phase is Phase.STAND_DOWN)
    assert pair.time_s - begun_s(pair, Phase.STAND_DOWN) < 2.5


def whole(pair: Pair) -> None:
    landed(pair)
    assert pair.went_through(Phase.TRACK)
    assert pair.went_through(Phase.HOVER)


def without_a_gap(pair: Pair) -> None:
    """No gap of setpoints from the first one to the landing, also while phases change."""
    whole(pair)
    times = [at_s for at_s, phase, _ in pair.setpoints if phase is not Phase.LAND]
    assert max(after - before for before, after in pairwise(times)) < 0.2


def level(setpoints: list[Any]) -> bool:
    return all(abs(setpoint.q[1]) + abs(setpoint.q[2]) < 1e-6 for setpoint in setpoints)


def unheard(pair: Pair) -> list[float]:
    """Return the times of the setpoints after the newest telemetry, in s since then. They must be
    level and have hover thrust."""
    late = [(at_s - pair.heard_s, s) for at_s, _, s in pair.setpoints if at_s > pair.heard_s + 0.2]
    assert level([setpoint for _, setpoint in late])
    hover_thrust = pair.companion.model.hover_thrust
    assert all(abs(setpoint.thrust - hover_thrust) < 0.02 for _, setpoint in late)
    return [since_s for since_s, _ in late]


def soft_landing(pair: Pair) -> None:
    """The vehicle has landed, and the setpoints in LAND were level."""
    landed(pair)
    after = [setpoint for _, phase, setpoint in pair.setpoints if phase is Phase.LAND]
    assert after
    assert level(after)


def not_completed(pair: Pair) -> None:
    assert pair.score().completed == 0.0


def held_then_silent(pair: Pair) -> None:
    """Level setpoints while the mode is known, requests to land, then nothing."""
    after_s = unheard(pair)
    assert 15 <= len(after_s) <= 25
    assert after_s[-1] < 2.6
    assert pair.landings


def landing_requested(pair: Pair) -> None:
    """Without telemetry, level setpoints begin within 0.5 s. The vehicle lands."""
    assert abs(pair.instance.autopilot.plant.height_m) < 0.05
    after_s = unheard(pair)
    assert len(after_s) >= 5
    assert after_s[0] < 0.5


def landed_by_its_failsafe(pair: Pair) -> None:
    """After refused requests to land the setpoints stop, so that the vehicle's failsafe acts."""
    assert pair.went_through(Phase.HOVER)
    assert 45 <= sum(phase is Phase.LAND for _, phase, _ in pair.setpoints) <= 52
    assert len(pair.landings) > 3


def keeps_loiter(pair: Pair) -> None:
    assert pair.mode == "AUTO.LOITER"


def silent_after_the_pilot(pair: Pair) -> None:
    """Nothing is requested, and no setpoint sent, once a HEARTBEAT (1 Hz) has shown the pilot's
    mode."""
    keeps_loiter(pair)
    since_s = begun_s(pair, Phase.LAND) + 2.6
    assert sum(at_s > since_s for at_s, _, _ in pair.sent) > 10
    assert sent_after(pair, since_s) == []


def bridged(pair: Pair) -> None:
    """Level setpoints take the place of two missed decisions; the next good decision resets the
    count."""
    whole(pair)
    texts = (b"decision missed", b"decision failed")
    missed_s = [at_s for at_s, _, frame in pair.sent if any(text in frame for text in texts)]
    bridges = [s for at_s, _, s in pair.setpoints if at_s in missed_s]
    assert len(missed_s) == len(bridges) == 4
    assert level(bridges)
    scored = pair.score()
    assert (scored.failed_decisions, scored.refused_unusable, scored.missed_ticks) == (2, 2, 0)
    timing = summary(scored, pair.history())["timing"]
    assert timing.endswith(f", 4 of {scored.decisions + 2:.0f} ticks missed")


def took_off_by_command(pair: Pair) -> None:
    """ArduCopter takes off in GUIDED by one command to 1.5 m, without setpoints."""
    whole(pair)
    assert {(m.param1, m.param2) for m in pair.modes} == {(1.0, 4)}
    assert said(pair, "GUIDED needs no setpoints beforehand")
    (takeoff,) = pair.commands(TAKEOFF)
    assert takeoff.param7 == pytest.approx(1.5)
    assert all(phase in TRACKING | {Phase.LAND} for _, phase, _ in pair.setpoints)
    assert pair.setpoints[0][0] == pytest.approx(begun_s(pair, Phase.CLIMB), abs=0.11)


def stayed_down_without_a_setpoint(pair: Pair) -> None:
    assert len(pair.commands(TAKEOFF)) >= 8
    assert pair.setpoints == []


def asks_again(pair: Pair) -> None:
    assert said(pair, "waiting for the link for at most 300 s; landing is asked again once")


def asks_each_second(pair: Pair) -> None:
    """Requests to land that are lost are repeated each second; an accepted one is not repeated."""
    assert len(pair.landings) == 4


def asks_every_three_seconds(pair: Pair) -> None:
    """An accepted request to land that has no effect is repeated."""
    assert len(pair.landings) == 5


def asks_once(pair: Pair) -> None:
    assert not said(pair, "waiting for the link")


def waits_for_position_and_delay(pair: Pair) -> None:
    waiting = [each for each in pair.companion.announced if each.startswith("waiting: ")]
    assert waiting == [
        "waiting: no LOCAL_POSITION_NED arrives", "waiting: the delay of the link is being measured"
    ]  # fmt: skip


def not_asked_again(pair: Pair) -> None:
    assert len(pair.landings) == 1
    assert pair.mode == "LOITER"


def keeps_posctl(pair: Pair) -> None:
    assert pair.mode == "POSCTL"
    assert sent_after(pair, pair.phases[-1][0]) == []


def listens(pair: Pair) -> None:
    """Nothing is sent from 2.5 s without a report of the mode until the next report. Then a landing
    is requested, unless a pilot has taken the vehicle."""
    lost_s = begun_s(pair, Phase.TRACK) + 1.0
    assert sent_after(pair, lost_s + 2.6) == sent_after(pair, lost_s + 8.99)
    assert bool(pair.landings) is not pair.armed


def held_soon(pair: Pair) -> None:
    assert begun_s(pair, Phase.HOLD) - begun_s(pair, Phase.TRACK) < 2.8


def thinned(rate_hz: float, loss: float = 0.0, at_s: float = 5.0) -> Any:
    """Return a scenario in which each message arrives at this rate, from `at_s` after engaging."""
    slow = {"fault": "link", "direction": "down", "message_rate_hz": rate_hz, "loss": loss}
    return scenario_of({**slow, "jitter_s": 0.02, "after": "engaged", "at_s": at_s})


def asked_to_disarm_without_force(pair: Pair) -> None:
    assert [(m.param1, m.param2) for m in pair.commands(400)] == [(0.0, 0.0)]
    assert said(pair, "15 s without motion on the ground, and the vehicle does not disarm")


def disarmed_by_itself(pair: Pair) -> None:
    """The vehicle disarms by itself soon after it was asked to land, and need not be disarmed."""
    assert pair.armings[1:] == []
    assert not said(pair, "15 s")


def left_to_the_user(pair: Pair) -> None:
    assert said(pair, STILL_ARMED)
    assert pair.armings == []


# --- the rows ---


def arm(pair: Pair) -> None:
    pair.ground(400, 1)


def engage(pair: Pair) -> None:
    """Let the pilot select OFFBOARD."""
    pair.ground(176, 1, 6)


def silent(*message_ids: int) -> Callable[[Pair], object]:
    return faults.downlink(faults.without(*message_ids))


def deafen(pair: Pair) -> None:
    pair.up = lambda *_: []


def stop_unheard(pair: Pair) -> None:
    faults.stop(pair)
    pair.up = pair.down = lambda *_: []


def of_type(kind: int, says: str, checks: Check = nothing_sent, **options: Any) -> Row:
    return refusal(says, checks, down=faults.heartbeats(type=kind), **options)


def switches(mode: str) -> Callable[[Pair], object]:
    """Let a pilot switch the vehicle to `mode`."""
    return lambda pair: pair.instance.autopilot.commander.switch(mode)


def begins_to_arrive(kind: int, at_s: float) -> Filter:
    rest = faults.without(kind)
    return lambda time_s, datagrams: datagrams if time_s >= at_s else rest(time_s, datagrams)


def late_positions() -> Filter:
    """Return a filter that delays positions by 0.2 s, more than the observer permits."""
    late = faults.delivering(lambda _, frame: [0.2 * (frame_id(frame) == faults.POSITION)])
    return lambda time_s, datagrams: late(
        time_s, [frame for datagram in datagrams for frame in frames_of(datagram)]
    )


def lose_two_heartbeats(pair: Pair) -> None:
    """Lose two HEARTBEATs after the next one, and from now on every CURRENT_MODE."""
    pair.down = faults.without(faults.CURRENT_MODE)
    pair.at.append((just_after_a_beat, faults.cut(2.2, faults.HEARTBEAT, ways=["down"])))


def just_after_a_beat(pair: Pair) -> bool:
    return pair.companion.phase is Phase.TRACK and pair.companion.vehicle.age_s(Heartbeat) == 0.0


def hover_without_disarming() -> Pair:
    pair = px4.hover()
    pair.instance.autopilot.parameters.set("COM_DISARM_LAND", 0.0)
    return pair


def signed_by_another() -> Pair:
    pair = px4.hop(key=bytes(32))
    pair.instance.keyring.set_up(bytes(range(32)), 1)
    return pair


def set_parameter(pair: Pair) -> None:
    codec = mavlink.MAVLink(None, srcSystem=255, srcComponent=190)
    for value in (2.0, 2.0, 1.0, 2.0, 1.0):
        message = mavlink.MAVLink_param_set_message(1, 1, b"COM_OF_LOSS_T", value, 9)
        pair.instance.feed(message.pack(codec))


def report_no_gps(pair: Pair) -> None:
    pair.instance.autopilot.commander.texts.append(StatusText(Severity.CRITICAL, "No GPS"))


STOPPED = "stop requested by the operator"
BOOTING = faults.heartbeats(system_status=1, base_mode=81, custom_mode=0)  # disarmed, STABILIZE
BOOTING_ARMED = faults.heartbeats(system_status=1, base_mode=209, custom_mode=0)
HELICOPTER = config.vehicle("px4_sih").model_copy(update={"airframe": "helicopter"})
HEALTH_IN_5_S, HEALTH_IN_8_S = {"health_s": 5.0}, {"health_s": 8.0}
NO_TAKEOFF = Rule("takeoff", result=Result.FAILED)
NO_ORIGIN = Rule(
    "arm", result=Result.FAILED,
    texts=(StatusText(Severity.CRITICAL, "Arm: AHRS: waiting for home"),),
)  # fmt: skip
LONG = (HIGH, "reference.duration_s=6.0")
PX4_HOVERS, COPTER_HOVERS = partial(px4.hover, *LONG), partial(copter.hover, *LONG)
LOITERS = faults.with_default("COM_OBL_RC_ACT", 5.0)  # without setpoints AUTO.LOITER, not POSCTL
SILENT = r"no telemetry for 1.0 s \(limits.silence_s is 1\)$"  # does not mention a pilot
MODES = (faults.HEARTBEAT, faults.CURRENT_MODE)
REJECTED = r"; the vehicle said: command {} TEMPORARILY_REJECTED; unhealthy by SYS_STATUS: RC_"
ROWS = {
    "armed by another": flies(whole, at=then(Phase.STREAM, 0.5, arm)),
    # the operator
    "stop while arming, and the vehicle cannot be disarmed": aborts(
        Phase.FAILED, f"{STOPPED}; still armed after 5 s", armed=True,
        firmware=faults.refusing("disarm", "Disarming denied"),
        at=then(Phase.ARM, 0.3, faults.stop),
    ),
    "stop before lift-off": refusal(STOPPED, stayed_down, at=then(Phase.TAKEOFF, 0.3, faults.stop)),
    "stop before lift-off, and the vehicle falls silent": aborts(
        Phase.FAILED,
        f"{STOPPED} before lift-off; no HEARTBEAT shows whether it is armed after 5 s",
        asked_to_disarm, armed=True, at=then(Phase.TAKEOFF, 0.3, stop_unheard),
    ),
    # the land detector reports flight before the vehicle lifts off
    "stop at lift-off": ends(STOPPED, landed, at=then(Phase.TAKEOFF, 0.5, faults.stop)),
    "stop after the pilot has engaged, before our mode request": ends(
        STOPPED, landed, fly=px4.hover, ended_by="operator",
        at=[
            *then(Phase.STREAM, 0.2, engage),
            (lambda pair: pair.companion.in_engage_mode, faults.stop),
        ],
    ),
    # the vehicle refuses or is not there
    "no vehicle": refusal(
        "no vehicle heard in 14 s", says_once_that_nothing_is_heard,
        dead=True, limits={"connect_s": 14.0},
    ),
    "PX4 by external vision, whose pre-arm checks pass only in OFFBOARD": flies(
        whole, down=flown_by_external_vision()
    ),
    "pre-arm checks of a PX4 by GPS do not pass": refusal(
        "not ready: its pre-arm checks do not pass in AUTO.LOITER", nothing_sent,
        down=flown_by_external_vision(gps=True), limits={"health_s": 15.0},
    ),
    "PX4 by external vision with an empty battery": refusal(
        "not ready: its pre-arm checks do not pass", nothing_sent, down=flown_by_external_vision(),
        limits={"health_s": 15.0, "battery": 0.9}, scenario=LOW_BATTERY,
    ),
    "the land detector is not heard": refusal(
        r"not ready: it does not report whether it flies \(EXTENDED_SYS_STATE\)", nothing_sent,
        down=faults.without(faults.EXTENDED_SYS_STATE), limits=HEALTH_IN_5_S,
    ),
    "positions arrive 0.2 s later than attitudes": refusal(
        "not ready: no LOCAL_POSITION_NED arrives except repeated or over 0.1 s late", nothing_sent,
        down=late_positions(), limits=HEALTH_IN_5_S,
    ),
    "positions begin to arrive 0.2 s later than attitudes": aborts(
        Phase.FAILED, "no new LOCAL_POSITION_NED for 0.[56] s", fly=px4.hover, failsafes=["blind"],
        at=tracking(faults.downlink(late_positions())),
    ),
    "the vehicle receives nothing": refusal(
        "not ready: no TIMESYNC request was answered for 5 s: does the vehicle receive them?",
        nothing_sent, at=then(Phase.HEALTH, 0.2, deafen), limits=HEALTH_IN_5_S,
    ),
    "no HEARTBEAT since the mode request": aborts(
        Phase.FAILED,
        ".*it is not known whether the vehicle has armed; "
        "no HEARTBEAT shows whether it is armed after 5 s",
        disarmed_by_us, at=then(Phase.ENGAGE, 0.0, silent(faults.HEARTBEAT)),
    ),
    "arming refused": refusal(
        "the vehicle did not arm in 15 s" + REJECTED.format(400), on_the_ground, asked_to_disarm,
        firmware=faults.refusing("arm", "Arming denied: no joystick"),
    ),
    "arming refused without GPS and origin": refusal(
        "the vehicle did not arm in 15 s; the vehicle said: Arm: AHRS: waiting for home. "
        "Fix: wait for a GPS fix, or without GPS set the origin", on_the_ground,
        fly=copter.hop, firmware=replace(ARDUPILOT, rules=(NO_ORIGIN, *ARDUPILOT.rules)),
    ),
    "mode refused": refusal(
        r"the vehicle did not enter OFFBOARD in 10 s \(it shows AUTO.LOITER\)"
        + REJECTED.format(176), on_the_ground,
        firmware=faults.refusing("mode", "Switching to Offboard is not available"),
    ),
    "wrong parameter": refusal(  # reported before the vehicle has a position
        "COM_OF_LOSS_T is 30: seconds without setpoints before the failsafe. "
        "Fix: param set COM_OF_LOSS_T 1",
        nothing_sent, firmware=faults.with_default("COM_OF_LOSS_T", 30.0),
        down=faults.without(faults.POSITION),
    ),
    "no reply for GUID_OPTIONS, which may say that thrust is a climb rate": refusal(
        "not ready: no reply for parameter GUID_OPTIONS", nothing_sent, fly=copter.hop,
        down=faults.without(faults.PARAM_VALUE), limits=HEALTH_IN_8_S,
    ),
    # the MAV_TYPE in HEARTBEAT decides which vehicles are flown
    "a plane": of_type(1, "the vehicle is a FIXED_WING; offboard flies multirotors"),
    "a standard VTOL": of_type(22, "the vehicle is a VTOL; offboard flies multirotors"),
    "a helicopter": of_type(4, r".*\(airframe: helicopter in its vehicle file flies it\)"),
    "a hexarotor that is no helicopter": of_type(
        13, "the vehicle is a HEXAROTOR; its vehicle file says .*Fix: check .* and airframe in",
        believed=HELICOPTER,
    ),
    "a helicopter by its file": of_type(
        4, STOPPED, on_the_ground, believed=HELICOPTER, at=then(Phase.STREAM, 0.1, faults.stop)
    ),
    "a signed link with another key": refusal(
        ".*their signature does not match: it is another key's", names_the_key_soon,
        fly=signed_by_another,
    ),
    "no position, and the vehicle says why": refusal(
        "not ready: no LOCAL_POSITION_NED arrives; the vehicle said: No GPS .limits", nothing_sent,
        fly=copter.hop, down=faults.without(faults.POSITION), limits=HEALTH_IN_5_S,
        at=then(Phase.HEALTH, 2.0, report_no_gps),
    ),
    "restart on the ground": refusal(
        "the vehicle restarted", on_the_ground, at=then(Phase.STREAM, 0.5, faults.restart)
    ),
    "landing refused": ends(
        "the vehicle's own failsafe flew it, in POSCTL; the vehicle said: ",
        landed_by_its_failsafe, ended_by="link", firmware=faults.refusing("land", "No."),
    ),
    "landing accepted without effect": aborts(
        Phase.FAILED, "not landed and disarmed after 15 s", asks_every_three_seconds, armed=True,
        fly=copter.hover, limits={"land_s": 15.0},
        firmware=replace(LEAN_COPTER, rules=(Rule("land"), *LEAN_COPTER.rules)),
    ),
    "on the ground by its land detector, the vehicle does not disarm": flies(
        asked_to_disarm_without_force, fly=hover_without_disarming
    ),
    # only the land detector shows whether it flies: it is not disarmed, and the user is told
    "the land detector never reports the ground": aborts(
        Phase.FAILED, f".*not landed and disarmed after 24 s; {STILL_ARMED}", left_to_the_user,
        fly=copter.hover, armed=True, scenario="never_landed", limits={"land_s": 24.0},
    ),
    # PX4 returns to OFFBOARD, which CURRENT_MODE shows before HEARTBEAT shows it disarmed
    "PX4 leaves the landing mode as it disarms": flies(
        fly=partial(px4.hover, "reference.duration_s=3.3")
    ),
    "ground stations set a parameter in flight, in turn": flies(
        says_each_change_once, fly=px4.hover, at=tracking(set_parameter),
    ),
    "takeoff by command": flies(took_off_by_command, fly=copter.hop),
    "takeoff refused": ends(
        ".*no lift-off in 8 s by the .* is MOT_THST_HOVER right", stayed_down_without_a_setpoint,
        fly=copter.hop,
        firmware=replace(ARDUPILOT, rules=(NO_TAKEOFF, *ARDUPILOT.rules)),
    ),
    # it is given longer than 8 s, until it disarms by itself
    "takeoff refused by a helicopter, whose rotor does not turn": ends(
        "the vehicle disarmed before lift-off; .* command 22 FAILED",
        stayed_down_without_a_setpoint, fly=copter.hop, believed=HELICOPTER,
        down=faults.heartbeats(type=4),
        firmware=replace(ARDUPILOT, rules=(NO_TAKEOFF, *ARDUPILOT.rules)),
    ),
    "too weak to lift off": ends(
        "no lift-off in 8 s; is hover_thrust in the vehicle file right", disarmed_by_itself,
        fly=px4.hop, boot_scale=1.0,
        scenario=scenario_of({"fault": "thrust_change", "thrust_scale": 0.4}),
    ),
    "too weak to lift off, and the vehicle does not disarm by itself": ends(
        "no lift-off in 8 s; is hover_thrust in the vehicle file right", asked_to_disarm,
        fly=px4.hop, boot_scale=1.0, limits={"land_s": 12.0},
        at=then(Phase.TAKEOFF, 0.1, never_disarms),
        scenario=scenario_of({"fault": "thrust_change", "thrust_scale": 0.4}),
    ),
    # the pilot
    "pilot takes over the landing while a failsafe shows": aborts(
        Phase.FAILED, "not landed and disarmed after 20 s", silent_after_the_pilot, armed=True,
        fly=partial(px4.hover, HIGH), limits={"land_s": 20.0},
        at=[
            *then(Phase.HOVER, 0.2, faults.downlink(faults.heartbeats(system_status=5))),
            *then(Phase.LAND, 1.5, Pair.pilot_takes_over),
        ],
    ),
    "pilot takes over the landing behind a link that has become 4 s late": aborts(
        Phase.YIELDED, "no telemetry for 1.0 s .*; the vehicle left AUTO.LAND for AUTO.LOITER",
        keeps_loiter, fly=partial(px4.hover, HIGH), armed=True,
        at=[*then(Phase.HOVER, 0.2, late_both_ways), *then(Phase.LAND, 5.5, Pair.pilot_takes_over)],
    ),
    "pilot takes over while arming": aborts(
        Phase.YIELDED, "the vehicle left OFFBOARD for AUTO.LOITER as it armed", keeps_loiter,
        armed=True, at=then(Phase.ARM, 0.0, Pair.pilot_takes_over),
    ),
    "motors cut in flight": ends(
        "the vehicle disarmed in flight", fly=px4.hover,
        ended_by="disarmed in flight", at=tracking(lambda pair: pair.ground(400, 0, 21196)),
    ),
    # the link
    "lossy link: a fifth lost, some duplicated, reordered, 2.5 s late, garbage": flies(
        without_a_gap, fly=px4.lap, up=faults.losing(0.2, seed=4),
        down=faults.both(faults.losing(0.2), faults.both(faults.shuffling(), faults.noisy)),
    ),
    "the vehicle falls silent in flight": aborts(
        Phase.FAILED,
        "no telemetry for 1.0 s .*; not heard for 300 s while landing; last known: armed in ",
        held_then_silent, fly=px4.lap, armed=True, ended_by="link",
        at=tracking(lambda pair: setattr(pair, "dead", True)),
    ),
    "restart in flight": aborts(
        Phase.FAILED, "the vehicle restarted in flight; the vehicle restarted and is disarmed",
        fly=px4.lap, at=tracking(faults.restart),
    ),
    # the first HEARTBEAT after the restart shows another mode, and arrives before any time stamp
    "restart in flight of ArduCopter": aborts(
        Phase.FAILED, "the vehicle restarted in flight; the vehicle restarted and is disarmed",
        fly=copter.lap, armed=True, ended_by="restart",
        at=tracking(faults.downlink(BOOTING)),
    ),
    "restart of ArduCopter while landing": aborts(
        Phase.FAILED, "the vehicle restarted while landing; the vehicle restarted and is disarmed",
        fly=copter.hover, armed=True,
        ended_by="restart",
        at=then(Phase.LAND, 0.5, faults.downlink(BOOTING)),
    ),
    "restart while landing of an ArduCopter that stays armed": aborts(
        Phase.YIELDED, "the vehicle restarted while landing; the vehicle left LAND for STABILIZE",
        fly=copter.hover, armed=True, ended_by="restart",
        at=then(Phase.LAND, 0.5, faults.downlink(BOOTING_ARMED)),
    ),
    "restart while landing": ends(
        "the vehicle restarted while landing", fly=px4.hover, ended_by="restart",
        scenario=scenario_of(CLOCK_SET_BACK),
    ),
    "restart in flight of a vehicle that stays armed": ends(
        "the vehicle restarted in flight", soft_landing, fly=px4.lap,
        at=tracking(faults.downlink(faults.restamped(10.0))),
    ),
    "heartbeats stop while landing, position and mode continue": aborts(
        Phase.FAILED, "it stands on the ground, and no HEARTBEAT shows whether it is disarmed",
        fly=px4.hover, limits={"land_s": 20.0},
        at=then(Phase.LAND, 0.0, silent(faults.HEARTBEAT)),
    ),
    "position and attitude stop, heartbeats continue, land requests lost for 3.5 s": aborts(
        Phase.FAILED, "no telemetry for 1.0 s .*; disarmed, landing not confirmed: ",
        landing_requested, asks_each_second, fly=copter.lap,
        at=tracking(in_turn(silent(faults.POSITION, faults.ATTITUDE), loses_commands(3.5))),
    ),
    "restart while landing, land requests lost for 2 s": ends(
        "the vehicle restarted while landing", landed, fly=px4.hover,
        at=[
            *then(Phase.HOVER, 0.0, loses_commands(6.0)),
            *then(Phase.LAND, 0.5, faults.downlink(faults.restamped(8.0))),
        ],
    ),
    # outages of the link in both directions. PX4's own failsafe acts meanwhile, after 1.0 s
    "an outage of 1.6 s": ends(
        SILENT, landed, asks_once, fly=PX4_HOVERS, at=tracking(faults.cut(1.6))
    ),
    "an outage of 4 s": ends(
        SILENT, landed, asks_again, fly=PX4_HOVERS, firmware=LOITERS, at=tracking(faults.cut(4.0))
    ),
    "an outage of 10 s": ends(
        SILENT, landed, asks_again, fly=COPTER_HOVERS, at=tracking(faults.cut(10.0))
    ),
    # a rate is measured over two seconds. A booting ArduCopter sends no position for 40 s
    "a message that has just begun to arrive is not reported as slow": flies(
        waits_for_position_and_delay, down=begins_to_arrive(faults.POSITION, 12.0)
    ),
    # round trip of 0.36 s. Without telemetry no TIMESYNC request is sent, so none is unanswered
    "a gap of telemetry on a late link": flies(
        fly=partial(COPTER_HOVERS, "controller.bandwidth_radps=1.5"), error_m=2.0,
        down=faults.late(0.18), up=faults.late(0.18), at=tracking(faults.cut(0.98, ways=["down"])),
    ),
    # the pilot takes over in the mode of PX4's own failsafe; HEARTBEAT then shows no failsafe
    "a pilot takes over in an outage": aborts(
        Phase.YIELDED, ".*for POSCTL", keeps_posctl, fly=PX4_HOVERS, armed=True,
        at=[*tracking(faults.cut(4.0)), *then(Phase.LAND, 1.5, switches("POSCTL"))],
    ),
    # its telemetry is lost, and a pilot takes over after the first request to land
    "landing is not requested again without telemetry": aborts(
        Phase.YIELDED, ".*left GUIDED for LOITER", not_asked_again, fly=COPTER_HOVERS, armed=True,
        at=[*tracking(faults.cut(4.0, ways=["down"])), *then(Phase.LAND, 0.6, switches("LOITER"))],
    ),
    "no mode report for 9 s": ends(
        "no report of the mode for 2.", listens, fly=PX4_HOVERS, firmware=LOITERS,
        at=tracking(faults.cut(9.0, *MODES, ways=["down"])),
    ),
    "no mode report for 9 s, while a pilot takes over": aborts(
        Phase.YIELDED, "no report of the mode for 2.", listens, fly=COPTER_HOVERS, armed=True,
        at=[*tracking(faults.cut(9.0, *MODES, ways=["down"])),
            *then(Phase.LAND, 1.0, switches("BRAKE"))],
    ),
    # ArduCopter does not report it. Setpoints decided meanwhile would have made it fall when they
    # arrived
    "the vehicle does not receive setpoints": ends(
        "15 TIMESYNC requests in a row were not answered: does the vehicle receive setpoints"
        ".*; hold was requested 2 s ago$",  # it does not say that the vehicle held
        held_soon,
        fly=COPTER_HOVERS, failsafes=["uplink"], fall_mps=1.6, top_m=3.5,
        at=tracking(faults.cut(3.0, ways=["up"])),
    ),
    # regression: each gap was forgiven, and the tilt reached 46 deg
    "all telemetry arrives at 3 Hz": ends(
        "(ATTITUDE_QUATERNION|LOCAL_POSITION_NED) arrives at [23].[0-9] Hz, at least 3.5 Hz",
        landed, fly=px4.lap, failsafes=["rate"], scenario=thinned(3.0), error_m=0.5,
    ),
    # regression: with each position the thrust ramp went on as if all had arrived: up to 5.8 m
    "telemetry arrives at 2 Hz from the thrust ramp on": ends(
        "(ATTITUDE_QUATERNION|LOCAL_POSITION_NED) arrives at [12].[0-9] Hz, at least 3.5 Hz",
        fly=px4.hop, failsafes=["rate"], scenario=thinned(2.0, at_s=1.2), top_m=0.3,
    ),
    "all telemetry arrives at 5 Hz with some losses": flies(
        fly=px4.lap, scenario=thinned(5.0, loss=0.02), failsafes=(), error_m=0.5,
    ),
    # a missing HEARTBEAT is requested, because the next one, 3 s after the newest, is too late
    "two heartbeats are lost and no CURRENT_MODE arrives": flies(
        fly=PX4_HOVERS, at=tracking(lose_two_heartbeats)
    ),
    # regression: by a HEARTBEAT from before the outage it was disarmed, and so it was left armed
    "an outage while arming": refusal(
        "no telemetry for 1.0 s$", at=[(lambda pair: pair.armed, faults.cut(2.3))]
    ),
    # a jump by 35 s, beyond the end of the reference
    "a jump of the vehicle clock": ends(
        "the clock of the vehicle jumped by 35.0 s$", soft_landing, not_completed,
        fly=copter.lap,
        scenario=early("clock_jump_35s"), deadline_s=0.05,
    ),
    # the scenario also makes the vehicle heavier
    "only every tenth position arrives": flies(
        fly=copter.lap, scenario=early("thin_telemetry", 5.0), failsafes=(), error_m=0.3
    ),
    # the law
    "a law fails for two decisions, twice, and then overturns once": flies(
        bridged, fly=px4.lap,
        wrap=lambda law: faults.failing(faults.overturns, 1, 38)(
            faults.failing(faults.raises, 2, 34)(faults.failing(faults.no_direction, 2, 30)(law))
        ),
    ),
}  # fmt: skip


@pytest.mark.parametrize("title", ROWS)
def test_flight_with_a_fault_ends_as_expected(title: str) -> None:
    judged(ROWS[title])
