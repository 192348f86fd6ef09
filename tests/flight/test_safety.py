"""Safety: whose the vehicle is, and what must not happen to it in the air.

Rows of faults that were seen on real autopilots, each flown with the fault of a scenario; most on
both firmwares.
"""

from __future__ import annotations

import math
import re
from dataclasses import replace
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from faults import HEARTBEAT, downlink, frame_id, stop, without
from pair import SHORT, Bytes, Pair, decode, frames_of, hover, in_phase, make, on_arducopter
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from watch import (
    ARM,
    BOTH,
    FIRMWARES,
    FROM_THE_GROUND,
    HIGH,
    LAND,
    LOW,
    ONE_LAP,
    REACTION_S,
    SET_MODE,
    Fly,
    alternately,
    early,
    engage_mode,
    said,
    scenario_of,
    sent_after,
    watched,
)

from offboard.flight.phases import PHASE_CODES, Action, ExitCode, Limits, Phase
from offboard.flight.positioning import Positioning
from offboard.flight.state import Outcome
from offboard.flight.vehicle_state import VehicleState
from offboard.identification.learner import IdentifySettings
from offboard.mavlink.events import ESTIMATE, EstimatorReport
from simulator import config as simulated
from simulator.config import Scenario
from simulator.firmware.px4 import PX4
from simulator.start import Start

# -- authority -------------------------------------------------------------------------------------


@BOTH
@pytest.mark.parametrize("scenario", ["pilot_refuses", "pilot_takes_over", "pilot_comes_back"])
def test_a_pilot_is_not_overridden(scenario: str, fly: Fly) -> None:
    """Nothing leaves after the report of the pilot's mode, and the mode is asked for once.

    `pilot_comes_back` is back after 0.6 s, long after the flight has ended.
    """
    pair = fly(scenario=early(scenario) if scenario != "pilot_refuses" else scenario)
    watch = watched(pair)
    outcome = pair.fly()
    mode = engage_mode(pair)
    assert outcome.exit_code == ExitCode.ABORTED
    assert f"the vehicle left {mode} for" in outcome.sentence
    assert len(pair.commands(SET_MODE)) == 1
    assert pair.commands(LAND) == []
    assert pair.companion.phase is Phase.YIELDED
    assert pair.instance.autopilot.commander.armed
    assert sent_after(pair, watch.left_s(mode) + REACTION_S) == []
    assert sent_after(pair, watch.left_s(mode) - 0.5) != []


@FROM_THE_GROUND
def test_a_vehicle_that_was_disarmed_is_not_armed_again(fly: Fly) -> None:
    pair = fly(scenario="pilot_disarms")
    watch = watched(pair)
    outcome = pair.fly()
    assert outcome.exit_code in (ExitCode.REFUSED, ExitCode.ABORTED)
    assert "disarmed" in outcome.sentence
    assert watch.armings == [each.param1 for each in pair.commands(ARM)].count(1.0) == 1
    assert watch.top_m < 0.05


@FROM_THE_GROUND
def test_an_arming_that_is_accepted_late_is_not_taken_for_a_disarming(fly: Fly) -> None:
    """The link loses the first three requests, and every HEARTBEAT for 2.4 s from the fourth on."""
    asked_s: list[float] = []

    def up(time_s: float, frames: Bytes) -> Bytes:
        asked_s.extend(time_s for frame in frames if is_arming(frame))
        return [frame for frame in frames if not is_arming(frame) or len(asked_s) > 3]

    def down(time_s: float, datagrams: Bytes) -> Bytes:
        lost = len(asked_s) > 3 and time_s < asked_s[3] + 2.4
        return without(HEARTBEAT)(time_s, datagrams) if lost else datagrams

    pair = fly(up=up, down=down)
    while not (pair.companion.phase is Phase.TAKEOFF or pair.companion.has_ended()):
        pair.advance()
    assert pair.companion.phase is Phase.TAKEOFF, pair.companion.outcome
    assert len(asked_s) == 4


def is_arming(frame: bytes) -> bool:
    message = decode(frame)
    return message.get_type() == "COMMAND_LONG" and message.command == ARM


