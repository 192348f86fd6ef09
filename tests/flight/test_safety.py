"""Safety: who controls the vehicle, and what must not happen to it in the air.

These faults were seen on real autopilots; each test flies with the fault of a scenario.
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pytest
from faults import CANNOT_HOLD, disarmed, downlink, stop
from pair import STEP_S, Bytes, Pair, with_rate
from watch import (
    BOTH,
    HIGH,
    REACTION_S,
    Check,
    Row,
    Vehicle,
    aborts,
    begun_s,
    copter,
    early,
    ends,
    engage_mode,
    flies,
    flown,
    judged,
    landed,
    px4,
    refusal,
    refused,
    said,
    scenario_of,
    sent_after,
    then,
    tracking,
)

from offboard.analysis.score import score
from offboard.analysis.score_table import AT_LIMIT_SHARE, summary
from offboard.flight.phases import FLYING, Action, Phase
from offboard.identification.learner import IdentifySettings
from offboard.mavlink.senders import HEARD_S
from simulator import config as simulated
from simulator.config import Start
from simulator.firmware.px4 import PX4

WITH_GPS = with_rate(PX4, 50.0, "GPS_RAW_INT", "ESTIMATOR_STATUS")


def another_companion(**fault: Any) -> Any:
    """Return a scenario with a second `offboard fly`, which tracks and has our ids."""
    tracks = {"system": 1, "component": 191, "custom_mode": Phase.TRACK.code}
    return scenario_of({"fault": "second_sender", **tracks, **fault})


def jump(*offset_ned_m: float, after: str = "engaged", at_s: float = 1.5) -> dict[str, Any]:
    """Return a fault that resets the position estimate by this offset."""
    return {"fault": "estimator_jump", "offset_ned_m": offset_ned_m, "after": after, "at_s": at_s}


# -- rows ------------------------------------------------------------------------------------------


def overload(pair: Pair) -> None:
    """Make the vehicle so heavy that hover would need 110 % of the full thrust."""
    scale = 1.1 / pair.companion.model.hover_thrust
    pair.instance.autopilot.plant.scale_mass(scale)


def overloaded_twice() -> Pair:
    scale = float(np.sqrt(0.95 / px4.lap().companion.model.hover_thrust))
    scenario = scenario_of(conditions={"mass_scale": scale})
    more = tracking(lambda flying: flying.instance.autopilot.plant.scale_mass(scale))
    return px4.lap(HIGH, scenario=scenario, learning=IdentifySettings(), at=more)


def too_heavy(pair: Pair) -> None:
    """Make the vehicle so heavy that it falls at once in spite of full thrust."""
    pair.instance.autopilot.plant.scale_mass(4.0)


GPS_LOST = {"fault": "gps_loss", "after": "engaged", "at_s": 7.0, "drift_mps": 0.45}
SILENT_GPS = {"fault": "silent_message", "message": "GPS_RAW_INT", "after": "engaged", "at_s": 7.0}
OTHER = another_companion(after="engaged", at_s=7.0, setpoint_rate_hz=10, thrust=0.5)
REFUSES_HOLD = replace(with_rate(PX4, 50.0), rules=(CANNOT_HOLD, *PX4.rules))
AWAY = "the attitude is [0-9]+ deg away from every recent command"
NAMED = "; another companion computer, system 1 component 194, may send setpoints, too"
RARE = "another companion that is not heard, on PX4"


def says_who_is_on_the_link(pair: Pair) -> None:
    assert said(pair, "another companion computer is on the link: system 1 component 191")


def says(pair: Pair, words: str) -> None:
    assert said(pair, words)


def says_nobody_is_on_the_link(pair: Pair) -> None:
    assert not said(pair, "another companion computer")


def soon(since: Phase, within_s: float) -> Check:
    """Return a check that the landing begins within this time after the begin of a phase."""

    def check(pair: Pair) -> None:
        assert begun_s(pair, Phase.LAND) < begun_s(pair, since) + within_s

    return check


def lands_at_once(pair: Pair) -> None:
    assert begun_s(pair, Phase.LAND) - begun_s(pair, Phase.HOLD) < 0.2


def held_for(name: str) -> Check:
    """Return a check that the vehicle first holds because of this row of the failsafe."""

    def check(pair: Pair) -> None:
        assert pair.failsafes[name] is Action.HOLD
        assert pair.went_through(Phase.HOLD)

    return check


def flies_and_lands(pair: Pair) -> None:
    """The vehicle, which only reports that it is disarmed, flies on until it has landed."""
    steps = (pair.instance.step() for _ in range(3000) if pair.armed)
    list(steps)
    assert not pair.armed
    landed(pair)


def believed_heavy() -> Pair:
    """The vehicle file has the hover thrust of an earlier flight with a load, which is gone now."""
    file = px4.hop().companion.model
    return px4.hop(believed=file.model_copy(update={"hover_thrust": 0.93}))


def one_wrong_heartbeat(on: Vehicle, phase: Phase) -> Row:
    """One HEARTBEAT wrongly shows the vehicle disarmed. Regression: the vehicle was then left alone
    in the air, or in its own takeoff."""
    wrong = then(phase, 0.3, downlink(disarmed(most=1)))

    def told(pair: Pair) -> None:
        assert said(pair, "a HEARTBEAT shows the vehicle disarmed") == (phase in FLYING)

    return flies(told, fly=on.hop, aloft=phase is not Phase.TAKEOFF, at=wrong)


def says_that_it_lands(pair: Pair) -> None:
    assert said(pair, "stop requested by the operator: the vehicle is landing already")


def taken(on: Vehicle, scenario: Any, says: str = "", **more: Any) -> Row:
    """Return a flight in which a pilot or a failsafe takes the vehicle, and is not overridden."""
    says = f"the vehicle left (OFFBOARD|GUIDED) for{says}"
    return aborts(
        Phase.YIELDED, says, not_overridden, fly=on.lap, armed=True, scenario=scenario, **more
    )


def not_overridden(pair: Pair) -> None:
    """Nothing is sent after the report of the other mode, and our mode was requested once."""
    left_s = pair.watch.left_s(engage_mode(pair))
    assert len(pair.modes) == 1
    assert pair.landings == []
    assert sent_after(pair, left_s + REACTION_S) == []
    assert sent_after(pair, left_s - 0.5) != []


def of_another(on: Vehicle, scenario: Any, says: str) -> Row:
    """Return a flight that is refused because another controller has the vehicle."""
    return refusal(says, nothing_sent, fly=on.lap, armed=True, scenario=scenario)


def nothing_sent(pair: Pair) -> None:
    assert sent_after(pair, 0.0) == []


def names_no_speed(pair: Pair) -> None:
    """The vehicle did not begin to track, so the summary does not advise to fly slower."""
    scored = score(pair.history())
    assert scored.at_bound_share > AT_LIMIT_SHARE
    assert "at a limit" not in summary(scored, pair.history())


WRONG_THRUST = (
    r".*from the reference; flown with hover thrust 0\.42, it is about 0\.\d+: set "
    r"vehicle\.hover_thrust"
)
STREAMED = {"fault": "second_sender", "setpoint_rate_hz": 10.0, "thrust": 0.49}
OFFBOARD, GUIDED = {"height_m": 8.0, "mode": "OFFBOARD"}, {"height_m": 8.0, "mode": "GUIDED"}
FAILSAFE, IDS, ENGAGED = (
    r".*limits\.begin_in_failsafe=true",
    r".*system 1 component 191 \(limits\.begin_with_other_sender=true",
    r"the vehicle is armed and in (OFFBOARD|GUIDED) already: another.*limits\.begin_engaged=true",
)
NO_GPS = scenario_of({"fault": "silent_message", "message": "GPS_RAW_INT"})
WAITS = another_companion(setpoint_rate_hz=0, custom_mode=Phase.HEALTH.code)
SAME_IDS = another_companion(component=1, setpoint_rate_hz=0, custom_mode=0)
FLIES_ANOTHER = another_companion(system=2, setpoint_rate_hz=0)
ROWS = {
    # flights that end early. Before this row existed, a real PX4 and a real ArduCopter (in SITL)
    # flew into the ground at 45 degrees
    "a load that full thrust does not carry": aborts(
        Phase.FAILED, r"the vehicle sinks at [1-3]\.[0-9] m/s with full thrust", landed,
        soon(Phase.TRACK, 3.0), fly=partial(copter.lap, HIGH), at=tracking(overload),
        failsafes=["full thrust"],
    ),
    # it shoots up when the setpoints begin
    "a hover thrust of three times the true one": aborts(
        Phase.DISARMED, WRONG_THRUST, landed, names_no_speed,
        fly=partial(px4.hop, "reference.height_m=3", vehicle="neutral", learning=IdentifySettings(),
                    scenario=scenario_of(conditions={"thrust_scale": 3.0, "mass_scale": 0.8})),
        ended_by="limit",
    ),
    # hover needs 95 % of the thrust, where 90 % are allowed; half of the load is added in track
    "a load that leaves no thrust reserve": aborts(
        Phase.DISARMED, r".*% of its thrust \(limits\.hover_thrust is 0\.9\)", landed,
        fly=overloaded_twice, failsafes=["thrust reserve"],
    ),
    # the result was once "flown and landed", after 20 s on the ground
    "the vehicle has fallen to the ground": ends(
        r"the vehicle stands on the ground, [0-9.]+ m below the reference", landed,
        soon(Phase.TRACK, 4.0), fly=copter.hover, at=tracking(too_heavy), failsafes=["ground"],
        ended_by="ground contact",
    ),
    # the result was once "flown and landed", because the estimated height was 3 m
    "the vehicle has sunk to the ground, but its estimate has not": ends(
        r"the vehicle needs [0-9]+ % of its thrust instead of [0-9]+ %: it stands on", landed,
        fly=partial(copter.hover, "reference.duration_s=10.0"),
        at=tracking(lambda pair: pair.instance.autopilot.plant.reset_estimate((0.0, 0.0, -1.9))),
        failsafes=["low thrust"], ended_by="ground contact",
    ),
    # the autopilot brakes the climb with 2.5 m/s2 after it was asked to land
    "above the ceiling": ends(
        "2 m above and 0 m from the takeoff point", landed, fly=partial(px4.hop, HIGH),
        limits={"ceiling_m": 2.0}, failsafes=["volume"], top_m=3.25,
    ),
    "the vehicle reports disarmed while it flies": aborts(
        Phase.FAILED, "the vehicle disarmed ", flies_and_lands, fly=px4.hover, armed=True,
        at=tracking(downlink(disarmed())),
    ),
    "another program with our ids": ends(
        "another program controls the vehicle on this link, too", landed,
        held_for("second sender"), fly=copter.lap, scenario=OTHER, error_m=0.3,
        ended_by="second sender",
    ),
    # level setpoints for the 2 s of a hold would let it drift
    "a vehicle without a global position, which refuses to hold": ends(
        "another program .*; the vehicle refuses AUTO.LOITER .TEMPORARILY_REJECTED.", landed,
        lands_at_once, fly=px4.lap, scenario=OTHER, firmware=REFUSES_HOLD,
    ),
    # the other setpoints are not on our link, but the vehicle does not follow ours any more
    "another companion that is not heard": ends(
        AWAY + NAMED, landed, fly=partial(copter.lap, HIGH), scenario=early("second_sender"),
        error_m=5.0,
    ),
    RARE: ends(
        "the vehicle follows setpoints of another program" + NAMED, landed, aloft=False,
        fly=partial(px4.lap, HIGH, "reference.laps=2", "reference.run_in_s=4.0"),
        scenario="second_sender", error_m=5.0,
    ),
    "a large jump of the estimate": ends(
        "the estimated position jumped by 3.0 m", landed, held_for("estimator"), fly=px4.hover,
        scenario=scenario_of(jump(0.0, 3.0, 0.0)),
    ),
    # the estimate drifts away; PX4 does not intervene, and ArduCopter does so late
    "GPS has no fix": ends(
        "GPS has no fix for 1.5 s", landed, soon(Phase.CLIMB, 9.0), fly=copter.lap,
        scenario=scenario_of(GPS_LOST), error_m=1.2, ended_by="positioning",
    ),
    "GPS is silent": ends(
        "no GPS_RAW_INT for 2.[45] s", landed, soon(Phase.CLIMB, 10.0), fly=px4.lap,
        firmware=WITH_GPS, scenario=scenario_of(GPS_LOST, SILENT_GPS), error_m=1.6,
        ended_by="positioning",
    ),
    "a failsafe that may be taken over": ends(
        "stop requested by the operator", fly=copter.lap, scenario="in_failsafe",
        limits={"begin_in_failsafe": True}, at=then(Phase.CLIMB, 1.0, stop),
    ),
    # who controls the vehicle
    "a pilot just after engaging": taken(px4, "pilot_refuses", ended_by="mode change"),
    "a pilot in track, who is back after 0.6 s, too late": taken(
        copter, early("pilot_comes_back"), ended_by="mode change"
    ),
    "a pilot whom CURRENT_MODE shows": taken(px4, early("lost_heartbeat")),
    # the HEARTBEAT that shows the failsafe arrives after CURRENT_MODE
    "a failsafe": taken(
        px4, early("empty_battery"), ".*; a failsafe of the vehicle has it", ended_by="failsafe"
    ),
    "the vehicle is in a failsafe": of_another(copter, "in_failsafe", FAILSAFE),
    "another offboard tracks": of_another(px4, another_companion(setpoint_rate_hz=0), IDS),
    "another program streams": of_another(px4, scenario_of(STREAMED, start=OFFBOARD), ENGAGED),
    "the vehicle is engaged already": of_another(copter, scenario_of(start=GUIDED), ENGAGED),
    # flights that go on
    "a load that only the vehicle file has": flies(fly=believed_heavy, failsafes=()),
    "one wrong heartbeat in track": one_wrong_heartbeat(px4, Phase.TRACK),
    "one wrong heartbeat in the takeoff": one_wrong_heartbeat(copter, Phase.TAKEOFF),
    "one wrong heartbeat in the landing": one_wrong_heartbeat(px4, Phase.LAND),
    # as by `offboard fly`: nothing is known of the vehicle, which is identified in flight
    "all disturbances together": flies(
        fly=px4.lap, aloft=False, scenario="all_together", seed=1, deadline_s=0.05,
        believed=simulated.vehicle("neutral"), learning=IdentifySettings(),
    ),
    "stop while landing": flies(
        says_that_it_lands, fly=copter.hover, at=then(Phase.LAND, 0.3, stop), failsafes=()
    ),
    "no GPS from the beginning, by motion capture": flies(
        fly=px4.hover, firmware=WITH_GPS, scenario=NO_GPS, failsafes=()
    ),
    # started by mistake on another port, with our ids; it is refused itself, as in other rows
    "another offboard waits on the link": flies(
        says_who_is_on_the_link, fly=copter.hover, scenario=WAITS, failsafes=()
    ),
    "another program with the ids of the vehicle": flies(
        lambda pair: says(pair, "with the ids of the vehicle, system 1 component 1: give it"),
        fly=copter.hover, scenario=SAME_IDS, failsafes=(),
    ),
    # regression: its HEARTBEAT, forwarded by a router, was taken for a second controller of ours
    "an offboard that flies another vehicle on the link": flies(
        says_nobody_is_on_the_link, fly=px4.hover, scenario=FLIES_ANOTHER, system_id=1,
        failsafes=(),
    ),
}  # fmt: skip


@pytest.mark.parametrize(
    "title", [pytest.param(each, marks=[pytest.mark.slow] * (each == RARE)) for each in ROWS]
)
def test_flight_with_a_hazard_ends_as_expected(title: str) -> None:
    judged(ROWS[title])


@pytest.mark.parametrize(("scenario", "on"), [("landed_wrong", px4), ("landed_lost", copter)])
def test_wrong_land_detector_causes_no_fall(scenario: str, on: Vehicle) -> None:
    """The land detector wrongly reports the ground. Thrust stays above a third of hover thrust, and
    the vehicle never sinks fast."""
    start = Start(height_m=5.0)  # instead of 10 m and 18 m
    low = simulated.scenario(scenario).model_copy(update={"start": start})
    pair = on.hop(HIGH, scenario=low)
    flown(pair, None, "", error_m=0.1, fall_mps=1.6)
    assert not pair.went_through(Phase.TAKEOFF)
    assert pair.went_through(Phase.TRACK)
    least = pair.companion.model.hover_thrust / 3.0
    assert min(setpoint.thrust for _, _, setpoint in pair.setpoints) > least - 1e-6


def test_estimate_reset_moves_the_vehicle_slowly() -> None:
    """After a reset of the estimate by 1.5 m in a hover, the vehicle moves to the reference in the
    new frame at up to 0.5 m/s."""
    pair = copter.hover("reference.duration_s=8.0", scenario=scenario_of(jump(0.0, 1.5, 0.0)))
    watch = flown(pair, failsafes=())
    assert said(pair, "the estimated position jumped by 1.50 m: the reference jumps with it")
    hovered = np.array([m.position_ned_m[:2] for m in watch.during(Phase.TRACK, Phase.HOVER)])
    speeds_mps = np.linalg.norm(hovered[10:] - hovered[:-10], axis=1) / 0.2
    assert 0.3 < speeds_mps.max() < 0.65
    assert np.linalg.norm(hovered[-1] - hovered[0]) == pytest.approx(1.5, abs=0.1)


IN_TAKEOFF = jump(1.5, 0.0, 0.4, after="armed", at_s=0.9)
IN_TRACK = jump(0.0, 0.0, -1.9, after="took_off", at_s=6.0)
IN_LANDING = jump(0.0, 0.0, -1.9, after="landing", at_s=0.5)


@pytest.mark.parametrize("resets", [[IN_TRACK], [IN_TAKEOFF, IN_LANDING]])
def test_estimate_resets_shift_reference_and_ground_height(resets: list[dict[str, Any]]) -> None:
    """Regression: after a reset by 1.5 m before lift-off it flew at once to the old place, 1.5 m
    away. Later the estimated height jumps up, and with it the height of the ground, for the flight
    and for the score."""
    pair = px4.hop(scenario=scenario_of(*resets))
    watch = flown(pair, ended_by="reference over", top_m=2.2)
    assert max(math.hypot(*m.position_ned_m[:2]) for m in watch.moments) < 0.3
    assert pair.companion.contact.height_m == pytest.approx(0.0, abs=0.1)


@BOTH
def test_vehicle_is_not_armed_while_its_ids_are_duplicated(on: Vehicle) -> None:
    """The first one heard was once flown, whichever was meant. Now it flies once the other has
    gone."""
    pair, twin = on.hop(), on.hop(seed=8).instance

    def beside(time_s: float, datagrams: Bytes) -> Bytes:
        if time_s < 20.0:
            pair.companion.overhear(twin.step())
        return datagrams

    pair.down = beside
    flown(pair)
    assert said(pair, "an autopilot sends as system 1 from another address, too. Fix: switch one")
    assert begun_s(pair, Phase.ARM) > 20.0 + HEARD_S - 1.1


def test_duplicate_ids_before_arming_end_the_start() -> None:
    pair, twin = px4.hop(), px4.hop(seed=8).instance

    def beside(_: float, datagrams: Bytes) -> Bytes:
        heard = twin.step()
        if pair.went_through(Phase.STREAM):
            pair.companion.overhear(heard)
        return datagrams

    pair.down = beside
    refused(pair, "an autopilot sends as system 1 from another address, too")
    assert not pair.armings


@BOTH
def test_vehicles_sharing_ids_on_one_radio_are_not_armed(on: Vehicle) -> None:
    """Both follow what is sent. Regression: the other one was flown, too, by setpoints that were
    not made for it."""
    pair, twin = on.hop(), on.hop(seed=8).instance
    for _ in range(int(5.0 / STEP_S)):  # it booted earlier
        twin.step()

    def obeyed_by_both(_: float, frames: Bytes) -> Bytes:
        for frame in frames:
            twin.feed(frame)
        return frames

    pair.down, pair.up = lambda _, datagrams: [*datagrams, *twin.step()], obeyed_by_both
    refused(pair, "two vehicles with the same system id send on this link")
    assert not pair.armed
    assert not twin.autopilot.commander.armed
