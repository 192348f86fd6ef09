"""Safety: whose the vehicle is, and what must not happen to it in the air.

Faults that were seen on real autopilots, each flown with the fault of a scenario.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from faults import HEARTBEAT, disarmed, downlink, frame_id, kill_motors, stop, without
from pair import Bytes, Pair, decode, in_phase
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

from offboard.flight.phases import PHASE_CODES, Action, ExitCode, Phase
from offboard.flight.state import Outcome
from offboard.identification.learner import IdentifySettings
from simulator import config as simulated
from simulator.firmware.px4 import PX4
from simulator.start import Start

# -- authority -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("scenario", "on"), alternately("pilot_refuses", "pilot_takes_over", "pilot_comes_back")
)
def test_a_pilot_is_not_overridden(scenario: str, on: Vehicle) -> None:
    """Nothing leaves after the report of the pilot's mode, and the mode is asked for once.

    `pilot_comes_back` is back after 0.6 s, long after the flight has ended.
    """
    pair = on.lap(scenario=early(scenario) if scenario != "pilot_refuses" else scenario)
    watch = aborted(pair, "the vehicle left (OFFBOARD|GUIDED) for", ended_by="pilot")
    left_s = watch.left_s(engage_mode(pair))
    assert len(pair.modes) == 1
    assert pair.landings == []
    assert pair.companion.phase is Phase.YIELDED
    assert pair.armed
    assert sent_after(pair, left_s + REACTION_S) == []
    assert sent_after(pair, left_s - 0.5) != []


def test_current_mode_shows_the_pilot_without_heartbeats() -> None:
    """ArduCopter has no other report: see test_outages."""
    pair = px4.lap(scenario=early("lost_heartbeat"))
    watch = aborted(pair, "the vehicle left OFFBOARD for ")
    assert sent_after(pair, watch.left_s("OFFBOARD") + REACTION_S) == []
    assert pair.landings == []


@BOTH
def test_an_arming_that_is_accepted_late_is_not_taken_for_a_disarming(on: Vehicle) -> None:
    """The link loses the first three requests, and every HEARTBEAT for 2.4 s from the fourth on."""
    asked_s: list[float] = []

    def is_arming(frame: bytes) -> bool:
        message = decode(frame)
        return message.get_type() == "COMMAND_LONG" and message.command == 400

    def up(time_s: float, frames: Bytes) -> Bytes:
        asked_s.extend(time_s for frame in frames if is_arming(frame))
        return [frame for frame in frames if not is_arming(frame) or len(asked_s) > 3]

    def down(time_s: float, datagrams: Bytes) -> Bytes:
        lost = len(asked_s) > 3 and time_s < asked_s[3] + 2.4
        return without(HEARTBEAT)(time_s, datagrams) if lost else datagrams

    pair = on.hop(up=up, down=down)
    while not (pair.companion.phase is Phase.TAKEOFF or pair.companion.has_ended()):
        pair.advance()
    assert pair.companion.phase is Phase.TAKEOFF, pair.companion.outcome
    assert len(asked_s) == 4


def another_companion(**fault: Any) -> Any:
    """A second `offboard fly` that tracks: our own ids."""
    tracks = {"system": 1, "component": 191, "custom_mode": PHASE_CODES[Phase.TRACK]}
    return scenario_of({"fault": "second_sender", **tracks, **fault})


OTHER = another_companion(setpoint_rate_hz=0)
STREAMED = {"fault": "second_sender", "setpoint_rate_hz": 10.0, "thrust": 0.49}
FAILSAFE, IDS, ENGAGED = (
    r".*limits\.begin_in_failsafe=true",
    r".*system 1 component 191 \(limits\.begin_with_other_sender=true",
    r"the vehicle is armed and in (OFFBOARD|GUIDED) already: another.*limits\.begin_engaged=true",
)


@pytest.mark.parametrize(
    ("on", "scenario", "says"),
    [
        (px4, "in_failsafe", FAILSAFE),
        (copter, "in_failsafe", FAILSAFE),
        (px4, OTHER, IDS),
        (copter, OTHER, IDS),
        (px4, scenario_of(STREAMED, start={"height_m": 8.0, "mode": "OFFBOARD"}), ENGAGED),
        (copter, scenario_of(start={"height_m": 8.0, "mode": "GUIDED"}), ENGAGED),
    ],
)
def test_a_vehicle_that_another_has_is_refused(on: Vehicle, scenario: Any, says: str) -> None:
    pair = on.lap(scenario=scenario)
    refused(pair, says)
    assert pair.setpoints == pair.modes == []


def test_a_failsafe_is_taken_over_if_that_is_allowed() -> None:
    pair = copter.lap(scenario="in_failsafe", limits={"begin_in_failsafe": True},
                      at=[(in_phase(Phase.CLIMB, 1.0), stop)])  # fmt: skip
    aborted(pair, "stop requested by the operator")
    assert pair.went_through(Phase.CLIMB)


@BOTH
def test_a_second_sender_is_noticed_in_flight(on: Vehicle) -> None:
    """Hold within a second and what HEARTBEAT takes, then land."""
    pair = on.lap(
        scenario=another_companion(after="engaged", at_s=7.0, setpoint_rate_hz=10, thrust=0.5)
    )
    says = "another program controls the vehicle on this link, too"
    aborted(pair, says, error_m=0.3, ended_by="second sender")
    assert [phase for _, phase in pair.phases][-4:-1] == [Phase.TRACK, Phase.HOLD, Phase.LAND]
    assert not pair.armed


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
    ("moment", "on"), alternately(in_phase(Phase.ENGAGE), in_phase(Phase.TRACK, 1.0))
)
def test_a_second_flight_is_refused_and_the_first_flies_on(moment: Any, on: Vehicle) -> None:
    """By mistake, on another port: it has our ids. It is refused before it sends a setpoint or a
    command that changes the vehicle."""
    first, second = on.hover(), on.hover()
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
def test_a_second_companion_of_other_ids_shows_by_what_it_does(on: Vehicle) -> None:
    """Its setpoints are not on our link: the vehicle no longer follows ours, and is landed."""
    seen = "the attitude is [0-9]+ deg away from every recent command"
    if on is px4:
        seen = "the vehicle follows setpoints of another program"
        pair = on.lap(HIGH, "reference.laps=2", aloft=False, scenario="second_sender")
    else:
        pair = on.lap(HIGH, scenario=early("second_sender"))
    named = "another companion computer, system 1 component 194, may send setpoints, too"
    aborted(pair, f"{seen}; {named}", error_m=5.0)


# -- in the air ------------------------------------------------------------------------------------


def heavier(pair: Pair, scale: float) -> None:
    """From one second of track on."""
    plant = pair.instance.autopilot.plant
    pair.at.append((in_phase(Phase.TRACK, 1.0), lambda flying: plant.scale_mass(scale)))


def test_a_load_that_full_thrust_does_not_carry_is_landed() -> None:
    """Hover would need 1.1 of the thrust. Before this row a real PX4 and a real ArduCopter were
    flown into the ground so, with 45 degrees of tilt."""
    pair = copter.lap(HIGH)
    heavier(pair, 1.1 / pair.companion.model.hover_thrust)
    says = r"the vehicle sinks at [1-3]\.[0-9] m/s with full thrust"
    aborted(pair, says, failsafes=["full thrust"])
    assert begun_s(pair, Phase.LAND) < begun_s(pair, Phase.TRACK) + 1.0 + 2.0


@pytest.mark.parametrize(("share", "on"), alternately(0.95, 0.8))
def test_a_vehicle_without_thrust_reserve_is_landed(share: float, on: Vehicle) -> None:
    """Heavier than its file, it is identified; then a load in track, with which it hovers with this
    share of its thrust (`limits.hover_thrust`: 0.9)."""
    scale = float(np.sqrt(share / on.lap().companion.model.hover_thrust))
    scenario = scenario_of(conditions={"mass_scale": scale})
    pair = on.lap(HIGH, scenario=scenario, learning=IdentifySettings())
    heavier(pair, scale)
    if share < 0.9:
        flown(pair)
    else:
        says = r".*% of its thrust \(limits\.hover_thrust\)"
        aborted(pair, says, failsafes=["thrust reserve"])
    assert not pair.armed


def test_a_load_that_is_only_believed_does_not_end_the_take_off() -> None:
    """An earlier flight has identified the vehicle with a load that it does not carry any more."""
    file = px4.hop().companion.model
    pair = px4.hop(believed=file.model_copy(update={"hover_thrust": 0.93}))
    flown(pair)
    assert "thrust reserve" not in pair.failsafes


@pytest.mark.parametrize(("scenario", "on"), alternately("landed_wrong", "landed_lost"))
def test_in_the_air_it_never_falls(scenario: str, on: Vehicle) -> None:
    """The land detector says ground: never less than a third of hover, never fast downwards."""
    start = Start(height_m=5.0)  # instead of 10 m and 18 m
    low = simulated.scenario(scenario).model_copy(update={"start": start})
    pair = on.lap(HIGH, scenario=low)
    flown(pair, None, "", error_m=0.1, fall_mps=1.6)
    assert not pair.went_through(Phase.TAKEOFF)
    assert pair.went_through(Phase.TRACK)
    least = pair.companion.model.hover_thrust / 3.0
    assert min(setpoint.thrust for _, _, setpoint in pair.setpoints) > least - 1e-6


def test_one_sample_of_velocity_is_no_lift_off() -> None:
    pair = px4.hop(scenario="velocity_spike")
    watch = flown(pair)
    assert -watch.during(Phase.CLIMB)[0].position_ned_m[2] > 0.1
    thrusts = [setpoint.thrust for _, phase, setpoint in pair.setpoints if phase is Phase.TAKEOFF]
    assert all(after - before < 0.05 for before, after in pairwise(thrusts))


def test_twice_the_thrust_does_not_carry_it_away() -> None:
    flown(copter.hop(HIGH, scenario="thrust_doubled"), top_m=3.0 + 1.0, error_m=1.0)


@pytest.mark.parametrize(
    ("case", "on"),
    alternately(({"ceiling_m": 2.0}, "2 m above and 0 m from"), ({"radius_m": 1.0}, ".*1 m from")),
)
def test_the_volume_is_kept(case: tuple[dict[str, float], str], on: Vehicle) -> None:
    """The autopilot brakes the climb with 2.5 m/s2 after it was asked to land."""
    limits, says = case
    pair = on.lap(HIGH, limits=limits, aloft=False)
    top_m = limits.get("ceiling_m", 3.0) + 1.25
    watch = aborted(pair, f"{says} the take-off point", failsafes=["volume"], top_m=top_m)
    far_m = max(float((m.position_ned_m[:2] ** 2).sum() ** 0.5) for m in watch.moments)
    assert far_m < limits.get("radius_m", 0.1) + 1.5
    assert not pair.armed


RETURNS = {"BATT_LOW_MAH": 1000.0, "BATT_LOW_TIMER": 1.0, "BATT_FS_LOW_ACT": 2.0}


@pytest.mark.parametrize(("on", "then"), [(px4, "AUTO.LOITER"), (copter, "RTL"), (copter, "")])
def test_an_empty_battery_ends_the_flight(on: Vehicle, then: str) -> None:
    """ArduCopter without a battery failsafe is landed; the vehicle's own failsafe has it, and is
    named, though on PX4 the HEARTBEAT that shows it comes after CURRENT_MODE."""
    pair = on.lap(scenario=early("empty_battery"))
    if not then:
        aborted(pair, "the battery holds 5 %")
        assert not pair.armed
        return
    for name, value in RETURNS.items() if then == "RTL" else ():
        pair.instance.autopilot.parameters.set(name, value)
    says = f"the vehicle left (OFFBOARD|GUIDED) for {then}.*; a failsafe of the vehicle has it"
    watch = aborted(pair, says, ended_by="failsafe")
    assert sent_after(pair, watch.left_s(engage_mode(pair)) + REACTION_S) == []


def jumping(*offset_ned_m: float, **moment: Any) -> Any:
    """The estimate is reset by so much."""
    when = {"after": "engaged", "at_s": 1.5} | moment
    return scenario_of({"fault": "estimator_jump", "offset_ned_m": offset_ned_m, **when})


def test_a_reset_of_the_estimate_is_flown() -> None:
    pair = copter.lap(scenario=early("estimator_jump"))
    flown(pair, failsafes=(), error_m=0.7)  # of which the jump is 0.5


@BOTH
def test_the_vehicle_does_not_step_with_its_estimate(on: Vehicle) -> None:
    """A reset by 1.5 m in a hover: it moves to its place in the new frame at up to 0.5 m/s."""
    pair = on.hover("reference.duration_s=8.0", scenario=jumping(0.0, 1.5, 0.0))
    watch = flown(pair, failsafes=())
    assert said(pair, "the estimated position jumped by 1.50 m: the reference jumps with it")
    hovered = np.array([m.position_ned_m[:2] for m in watch.during(Phase.TRACK, Phase.HOVER)])
    speeds_mps = np.linalg.norm(hovered[10:] - hovered[:-10], axis=1) / 0.2
    assert 0.3 < speeds_mps.max() < 0.65
    assert np.linalg.norm(hovered[-1] - hovered[0]) == pytest.approx(1.5, abs=0.1)


@BOTH
def test_a_reset_of_the_estimate_in_the_take_off_moves_its_place(on: Vehicle) -> None:
    """By 1.5 m before lift-off: it flew to the old place, 1.5 m away, at once."""
    pair = on.hop(scenario=jumping(1.5, 0.0, 0.4, after="armed", at_s=0.3))
    watch = flown(pair, top_m=2.2)  # ArduCopter takes off to 1.5 m by the old height
    assert max(math.hypot(*m.position_ned_m[:2]) for m in watch.moments) < 0.3


def test_a_large_reset_of_the_estimate_is_left_to_the_autopilot() -> None:
    pair = px4.hover(scenario=jumping(0.0, 3.0, 0.0))
    aborted(pair, "the estimated position jumped by 3.0 m")
    assert pair.failsafes["estimator"] is Action.HOLD


@pytest.mark.parametrize(
    ("on", "climbs_m", "moment"),
    [
        (px4, 1.9, {"after": "took_off", "at_s": 6.0}),
        (copter, 3.0, {"after": "landing", "at_s": 0.5}),
    ],
    ids=["in flight", "in landing"],
)
def test_a_landing_is_judged_by_the_ground_where_a_reset_has_moved_it(
    on: Vehicle, climbs_m: float, moment: dict[str, Any]
) -> None:
    """The estimated height jumps up, and with it the ground: for the flight and for the score."""
    pair = on.hop(scenario=jumping(0.0, 0.0, -climbs_m, **moment))
    flown(pair, ended_by="reference over")
    assert pair.companion.contact.height_m == pytest.approx(0.0, abs=0.1)


@pytest.mark.parametrize(("phase", "on"), alternately(Phase.TRACK, Phase.TAKEOFF, Phase.LAND))
def test_one_heartbeat_that_shows_it_disarmed_ends_no_flight(phase: Phase, on: Vehicle) -> None:
    """The vehicle was left in the air, and ArduCopter in its own take-off."""
    wrong = (in_phase(phase, 0.3), downlink(disarmed(most=1)))
    pair = on.hop(aloft=phase is not Phase.TAKEOFF, at=[wrong])
    flown(pair)
    assert pair.at == []


@pytest.mark.parametrize(("phase", "on"), alternately(Phase.TRACK, Phase.TAKEOFF))
def test_a_vehicle_that_flies_and_says_that_it_is_disarmed_is_landed(
    phase: Phase, on: Vehicle
) -> None:
    wrong = (in_phase(phase, 0.3), downlink(disarmed()))
    pair = on.hop(aloft=phase is not Phase.TAKEOFF, at=[wrong])
    aborted(pair, "the vehicle disarmed ")
    for _ in range(3000):
        pair.instance.step()
    assert not pair.armed
    assert pair.instance.autopilot.position_controller.landed


@BOTH
def test_a_vehicle_that_does_not_show_that_it_armed_is_not_left_armed(on: Vehicle) -> None:
    pair = on.hop(at=[(in_phase(Phase.ARM, 0.0), downlink(disarmed()))])
    refused(pair)
    assert pair.armings == [1.0, 0.0]
    assert not pair.armed


GPS_LOST = {"fault": "gps_loss", "after": "engaged", "at_s": 7.0, "drift_mps": 0.45}
SILENT_GPS = {"fault": "silent_message", "message": "GPS_RAW_INT", "after": "engaged", "at_s": 7.0}
ON_PX4 = partial(px4.lap, firmware=PX4)
ONLY_ESTIMATOR = partial(ON_PX4, "reference.laps=2", limits={"gps_s": 600.0})


@pytest.mark.parametrize(
    ("fly", "faults", "says", "within_s", "error_m"),
    [
        (copter.lap, [GPS_LOST], "GPS has no fix for 1.5 s", 2.0, 1.2),
        (ON_PX4, [GPS_LOST, SILENT_GPS], "no GPS_RAW_INT for 2.5 s", 3.0, 1.6),
        (ONLY_ESTIMATOR, [GPS_LOST], "its estimator has no valid horizontal position", 8.0, 4.0),
    ],
)
def test_a_position_that_is_lost_in_flight_is_landed(
    fly: Callable[..., Pair],
    faults: list[dict[str, Any]],
    says: str,
    within_s: float,
    error_m: float,
) -> None:
    """PX4 does not intervene, and ArduCopter late: its estimate drifts away meanwhile."""
    pair = fly(scenario=scenario_of(*faults))
    lost_s: list[float] = []
    state = pair.instance.autopilot.state
    pair.at.append((lambda _: not state.gps_healthy, lambda _: lost_s.append(pair.time_s)))
    aborted(pair, says, error_m=error_m, ended_by="positioning")
    assert begun_s(pair, Phase.LAND) < lost_s[0] + within_s
    assert pair.landings


def test_a_position_that_needs_no_gps_is_flown() -> None:
    """By motion capture, without GPS messages."""
    silent = {"fault": "silent_message", "message": "GPS_RAW_INT"}
    flown(ON_PX4(scenario=scenario_of(silent)), failsafes=())


# -- the end ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(("height_m", "on"), [(1.5, px4), (0.6, copter)])
def test_a_fall_in_the_landing_is_not_flown(height_m: float, on: Vehicle) -> None:
    """The motors are cut above the ground while it lands: all phases are gone through."""

    def low(pair: Pair) -> bool:
        truth = pair.instance.autopilot.state.truth
        return pair.companion.phase is Phase.LAND and -truth.position_ned_m[2] < height_m

    pair = on.hover(HIGH, at=[(low, kill_motors)])
    aborted(pair, "disarmed, landing not confirmed: fell at up to")
    fallen = pair.score()
    assert fallen.completed == 0.0
    assert "fell at up to " in fallen.ended_by
    fastest_mps = float(fallen.ended_by.split()[-2])
    free_mps = math.sqrt(0.7**2 + 2 * 9.81 * height_m)
    assert 0.75 * free_mps < fastest_mps < free_mps  # less by drag


def test_a_vehicle_that_does_not_detect_its_landing_is_left_to_the_user() -> None:
    """Only its land detector says whether it flies: it is not disarmed, and the user is told."""
    pair = copter.hop(scenario="never_landed", limits={"land_s": 24.0})
    still_armed = (
        "it has stood still for 15 s and is armed: its land detector reports that it flies"
    )
    aborted(pair, f".*not landed and disarmed after 24 s; {still_armed}")
    assert said(pair, still_armed)
    assert pair.armed
    assert pair.armings == [1.0]


def test_a_vehicle_that_does_not_disarm_by_itself_is_disarmed() -> None:
    """Its land detector knows the ground. It is asked without force."""
    pair = px4.hop(firmware=PX4)
    pair.instance.autopilot.parameters.set("COM_DISARM_LAND", 0.0)
    flown(pair)
    assert [(m.param1, m.param2) for m in pair.commands(400)] == [(1.0, 0.0), (0.0, 0.0)]
    assert said(pair, "15 s without motion on the ground, and the vehicle does not disarm")