def test_current_mode_shows_the_pilot_without_heartbeats() -> None:
    """ArduCopter has no other report: see test_outages."""
    pair = make(LOW, ONE_LAP, aloft=True, scenario=early("lost_heartbeat"))
    watch = watched(pair)
    outcome = pair.fly()
    left_s = watch.left_s("OFFBOARD")
    assert outcome.sentence.startswith("the vehicle left OFFBOARD for ")
    assert sent_after(pair, left_s + REACTION_S) == []
    assert pair.commands(LAND) == []


@BOTH
def test_a_failsafe_is_not_taken_over(fly: Fly) -> None:
    pair = fly(scenario="in_failsafe")
    outcome = pair.fly()
    assert outcome.exit_code == ExitCode.REFUSED
    assert "limits.begin_in_failsafe=true" in outcome.sentence
    assert pair.setpoints == pair.commands(SET_MODE) == []
    told = fly(scenario="in_failsafe", limits={"begin_in_failsafe": True},
               at=[(in_phase(Phase.CLIMB, 1.0), stop)])  # fmt: skip
    told.fly()
    assert told.went_through(Phase.CLIMB)


def another_companion(**fault: Any) -> Any:
    """A second `offboard fly` that tracks: our own ids."""
    tracks = {"system": 1, "component": 191, "custom_mode": PHASE_CODES[Phase.TRACK]}
    return scenario_of({"fault": "second_sender", **tracks, **fault})


@BOTH
def test_a_second_sender_is_refused_before_the_flight(fly: Fly) -> None:
    pair = fly(scenario=another_companion(setpoint_rate_hz=0))
    outcome = pair.fly()
    assert outcome.exit_code == ExitCode.REFUSED
    assert "system 1 component 191 (limits.begin_with_other_sender=true" in outcome.sentence
    assert pair.setpoints == pair.commands(SET_MODE) == []


@BOTH
def test_a_second_sender_is_noticed_in_flight(fly: Fly) -> None:
    """Hold within a second and what HEARTBEAT takes, then land."""
    pair = fly(
        scenario=another_companion(after="engaged", at_s=7.0, setpoint_rate_hz=10, thrust=0.5)
    )
    watch = watched(pair)
    outcome = pair.fly()
    assert outcome.exit_code == ExitCode.ABORTED
    assert outcome.sentence.startswith("another program controls the vehicle on this link, too")
    assert [phase for _, phase in pair.phases][-4:-1] == [Phase.TRACK, Phase.HOLD, Phase.LAND]
    assert watch.error_m < 0.3
    assert not pair.instance.autopilot.commander.armed


class Beside:
    """The place of a second companion on the link of a pair: it hears the vehicle and the first
    companion's HEARTBEAT, and the first one hears its own."""

    def __init__(self, first: Pair) -> None:
        self._first, self._heard, self._told = first, list[bytes](), list[bytes]()
        first.down, first.up = self._down, self._up

    def _down(self, _: float, datagrams: Bytes) -> Bytes:
        told, self._told = self._told, []
        self._heard += datagrams
        return [*datagrams, *told]

    def _up(self, _: float, frames: Bytes) -> Bytes:
        self._heard += [frame for frame in frames if frame_id(frame) == HEARTBEAT]
        return frames

    def step(self) -> Bytes:
        heard, self._heard = self._heard, []
        return heard

    def feed(self, frame: bytes) -> None:
        self._told += [frame] if frame_id(frame) == HEARTBEAT else []
        self._first.instance.feed(frame)


@pytest.mark.parametrize(
    ("moment", "fly"), alternately(in_phase(Phase.ENGAGE), in_phase(Phase.TRACK, 1.0))
)
def test_a_second_flight_is_refused_and_the_first_flies_on(moment: Any, fly: Fly) -> None:
    """By mistake, on another port: it has our ids. It is refused before it sends a setpoint or a
    command that changes the vehicle."""
    first, second = fly(), fly()
    while not moment(first):
        first.advance()
    second.instance = Beside(first)  # type: ignore[assignment]
    while not first.companion.has_ended():
        first.advance()
        if not second.companion.has_ended():
            second.advance()
    assert first.companion.outcome == Outcome(ExitCode.FLOWN, "flown and landed")
    assert said(first, "another companion computer is on the link: system 1 component 191")
    refused = second.companion.outcome
    assert refused is not None
    assert refused.exit_code == ExitCode.REFUSED
    assert "another" in refused.sentence
    assert sent_after(second, 0.0) == []


