"""Safety: whose the vehicle is, and what must not happen to it in the air.

Faults that were seen on real autopilots, each flown with the fault of a scenario.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import pytest
from faults import disarmed, downlink, kill_motors, stop
from pair import STEP_S, Bytes, Pair, in_phase, with_rate
from watch import (
    BOTH,
    HIGH,
    REACTION_S,
    Vehicle,
    aborted,
    alternately,
    begun_s,
    copter,
    early,
    engage_mode,
    flown,
    px4,
    refused,
    said,
    scenario_of,
    sent_after,
)

from offboard.flight.phases import Action, Phase
from offboard.identification.learner import IdentifySettings
from simulator import config as simulated
from simulator.firmware.px4 import PX4
from simulator.start import Start

WITH_GPS = with_rate(PX4, 50.0, "GPS_RAW_INT", "ESTIMATOR_STATUS")
TRACKING = in_phase(Phase.TRACK, 1.0)


def another_companion(**fault: Any) -> Any:
    """A second `offboard fly` that tracks: our own ids."""
    tracks = {"system": 1, "component": 191, "custom_mode": Phase.TRACK.code}
    return scenario_of({"fault": "second_sender", **tracks, **fault})


def jump(*offset_ned_m: float, after: str = "engaged", at_s: float = 1.5) -> dict[str, Any]:
    """The estimate is reset by so much."""
    return {"fault": "estimator_jump", "offset_ned_m": offset_ned_m, "after": after, "at_s": at_s}


# -- flights that end early ------------------------------------------------------------------------


def overload(pair: Pair) -> None:
    """Hover would need 1.1 of the thrust."""
    scale = 1.1 / pair.companion.model.hover_thrust
    pair.instance.autopilot.plant.scale_mass(scale)


def overloaded_twice() -> Pair:
    scale = float(np.sqrt(0.95 / px4.lap().companion.model.hover_thrust))
    scenario = scenario_of(conditions={"mass_scale": scale})
    more = (TRACKING, lambda flying: flying.instance.autopilot.plant.scale_mass(scale))
    return px4.lap(HIGH, scenario=scenario, learning=IdentifySettings(), at=[more])


def too_heavy(pair: Pair) -> None:
    """It falls at once, with full thrust."""
    pair.instance.autopilot.plant.scale_mass(4.0)


GPS_LOST = {"fault": "gps_loss", "after": "engaged", "at_s": 7.0, "drift_mps": 0.45}
SILENT_GPS = {"fault": "silent_message", "message": "GPS_RAW_INT", "after": "engaged", "at_s": 7.0}
OTHER = another_companion(after="engaged", at_s=7.0, setpoint_rate_hz=10, thrust=0.5)
AWAY = "the attitude is [0-9]+ deg away from every recent command"
NAMED = "; another companion computer, system 1 component 194, may send setpoints, too"


def no_fix(pair: Pair) -> bool:
    return not pair.instance.autopilot.plant.gps_healthy


# How it is flown, the sentence, and more about its end. `soon`: from when on it must land how soon;
# `held_for`: the row of the failsafe for which it holds first
LANDED_EARLY: dict[str, Any] = {
    # before this row a real PX4 and a real ArduCopter were flown into the ground, at 45 degrees
    "a load that full thrust does not carry": (
        lambda: copter.lap(HIGH, at=[(TRACKING, overload)]),
        r"the vehicle sinks at [1-3]\.[0-9] m/s with full thrust",
        {"failsafes": ["full thrust"], "soon": (TRACKING, 2.0)},
    ),
    # by 5 %, of which half when it is identified and half in track (`limits.hover_thrust`: 0.9)
    "a load that leaves no thrust reserve": (
        overloaded_twice, r".*% of its thrust \(limits\.hover_thrust is 0\.9\)",
        {"failsafes": ["thrust reserve"]},
    ),
    # "flown and landed" before, after 20 s on the ground
    "it has fallen to the ground": (
        lambda: copter.hover(at=[(TRACKING, too_heavy)]),
        r"the vehicle stands on the ground, [0-9.]+ m below the reference",
        {"failsafes": ["ground"], "soon": (TRACKING, 3.0), "ended_by": "ground contact"},
    ),
    # the autopilot brakes the climb with 2.5 m/s2 after it was asked to land
    "above the ceiling": (
        lambda: px4.hop(HIGH, limits={"ceiling_m": 2.0}),
        "2 m above and 0 m from the take-off point",
        {"failsafes": ["volume"], "top_m": 3.25},
    ),
    "disarmed, it says, and flies": (
        lambda: px4.hover(at=[(TRACKING, downlink(disarmed()))]), "the vehicle disarmed ", {}
    ),
    "another program with our ids": (
        lambda: copter.lap(scenario=OTHER),
        "another program controls the vehicle on this link, too",
        {"held_for": "second sender", "error_m": 0.3, "ended_by": "second sender"},
    ),
    # setpoints that are not on our link: the vehicle no longer follows ours
    "another companion that is not heard": (
        lambda: copter.lap(HIGH, scenario=early("second_sender")), AWAY + NAMED, {"error_m": 5.0}
    ),
    "another companion that is not heard, on PX4": (
        lambda: px4.lap(HIGH, "reference.laps=2", "reference.run_in_s=4.0", aloft=False,
                        scenario="second_sender"),
        "the vehicle follows setpoints of another program" + NAMED,
        {"error_m": 5.0},
    ),
    "a large jump of the estimate": (
        lambda: px4.hover(scenario=scenario_of(jump(0.0, 3.0, 0.0))),
        "the estimated position jumped by 3.0 m", {"held_for": "estimator"},
    ),
    # PX4 does not intervene, and ArduCopter late: its estimate drifts away meanwhile
    "GPS has no fix": (
        lambda: copter.lap(scenario=scenario_of(GPS_LOST)),
        "GPS has no fix for 1.5 s",
        {"error_m": 1.2, "ended_by": "positioning", "soon": (no_fix, 2.0)},
    ),
    "GPS is silent": (
        lambda: px4.lap(firmware=WITH_GPS, scenario=scenario_of(GPS_LOST, SILENT_GPS)),
        "no GPS_RAW_INT for 2.5 s",
        {"error_m": 1.6, "ended_by": "positioning", "soon": (no_fix, 3.0)},
    ),
}  # fmt: skip
RARE = "another companion that is not heard, on PX4"


@pytest.mark.parametrize(
    "title",
    [pytest.param(each, marks=pytest.mark.slow if each == RARE else []) for each in LANDED_EARLY],
)
def test_it_is_landed(title: str) -> None:
    fly, says, more = LANDED_EARLY[title]
    pair, more, began_s = fly(), dict(more), list[float]()
    began, within_s = more.pop("soon", (lambda _: True, math.inf))
    held_for = more.pop("held_for", "")
    pair.at.append((began, lambda flying: began_s.append(flying.time_s)))
    aborted(pair, says, **more)
    assert begun_s(pair, Phase.LAND) < began_s[0] + within_s
    if held_for:
        assert pair.failsafes[held_for] is Action.HOLD
        assert pair.went_through(Phase.HOLD)
    assert pair.landings
    steps = (pair.instance.step() for _ in range(3000) if pair.armed)
    list(steps)  # one that only says that it is disarmed still flies
    assert not pair.armed
    assert pair.instance.autopilot.position_controller.landed


# -- flights that go on ----------------------------------------------------------------------------


def heavy() -> Pair:
    """An earlier flight has identified the vehicle with a load that it does not carry any more."""
    file = px4.hop().companion.model
    return px4.hop(believed=file.model_copy(update={"hover_thrust": 0.93}))


def wrongly_disarmed(on: Vehicle, phase: Phase) -> Pair:
    """One HEARTBEAT shows it disarmed: it was left in the air, or in its own take-off."""
    wrong = (in_phase(phase, 0.3), downlink(disarmed(most=1)))
    return on.hop(aloft=phase is not Phase.TAKEOFF, at=[wrong])


NO_GPS = scenario_of({"fault": "silent_message", "message": "GPS_RAW_INT"})
NEEDED: dict[str, tuple[Callable[[], Pair], dict[str, Any]]] = {
    "a load that is only believed": (heavy, {"failsafes": ()}),
    "one wrong heartbeat in track": (partial(wrongly_disarmed, px4, Phase.TRACK), {}),
    "one wrong heartbeat in the take-off": (partial(wrongly_disarmed, copter, Phase.TAKEOFF), {}),
    "one wrong heartbeat in the landing": (partial(wrongly_disarmed, px4, Phase.LAND), {}),
    # as `offboard fly` does it: nothing known of the vehicle, identified in flight
    "all disturbances together": (
        lambda: px4.lap(aloft=False, scenario="all_together", seed=1, deadline_s=0.05,
                        believed=simulated.vehicle("neutral"), learning=IdentifySettings()),
        {},
    ),
    "no GPS from the beginning, by motion capture": (
        lambda: px4.hover(firmware=WITH_GPS, scenario=NO_GPS), {"failsafes": ()}
    ),
}  # fmt: skip


@pytest.mark.parametrize("title", NEEDED)
def test_no_failsafe_is_needed(title: str) -> None:
    fly, more = NEEDED[title]
    pair = fly()
    flown(pair, **more)
    assert pair.at == []


@pytest.mark.parametrize(("scenario", "on"), alternately("landed_wrong", "landed_lost"))
def test_in_the_air_it_never_falls(scenario: str, on: Vehicle) -> None:
    """The land detector says ground: never less than a third of hover, never fast downwards."""
    start = Start(height_m=5.0)  # instead of 10 m and 18 m
    low = simulated.scenario(scenario).model_copy(update={"start": start})
    pair = on.hop(HIGH, scenario=low)
    flown(pair, None, "", error_m=0.1, fall_mps=1.6)
    assert not pair.went_through(Phase.TAKEOFF)
    assert pair.went_through(Phase.TRACK)
    least = pair.companion.model.hover_thrust / 3.0
    assert min(setpoint.thrust for _, _, setpoint in pair.setpoints) > least - 1e-6


def test_the_vehicle_does_not_step_with_its_estimate() -> None:
    """A reset by 1.5 m in a hover: it moves to its place in the new frame at up to 0.5 m/s."""
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
def test_resets_of_the_estimate_move_its_place_and_the_ground(resets: list[dict[str, Any]]) -> None:
    """By 1.5 m before lift-off: it flew to the old place, 1.5 m away, at once. Later the estimated
    height jumps up, and with it the ground: for the flight and for the score."""
    pair = px4.hop(scenario=scenario_of(*resets))
    watch = flown(pair, ended_by="reference over", top_m=2.2)
    assert max(math.hypot(*m.position_ned_m[:2]) for m in watch.moments) < 0.3
    assert pair.companion.contact.height_m == pytest.approx(0.0, abs=0.1)


# -- whose it is -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("scenario", "on", "says", "ended_by"),
    [
        ("pilot_refuses", px4, "", "pilot"),  # just after engaging
        (early("pilot_comes_back"), copter, "", "pilot"),  # in track; back after 0.6 s, too late
        (early("lost_heartbeat"), px4, "", ""),  # CURRENT_MODE shows him
        # the HEARTBEAT that shows a failsafe comes after CURRENT_MODE
        (early("empty_battery"), px4, ".*; a failsafe of the vehicle has it", "failsafe"),
    ],
)
def test_who_takes_it_is_not_overridden(
    scenario: Any, on: Vehicle, says: str, ended_by: str
) -> None:
    """Nothing leaves after the report of the other mode, and ours is asked for once."""
    pair = on.lap(scenario=scenario)
    watch = aborted(pair, f"the vehicle left (OFFBOARD|GUIDED) for{says}", ended_by=ended_by)
    left_s = watch.left_s(engage_mode(pair))
    assert len(pair.modes) == 1
    assert pair.landings == []
    assert pair.companion.phase is Phase.YIELDED
    assert pair.armed
    assert sent_after(pair, left_s + REACTION_S) == []
    assert sent_after(pair, left_s - 0.5) != []


STREAMED = {"fault": "second_sender", "setpoint_rate_hz": 10.0, "thrust": 0.49}
FAILSAFE, IDS, ENGAGED = (
    r".*limits\.begin_in_failsafe=true",
    r".*system 1 component 191 \(limits\.begin_with_other_sender=true",
    r"the vehicle is armed and in (OFFBOARD|GUIDED) already: another.*limits\.begin_engaged=true",
)


@pytest.mark.parametrize(
    ("on", "scenario", "says"),
    [
        (copter, "in_failsafe", FAILSAFE),
        (px4, another_companion(setpoint_rate_hz=0), IDS),
        (px4, scenario_of(STREAMED, start={"height_m": 8.0, "mode": "OFFBOARD"}), ENGAGED),
        (copter, scenario_of(start={"height_m": 8.0, "mode": "GUIDED"}), ENGAGED),
    ],
)
def test_a_vehicle_that_another_has_is_refused(on: Vehicle, scenario: Any, says: str) -> None:
    pair = on.lap(scenario=scenario)
    refused(pair, says)
    assert sent_after(pair, 0.0) == []


@BOTH
def test_of_two_vehicles_with_the_same_ids_on_one_radio_none_is_armed(on: Vehicle) -> None:
    """Both obey: the other one was flown too, by setpoints that were not made for it."""
    pair, twin = on.hop(), on.hop(seed=8).instance
    for _ in range(int(5.0 / STEP_S)):  # it was switched on earlier
        twin.step()

    def obeyed_by_both(_: float, frames: Bytes) -> Bytes:
        for frame in frames:
            twin.feed(frame)
        return frames

    pair.down, pair.up = lambda _, datagrams: [*datagrams, *twin.step()], obeyed_by_both
    refused(pair, "two vehicles with the same system id send on this link")
    assert not pair.armed
    assert not twin.autopilot.commander.armed


def test_a_second_flight_that_waits_disturbs_no_flight() -> None:
    """By mistake, on another port: it has our ids, and is refused, see above."""
    waits = another_companion(setpoint_rate_hz=0, custom_mode=Phase.HEALTH.code)
    pair = copter.hover(scenario=waits)
    flown(pair, failsafes=())
    assert said(pair, "another companion computer is on the link: system 1 component 191")


def test_an_offboard_that_flies_another_vehicle_on_the_link_disturbs_no_flight() -> None:
    """Its HEARTBEAT, which a router forwards to us, shows that it tracks: it was taken for a second
    controller of our vehicle, and the flight ended."""
    other = another_companion(system=2, setpoint_rate_hz=0)
    pair = px4.hover(scenario=other, system_id=1)
    flown(pair, failsafes=())
    assert not said(pair, "another companion computer")


def test_a_failsafe_is_taken_over_if_that_is_allowed() -> None:
    pair = copter.lap(scenario="in_failsafe", limits={"begin_in_failsafe": True},
                      at=[(in_phase(Phase.CLIMB, 1.0), stop)])  # fmt: skip
    aborted(pair, "stop requested by the operator")
    assert pair.went_through(Phase.CLIMB)


# -- arming and disarming --------------------------------------------------------------------------


def test_a_vehicle_that_does_not_show_that_it_armed_is_not_left_armed() -> None:
    pair = px4.hop(at=[(in_phase(Phase.ARM, 0.0), downlink(disarmed()))])
    refused(pair)
    assert pair.armings == [1.0, 0.0]
    assert not pair.armed


def test_a_fall_in_the_landing_is_not_flown() -> None:
    """The motors are cut 1.5 m above the ground while it lands: all phases are gone through."""

    def low(pair: Pair) -> bool:
        truth = pair.instance.autopilot.state.truth
        return pair.companion.phase is Phase.LAND and -truth.position_ned_m[2] < 1.5

    pair = px4.hover(HIGH, at=[(low, kill_motors)])
    aborted(pair, "disarmed, landing not confirmed: fell at up to")
    fallen = pair.score()
    assert fallen.completed == 0.0
    assert "fell at up to " in fallen.ended_by  # how fast is in `test_verdict.py`


def test_a_vehicle_that_does_not_detect_its_landing_is_left_to_the_user() -> None:
    """Only its land detector says whether it flies: it is not disarmed, and the user is told."""
    pair = copter.hover(scenario="never_landed", limits={"land_s": 24.0})
    still_armed = (
        "it has stood still for 15 s and is armed: its land detector reports that it flies"
    )
    aborted(pair, f".*not landed and disarmed after 24 s; {still_armed}")
    assert said(pair, still_armed)
    assert pair.armed
    assert pair.armings == []


def test_a_vehicle_that_does_not_disarm_by_itself_is_disarmed() -> None:
    """Its land detector knows the ground. It is asked without force."""
    pair = px4.hover()
    pair.instance.autopilot.parameters.set("COM_DISARM_LAND", 0.0)
    flown(pair)
    assert [(m.param1, m.param2) for m in pair.commands(400)] == [(0.0, 0.0)]
    assert said(pair, "15 s without motion on the ground, and the vehicle does not disarm")