@BOTH
def test_a_second_companion_of_other_ids_shows_by_what_it_does(fly: Fly) -> None:
    """Its setpoints are not on our link: the vehicle no longer follows ours, and is landed."""
    pair = fly(HIGH, "reference.laps=2", aloft=False, scenario="second_sender")
    watch = watched(pair)
    outcome = pair.fly()
    assert outcome.exit_code == ExitCode.ABORTED
    px4 = engage_mode(pair) == "OFFBOARD"
    seen = "follows setpoints of another" if px4 else "deg away from every recent command"
    assert seen in outcome.sentence
    named = "another companion computer, system 1 component 194, may send setpoints, too"
    assert f"; {named}" in outcome.sentence
    assert watch.error_m < 5.0


@pytest.mark.parametrize("rate_hz", [5.0, 10.0])
def test_setpoints_of_another_program_show_in_what_px4_follows(rate_hz: float) -> None:
    """Level ones, that are not on our link: unnoticed they cost 3 m."""
    sender = {"fault": "second_sender", "setpoint_rate_hz": rate_hz, "thrust": 0.49}
    pair = make(
        firmware=PX4, seed=3, scenario=scenario_of({**sender, "after": "engaged", "at_s": 16.0})
    )
    watch = watched(pair)
    outcome = pair.fly()
    assert outcome.exit_code == ExitCode.ABORTED
    assert outcome.sentence.startswith(
        "the vehicle follows setpoints of another program; another companion computer, system 1 "
        "component 194, may send setpoints, too"
    )
    assert [phase for _, phase in pair.phases][-4:-1] == [Phase.TRACK, Phase.HOLD, Phase.LAND]
    assert watch.error_m < 3.0


def test_an_arducopter_that_another_flies_is_refused() -> None:
    pair = on_arducopter(scenario=scenario_of(start={"height_m": 8.0, "mode": "GUIDED"}))
    outcome = pair.fly()
    assert outcome.exit_code == ExitCode.REFUSED
    assert "in GUIDED already" in outcome.sentence
    assert "limits.begin_engaged=true" in outcome.sentence
    assert pair.setpoints == pair.commands(SET_MODE) == []


@BOTH
def test_a_load_that_full_thrust_does_not_carry_is_landed(fly: Fly) -> None:
    """Hover would need 1.1 of the thrust. Before this row a real PX4 and a real ArduCopter were
    flown into the ground so, with 45 degrees of tilt."""
    pair = fly(HIGH)
    plant = pair.instance.autopilot.plant
    scale = 1.1 / pair.companion.model.hover_thrust
    pair.at.append((in_phase(Phase.TRACK, 1.0), lambda flying: plant.scale_mass(scale)))
    outcome = pair.fly()
    assert outcome.exit_code == ExitCode.ABORTED
    assert re.match(r"the vehicle sinks at [1-3]\.[0-9] m/s with full thrust", outcome.sentence)
    assert list(pair.failsafes) == ["full thrust"]
    begun_s = {phase: at_s for at_s, phase in pair.phases}
    assert begun_s[Phase.LAND] < begun_s[Phase.TRACK] + 1.0 + 2.0


# -- in the air ------------------------------------------------------------------------------------


@pytest.mark.parametrize(("scenario", "fly"), alternately("landed_wrong", "landed_lost"))
def test_in_the_air_it_never_falls(scenario: str, fly: Fly) -> None:
    """The land detector says ground: never less than a third of hover, never fast downwards."""
    start = Start(height_m=5.0)  # instead of 10 m and 18 m
    low = simulated.scenario(scenario).model_copy(update={"start": start})
    pair = fly(HIGH, scenario=low)
    watch = watched(pair)
    pair.fly()
    hover = pair.companion.model.hover_thrust
    assert not pair.went_through(Phase.TAKEOFF)
    assert pair.went_through(Phase.TRACK)
    assert min(setpoint.thrust for _, _, setpoint in pair.setpoints) > hover / 3.0 - 1e-6
    assert watch.fall_mps < 1.6
    assert watch.error_m < 0.1


@FROM_THE_GROUND
def test_one_sample_of_velocity_is_no_lift_off(fly: Fly) -> None:
    pair = fly(scenario="velocity_spike")
    watch = watched(pair)
    assert pair.fly().exit_code == ExitCode.FLOWN
    assert -watch.during(Phase.CLIMB)[0].position_ned_m[2] > 0.1
    thrusts = [setpoint.thrust for _, phase, setpoint in pair.setpoints if phase is Phase.TAKEOFF]
    assert all(after - before < 0.05 for before, after in pairwise(thrusts))


@FROM_THE_GROUND
def test_twice_the_thrust_does_not_carry_it_away(fly: Fly) -> None:
    pair = fly(HIGH, scenario="thrust_doubled")
    watch = watched(pair)
    assert pair.fly().exit_code == ExitCode.FLOWN
    assert watch.top_m < 3.0 + 1.0
    assert watch.error_m < 1.0


@pytest.mark.parametrize(
    ("case", "fly"),
    alternately(({"ceiling_m": 2.0}, "2 m above and 0 m from"), ({"radius_m": 1.0}, "1 m from")),
)
def test_the_volume_is_kept(case: tuple[dict[str, float], str], fly: Fly) -> None:
    limits, says = case
    pair = fly(HIGH, limits=limits, aloft=False)
    watch = watched(pair)
    outcome = pair.fly()
    assert outcome.exit_code == ExitCode.ABORTED
    assert says in outcome.sentence
    assert "the take-off point" in outcome.sentence
    assert list(pair.failsafes) == ["volume"]
    far_m = max(float((m.position_ned_m[:2] ** 2).sum() ** 0.5) for m in watch.moments)
    # the autopilot brakes the climb with 2.5 m/s2 after it was asked to land
    assert watch.top_m < limits.get("ceiling_m", 3.0) + 1.25
    assert far_m < limits.get("radius_m", 0.1) + 1.5
    assert not pair.instance.autopilot.commander.armed


RETURNS = {"BATT_LOW_MAH": 1000.0, "BATT_LOW_TIMER": 1.0, "BATT_FS_LOW_ACT": 2.0}


@pytest.mark.parametrize(
    ("on", "then"), [("px4", "AUTO.LOITER"), ("ardupilot", "RTL"), ("ardupilot", "")]
)
def test_an_empty_battery_ends_the_flight(on: str, then: str, tmp_path: Path) -> None:
    """ArduCopter without a battery failsafe is landed; the vehicle's own failsafe has it, and is
    named, though on PX4 the HEARTBEAT that shows it comes after CURRENT_MODE."""
    fly = {"px4": make, "ardupilot": on_arducopter}[on]
    pair = fly(LOW, ONE_LAP, aloft=True, scenario=early("empty_battery"))
    if on == "ardupilot" and then:
        for name, value in RETURNS.items():
            pair.instance.autopilot.parameters.set(name, value)
    watch = watched(pair)
    outcome, engages = pair.fly(), engage_mode(pair)
    assert outcome.exit_code == ExitCode.ABORTED
    if then:
        assert outcome.sentence.startswith(f"the vehicle left {engages} for {then}")
        assert "; a failsafe of the vehicle has it" in outcome.sentence
        assert sent_after(pair, watch.left_s(engages) + REACTION_S) == []
        assert pair.score(tmp_path).ended_by == "failsafe"
    else:
        assert outcome.sentence.startswith("the battery holds 5 %")
        assert not pair.instance.autopilot.commander.armed


@pytest.mark.parametrize(("share", "fly"), alternately(0.8, 0.95))
def test_a_vehicle_without_thrust_reserve_is_landed(share: float, fly: Fly) -> None:
    """Heavier than its file, it is identified; then a load in track, with which it hovers with this
    share of its thrust."""
    scale = float(np.sqrt(share / fly().companion.model.hover_thrust))
    heavier = scenario_of(conditions={"mass_scale": scale})
    pair = fly(HIGH, scenario=heavier, learning=IdentifySettings())
    plant = pair.instance.autopilot.plant
    pair.at.append((in_phase(Phase.TRACK, 1.0), lambda flying: plant.scale_mass(scale)))
    outcome = pair.fly()
    assert not pair.instance.autopilot.commander.armed
    if share < 0.9:  # limits.hover_thrust
        assert outcome.exit_code == ExitCode.FLOWN
    else:
        assert outcome.exit_code == ExitCode.ABORTED
        assert "% of its thrust (limits.hover_thrust)" in outcome.sentence
        assert list(pair.failsafes) == ["thrust reserve"]


@FROM_THE_GROUND
def test_a_load_that_is_only_believed_does_not_end_the_take_off(fly: Fly) -> None:
    """An earlier flight has identified the vehicle with a load that it does not carry any more."""
    file = fly().companion.model
    pair = fly(believed=file.model_copy(update={"hover_thrust": 0.93}))
    assert pair.fly().exit_code == ExitCode.FLOWN
    assert "thrust reserve" not in pair.failsafes


HOVERING = pytest.mark.parametrize(
    "fly", [partial(fly, *SHORT, reference="hover", aloft=True) for _, fly in FIRMWARES]
)


@BOTH
def test_a_reset_of_the_estimate_is_flown(fly: Fly) -> None:
    pair = fly(scenario=early("estimator_jump"))
    watch = watched(pair)
    assert pair.fly().exit_code == ExitCode.FLOWN
    assert watch.error_m < 0.7  # of which the jump is 0.5
    assert pair.failsafes == {}


@HOVERING
def test_the_vehicle_does_not_step_with_its_estimate(fly: Fly) -> None:
    """A reset by 1.5 m in a hover: it moves to its place in the new frame at up to 0.5 m/s."""
    pair = fly("reference.duration_s=8.0", scenario=jumping(1.5))
    watch = watched(pair)
    assert pair.fly().exit_code == ExitCode.FLOWN
    assert said(pair, "the estimated position jumped by 1.50 m: the reference jumps with it")
    assert pair.failsafes == {}
    hovered = np.array([m.position_ned_m[:2] for m in watch.during(Phase.TRACK, Phase.HOVER)])
    speeds_mps = np.linalg.norm(hovered[10:] - hovered[:-10], axis=1) / 0.2
    assert 0.3 < speeds_mps.max() < 0.65
    assert np.linalg.norm(hovered[-1] - hovered[0]) == pytest.approx(1.5, abs=0.1)


@FROM_THE_GROUND
def test_a_reset_of_the_estimate_in_the_take_off_moves_its_place(fly: Fly) -> None:
    """By 1.5 m before lift-off: it flew to the old place, 1.5 m away, at once."""
    reset = {"fault": "estimator_jump", "after": "armed", "offset_ned_m": (1.5, 0.0, 0.4)}
    pair = fly(*SHORT, reference="hover", scenario=scenario_of({**reset, "at_s": 0.3}))
    watch = watched(pair)
    assert pair.fly().exit_code == ExitCode.FLOWN
    assert watch.top_m < 2.2  # ArduCopter takes off to 1.5 m by the old height
    assert max(math.hypot(*m.position_ned_m[:2]) for m in watch.moments) < 0.3


def disarmed_heartbeats(most: float) -> Any:
    """From now on so many HEARTBEATs show the vehicle disarmed, wrongly."""
    codec, wrong = mavlink.MAVLink(None, srcSystem=1, srcComponent=1), []

    def shown(frame: bytes) -> bytes:
        if frame_id(frame) != HEARTBEAT or len(wrong) >= most:
            return frame
        message = decode(frame)
        message.base_mode &= ~mavlink.MAV_MODE_FLAG_SAFETY_ARMED
        wrong.append(message)
        codec.seq = message.get_seq()
        return bytes(message.pack(codec))

    return downlink(lambda _, each: [b"".join(map(shown, frames_of(d))) for d in each])


@pytest.mark.parametrize(("phase", "fly"), alternately(Phase.TRACK, Phase.TAKEOFF, Phase.LAND))
def test_one_heartbeat_that_shows_it_disarmed_ends_no_flight(phase: Phase, fly: Fly) -> None:
    """The vehicle was left in the air, and ArduCopter in its own take-off."""
    wrong = (in_phase(phase, 0.3), disarmed_heartbeats(1))
    pair = fly(aloft=phase is not Phase.TAKEOFF, at=[wrong])
    assert pair.fly() == Outcome(ExitCode.FLOWN, "flown and landed")
    assert pair.at == []


@pytest.mark.parametrize(
    ("phase", "fly"), alternately(Phase.TRACK, Phase.TRACK, Phase.TAKEOFF, Phase.TAKEOFF)
)
def test_a_vehicle_that_flies_and_says_that_it_is_disarmed_is_landed(
    phase: Phase, fly: Fly
) -> None:
    wrong = (in_phase(phase, 0.3), disarmed_heartbeats(math.inf))
    pair = fly(aloft=phase is not Phase.TAKEOFF, at=[wrong])
    outcome = pair.fly()
    assert outcome.exit_code == ExitCode.ABORTED
    assert outcome.sentence.startswith("the vehicle disarmed ")
    for _ in range(3000):
        pair.instance.step()
    assert not pair.instance.autopilot.commander.armed
    assert pair.instance.autopilot.position_controller.landed


@FROM_THE_GROUND
def test_a_vehicle_that_does_not_show_that_it_armed_is_not_left_armed(fly: Fly) -> None:
    pair = fly(at=[(in_phase(Phase.ARM, 0.0), disarmed_heartbeats(math.inf))])
    assert pair.fly().exit_code == ExitCode.REFUSED
    assert [each.param1 for each in pair.commands(ARM)] == [1.0, 0.0]
    assert not pair.instance.autopilot.commander.armed


@HOVERING
def test_a_large_reset_of_the_estimate_is_left_to_the_autopilot(fly: Fly) -> None:
    pair = fly(scenario=jumping(3.0))
    outcome = pair.fly()
    assert outcome.exit_code == ExitCode.ABORTED
    assert outcome.sentence.startswith("the estimated position jumped by 3.0 m")
    assert pair.failsafes["estimator"] is Action.HOLD


@pytest.mark.parametrize(
    ("climbs_m", "moment", "fly"),
    [
        (1.9, {"after": "took_off", "at_s": 6.0}, hover),
        (3.0, {"after": "landing", "at_s": 0.5}, partial(on_arducopter, *SHORT, reference="hover")),
    ],
    ids=["in flight", "in landing"],
)
def test_a_landing_is_judged_by_the_ground_where_a_reset_has_moved_it(
    climbs_m: float, moment: dict[str, Any], fly: Fly, tmp_path: Path
) -> None:
    """The estimated height jumps up, and with it the ground: for the flight and for the score."""
    reset = {"fault": "estimator_jump", "offset_ned_m": (0.0, 0.0, -climbs_m), **moment}
    pair = fly(scenario=scenario_of(reset))
    assert pair.fly() == Outcome(ExitCode.FLOWN, "flown and landed")
    assert pair.companion.contact.height_m == pytest.approx(0.0, abs=0.1)
    assert pair.score(tmp_path).ended_by == "reference over"


GPS_LOST = {"fault": "gps_loss", "after": "engaged", "at_s": 7.0, "drift_mps": 0.45}
SILENT_GPS = {"fault": "silent_message", "message": "GPS_RAW_INT", "after": "engaged", "at_s": 7.0}
ON_PX4 = partial(make, LOW, ONE_LAP, aloft=True, firmware=PX4)
ON_ARDUCOPTER = partial(on_arducopter, LOW, ONE_LAP, aloft=True)
ONLY_ESTIMATOR = partial(ON_PX4, "reference.laps=2", limits={"gps_s": 600.0})


def test_an_accuracy_that_is_not_reported_any_more_is_lost() -> None:
    """PX4 reports NaN. One that was never reported is not missed."""
    vehicle, valid = VehicleState(), EstimatorReport(frozenset(ESTIMATE), (), 0.5)
    unknown = replace(valid, accuracy_m=None)
    for began, now, says in (
        (valid, valid, ""),
        (valid, replace(valid, accuracy_m=9.0), "its estimated position is only accurate to 9.0 m"),
        (valid, unknown, "its estimator reports no accuracy of the position any more"),
        (unknown, unknown, ""),
    ):
        positioning = Positioning()
        vehicle.update(began, 1.0)
        positioning.begin(vehicle, {}, "ESTIMATOR_STATUS")
        vehicle.update(now, 2.0)
        assert positioning.lost(vehicle, Limits()) == says


@pytest.mark.parametrize(
    ("fly", "faults", "says", "within_s", "error_m"),
    [
        (ON_PX4, [GPS_LOST], "GPS has no fix for 1.5 s", 2.0, 1.2),
        (ON_ARDUCOPTER, [GPS_LOST], "GPS has no fix for 1.5 s", 2.0, 1.2),
        (ON_PX4, [GPS_LOST, SILENT_GPS], "no GPS_RAW_INT for 2.5 s", 3.0, 1.6),
        (ONLY_ESTIMATOR, [GPS_LOST], "its estimator has no valid horizontal position", 8.0, 4.0),
    ],
)
def test_a_position_that_is_lost_in_flight_is_landed(
    fly: Fly,
    faults: list[dict[str, Any]],
    says: str,
    within_s: float,
    error_m: float,
    tmp_path: Path,
) -> None:
    """PX4 does not intervene, and ArduCopter late: its estimate drifts away meanwhile."""
    pair = fly(scenario=scenario_of(*faults))
    watch = watched(pair)
    lost_s: list[float] = []
    state = pair.instance.autopilot.state
    pair.at.append((lambda _: not state.gps_healthy, lambda _: lost_s.append(pair.time_s)))
    outcome = pair.fly()
    assert outcome.exit_code == ExitCode.ABORTED
    assert outcome.sentence.startswith(says)
    lands_s = next(at_s for at_s, phase in pair.phases if phase is Phase.LAND)
    assert lands_s < lost_s[0] + within_s
    assert watch.error_m < error_m
    assert pair.commands(LAND)
    assert pair.score(tmp_path).ended_by == "positioning"


@pytest.mark.parametrize("never", [True, False], ids=["never had", "for a moment"])
def test_a_position_that_needs_no_gps_is_flown(never: bool) -> None:
    """By motion capture, without GPS messages; and with a gap of 0.7 s in the fixes."""
    silent = {"fault": "silent_message", "message": "GPS_RAW_INT"}
    moment = silent if never else {**GPS_LOST, "for_s": 0.7}
    pair = ON_PX4(scenario=scenario_of(moment))
    assert pair.fly().exit_code == ExitCode.FLOWN
    assert pair.failsafes == {}


def jumping(offset_m: float) -> Scenario:
    return scenario_of(
        {
            "fault": "estimator_jump",
            "after": "engaged",
            "at_s": 1.5,
            "offset_ned_m": (0.0, offset_m, 0.0),
        }
    )


# -- the end ---------------------------------------------------------------------------------------


@FROM_THE_GROUND
def test_a_fall_in_the_landing_is_not_flown(fly: Fly) -> None:
    pair = fly(scenario="motors_cut", aloft=True)
    outcome = pair.fly()
    assert outcome.exit_code == ExitCode.ABORTED
    assert "disarmed, landing not confirmed: fell at up to" in outcome.sentence


@FROM_THE_GROUND
def test_a_vehicle_that_does_not_detect_its_landing_is_left_to_the_user(fly: Fly) -> None:
    """Only its land detector says whether it flies: it is not disarmed, and the user is told."""
    pair = fly(scenario="never_landed", limits={"land_s": 24.0})
    outcome = pair.fly()
    assert outcome.exit_code == ExitCode.ABORTED
    still_armed = (
        "it has stood still for 15 s and is armed: its land detector reports that it flies"
    )
    assert f"not landed and disarmed after 24 s; {still_armed}" in outcome.sentence
    assert said(pair, still_armed)
    assert pair.instance.autopilot.commander.armed
    assert [m.param1 for m in pair.commands(ARM)] == [1.0]


def test_a_vehicle_that_does_not_disarm_by_itself_is_disarmed() -> None:
    """Its land detector knows the ground. It is asked without force."""
    pair = hover(firmware=PX4)
    pair.instance.autopilot.parameters.set("COM_DISARM_LAND", 0.0)
    assert pair.fly().exit_code == ExitCode.FLOWN
    assert [(m.param1, m.param2) for m in pair.commands(ARM)] == [(1.0, 0.0), (0.0, 0.0)]
    assert said(pair, "15 s without motion on the ground, and the vehicle does not disarm")
