"""Safety: old telemetry, slow decisions, pauses of the computer, clocks; and no false alarms.

A setpoint is never older than `limits.setpoint_age_s` beyond the delay of the link, and a control
period, when it reaches the vehicle.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import control
import pytest
from faults import HEARTBEAT, frame_id, late, shuffling, without
from pair import SHORT, Bytes, HostClock, Pair, frames_of, hover, in_phase, on_arducopter
from watch import (
    ARM,
    BOTH,
    FIRMWARES,
    HIGH,
    LAND,
    LOW,
    ONE_LAP,
    SET_MODE,
    Fly,
    Watch,
    alternately,
    early,
    said,
    scenario_of,
    watched,
)

from offboard.analysis import history
from offboard.analysis.score import score
from offboard.analysis.score_table import summary
from offboard.control.base import Controller, Decision, Situation
from offboard.estimation.observer import Observer
from offboard.flight.phases import Action, ExitCode, Phase
from offboard.identification.learner import IdentifySettings, Learner
from simulator import config as simulated

DEADLINE_S, PERIOD_S = 0.05, 0.1
CURRENT_MODE = 436
ON_PX4, ON_ARDUCOPTER = (partial(fly, LOW, ONE_LAP, aloft=True) for _, fly in FIRMWARES)
IN_TRACK = in_phase(Phase.TRACK, 2.0)
HARSH = ("all_together", "lossy_20hz", "delay_100ms")


def ages_s(pair: Pair, since_s: float = 0.0) -> list[float]:
    """Age of each setpoint's telemetry when it reached the vehicle."""
    offset_s = 1e-6 * pair.instance.view.clock_offset_us
    return [
        at_s + offset_s - 1e-3 * m.time_boot_ms for at_s, _, m in pair.setpoints if at_s > since_s
    ]


# -- the link --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("scenario", "fly"), alternately("late_link", "later_and_later", "link_saturates")
)
def test_a_link_that_becomes_late_ends_in_hold_and_landing(scenario: str, fly: Fly) -> None:
    pair = fly(HIGH, "reference.laps=2", aloft=False, scenario=scenario, deadline_s=DEADLINE_S)
    watch = watched(pair)
    outcome = pair.fly()
    assert outcome.exit_code == ExitCode.ABORTED
    assert outcome.sentence.startswith("the delay of the link has grown by 0.")
    assert [phase for _, phase in pair.phases][-4:] == [
        Phase.TRACK, Phase.HOLD, Phase.LAND, Phase.DISARMED,
    ]  # fmt: skip
    assert pair.failsafes == {"age": Action.LEVEL, "link": Action.HOLD}
    dialect = pair.companion.current.dialect
    assert dialect is not None
    hold = dialect.hold().parameters[1:3]
    assert hold in [(m.param2, m.param3) for m in pair.commands(SET_MODE)]
    assert pair.commands(LAND)
    assert watch.error_m < 0.6
    assert watch.top_m < 4.0
    began = watch.during(Phase.HOLD)[0]
    assert all(
        sum((moment.position_ned_m[:2] - began.position_ned_m[:2]) ** 2) < 2.0**2
        for moment in watch.during(Phase.HOLD, Phase.LAND)
    )


@pytest.mark.parametrize(
    "fly", [partial(fly, *SHORT, reference="hover", aloft=True) for _, fly in FIRMWARES]
)
def test_nothing_leaves_2_5_s_after_the_last_report_of_the_mode(fly: Fly) -> None:
    """All telemetry stops, so that the vehicle's clock stands still; setpoints would go on."""
    pair = fly(limits={"silence_s": 5.0})
    stopped_s: list[float] = []

    def stop(flying: Pair) -> None:
        stopped_s.append(flying.time_s)
        flying.down = lambda time_s, datagrams: []

    pair.at.append((in_phase(Phase.TRACK, 1.0), stop))
    while not stopped_s or pair.time_s < stopped_s[0] + 6.0:
        pair.advance()
    assert pair.companion.phase is Phase.LAND  # its end: "dies in flight" in test_scenarios.py
    left_s = [at_s for at_s, _, _ in pair.setpoints]
    assert stopped_s[0] + 1.0 < left_s[-1] <= stopped_s[0] + 2.5 + 0.02
    assert pair.commands(SET_MODE)[1:] == pair.commands(LAND) == []


@pytest.mark.parametrize("seed", [1, 2])
def test_reports_of_the_mode_that_arrive_out_of_order_end_no_flight(seed: int) -> None:
    pair = on_arducopter(*SHORT, reference="hover", aloft=True, down=shuffling(seed))
    assert pair.fly().exit_code == ExitCode.FLOWN


@BOTH
def test_a_saturated_link_does_no_harm(fly: Fly) -> None:
    pair = fly(HIGH, scenario="saturated_link", deadline_s=DEADLINE_S)
    watch = watched(pair)
    pair.fly()
    assert watch.fall_mps < 1.5
    assert watch.top_m < 4.0
    assert not pair.instance.autopilot.commander.armed


POSITION, ATTITUDE = "LOCAL_POSITION_NED", "ATTITUDE_QUATERNION"
ARMED, IN_FLIGHT = {"after": "armed", "at_s": 0.1}, {"after": "engaged", "at_s": 7.0}
RISING = {"after": "armed", "at_s": 2.5}
STUCK = {
    "armed": (ARMED, {POSITION: []}, "no new LOCAL_POSITION_NED for 0.[56] s"),
    "track": (IN_FLIGHT, {POSITION: []}, "no new LOCAL_POSITION_NED for 0.[56] s"),
    "landing": (
        {"after": "landing", "at_s": 0.5},
        {POSITION: []},
        "disarmed, landing not confirmed: no LOCAL_POSITION_NED shows it",
    ),
    "attitude": (IN_FLIGHT, {ATTITUDE: []}, "no new ATTITUDE_QUATERNION for 0.[56] s"),
    "both": (IN_FLIGHT, {POSITION: [], ATTITUDE: []}, "no telemetry for 1.0 s"),
    "height": (ARMED, {POSITION: ["z", "vz"]}, "no new LOCAL_POSITION_NED for 0.[56] s"),
    "climb": (RISING, {POSITION: ["z", "vz"]}, "no new LOCAL_POSITION_NED for 0.[56] s"),
    "height alone": (ARMED, {POSITION: ["z"]}, "no new LOCAL_POSITION_NED for 0.[56] s"),
}


@pytest.mark.parametrize(("case", "fly"), alternately(*STUCK))
def test_telemetry_that_repeats_itself_is_none(case: str, fly: Fly) -> None:
    """With new stamps and for good, on the ground with a velocity of zero; or only the height, with
    or without its velocity. Thrust is twice what the
    file says; the vehicle stays within 3 m of the height that was seen last, and is never disarmed
    in the air."""
    moment, messages, says = STUCK[case]
    on_the_ground = moment in (ARMED, RISING)
    faults = [
        {"fault": "stuck_message", "message": each, "fields": fields, **moment}
        for each, fields in messages.items()
    ]
    scenario = scenario_of(*faults, conditions={"thrust_scale": 2.0})
    pair = fly(HIGH, scenario=scenario, aloft=not on_the_ground)
    watch = watched(pair)
    seen_m: list[float] = []  # the last true height
    begins = (lambda flying: flying.instance.view.stuck, lambda _: seen_m.append(watch.height_m))
    pair.at.append(begins)
    outcome = pair.fly()
    assert outcome.exit_code == ExitCode.ABORTED
    assert re.match(says, outcome.sentence)
    begun_s = next(at_s for at_s, phase in pair.phases if phase is Phase.LAND)
    assert max(-m.position_ned_m[2] for m in watch.moments if m.time_s > begun_s) < seen_m[0] + 3.0
    assert all(m.armed for m in watch.during(Phase.LAND) if m.position_ned_m[2] < -0.1)
    assert [m.param1 for m in pair.commands(ARM)] == ([1.0] if on_the_ground else [])


@BOTH
def test_thin_telemetry_is_flown(fly: Fly) -> None:
    """Every tenth position, on a vehicle that is heavier meanwhile."""
    pair = fly(scenario=early("thin_telemetry", 5.0))
    watch = watched(pair)
    assert pair.fly().exit_code == ExitCode.FLOWN
    assert watch.error_m < 0.3
    assert pair.failsafes == {}


# -- this computer ---------------------------------------------------------------------------------


class Slow:
    """A law that computes for `seconds` from its 60th decision on."""

    def __init__(self, law: Controller, clock: HostClock, seconds: float) -> None:
        self._law, self._clock, self._seconds = law, clock, seconds
        self._count = 0
        self.reset = law.reset

    def decide(self, situation: Situation) -> Decision:
        self._count += 1
        if self._count > 60:
            self._clock.spend(self._seconds)
        return self._law.decide(situation)


def with_slow_law(fly: Fly, seconds: float) -> tuple[Pair, Watch]:
    clock = HostClock()
    pair = fly(wrap=lambda law: Slow(law, clock, seconds), deadline_s=DEADLINE_S, clock=clock)
    watch = watched(pair)
    return pair, watch


@pytest.mark.parametrize(
    ("case", "fly"), alternately((0.15, "0.05 s too late"), (0.3, "0.30 s old"))
)
def test_a_slow_law_is_late_and_then_landed(
    case: tuple[float, str], fly: Fly, tmp_path: Path
) -> None:
    seconds, why = case
    pair, watch = with_slow_law(fly, seconds)
    outcome = pair.fly()
    assert outcome.exit_code == ExitCode.ABORTED
    assert outcome.sentence.startswith("the controller failed: decided ")
    assert why in outcome.sentence
    assert pair.failsafes == {"decision": Action.LEVEL, "decisions": Action.LAND}
    assert pair.score(tmp_path).ended_by == "controller"
    texts = [frame for frame in pair.logged if frame[7:10] == b"\xfd\0\0"]  # STATUSTEXT
    assert sum(b"decision missed: decided" in frame for frame in texts) == 3
    assert watch.error_m < 0.5
    assert not pair.instance.autopilot.commander.armed


@BOTH
def test_a_slow_prediction_is_no_failure_of_the_law(
    fly: Fly, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The telemetry becomes too old before the law is asked, which then decides at once."""
    clock = HostClock()
    predict = Observer.predict

    def slow(*arguments: Any) -> Any:
        clock.spend(0.28)
        return predict(*arguments)

    pair = fly(deadline_s=DEADLINE_S, clock=clock)
    pair.at.append((IN_TRACK, lambda _: monkeypatch.setattr(Observer, "predict", slow)))
    outcome = pair.fly()
    assert outcome.exit_code == ExitCode.ABORTED
    old = r"telemetry was too old for a setpoint: decided on telemetry that is 0\.2[89] s old"
    assert re.fullmatch(old, outcome.sentence)
    assert pair.failsafes == {"decision": Action.LEVEL, "decisions": Action.LAND}
    assert pair.score(tmp_path).ended_by == "link"
    assert not pair.instance.autopilot.commander.armed


@BOTH
def test_a_law_that_needs_most_of_the_period_is_flown(fly: Fly) -> None:
    pair, watch = with_slow_law(fly, 0.08)
    assert pair.fly().exit_code == ExitCode.FLOWN
    assert watch.error_m < 0.1
    assert pair.failsafes == {}
    assert max(ages_s(pair)) < 0.1 + PERIOD_S


def test_no_setpoint_waits_for_the_identification(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each of its pieces takes 60 ms, and the decision 2 ms."""
    clock = HostClock()
    identify = Learner.learn

    def slow(*arguments: Any) -> Any:
        clock.spend(0.06)
        return identify(*arguments)

    def deciding(law: Controller) -> Controller:
        decide = law.decide

        def later(situation: Situation) -> Decision:
            clock.spend(0.002)
            return decide(situation)

        law.decide = later  # type: ignore[method-assign]
        return law

    monkeypatch.setattr(Learner, "learn", slow)
    pair = hover(learning=IdentifySettings(), deadline_s=DEADLINE_S, clock=clock, wrap=deciding)
    pair.track()
    result = pair.score(tmp_path)
    assert result.answer_p50_ms == pytest.approx(2.0, abs=0.01)
    assert result.answer_max_ms < 8.0  # with a step of the simulation
    assert result.missed_ticks == 0


def test_at_lift_off_no_gain_is_computed_any_more(monkeypatch: pytest.MonkeyPatch) -> None:
    """On the ground a turn may take long. The vehicle's drag is one that no other test has, so that
    nothing is known of it before."""
    computed = [0]
    dlqr = control.dlqr

    def counted(*arguments: Any) -> Any:
        computed[-1] += 1
        return dlqr(*arguments)

    monkeypatch.setattr(control, "dlqr", counted)
    drag_npmps = (0.777, 0.777, 0.777)
    believed = simulated.vehicle("px4_sih").model_copy(
        update={"drag_translation_npmps": drag_npmps}
    )
    link = {"down": late(0.03), "up": late(0.03)}
    pair = hover(learning=IdentifySettings(), believed=believed, **link)
    while not in_phase(Phase.TAKEOFF, 0.5)(pair):
        pair.advance()
    computed.append(0)
    while pair.companion.phase is not Phase.EXCITE:
        pair.advance()
    before, at_lift_off = computed
    assert before > 0
    assert at_lift_off == 0


def paused(
    fly: Fly,
    seconds: float,
    when: Callable[[Pair], bool] = IN_TRACK,
    **options: Any,
) -> tuple[Pair, Watch, float]:
    """The process is stopped, two seconds into the track; the end of the stop."""
    pair = fly(deadline_s=DEADLINE_S, **options)
    ends_s: list[float] = []

    def stop(pair: Pair) -> None:
        pair.pause(seconds)
        ends_s.append(pair.time_s + seconds)

    pair.at.append((when, stop))
    watch = watched(pair)
    pair.fly()
    return pair, watch, ends_s[0]


@pytest.mark.parametrize(("seconds", "fly"), alternately(0.5, 0.9))
def test_after_a_pause_one_setpoint_leaves(seconds: float, fly: Fly, tmp_path: Path) -> None:
    """From the newest telemetry; the pause is announced and counted."""
    pair, watch, end_s = paused(fly, seconds)
    assert pair.companion.outcome is not None
    assert pair.companion.outcome.exit_code == ExitCode.FLOWN
    within = [at_s for at_s, _, _ in pair.setpoints if end_s - seconds < at_s < end_s + 0.05]
    assert len(within) <= 1
    assert max(ages_s(pair)) < 0.03
    assert said(pair, f"this computer paused for {seconds:.2f} s")
    assert watch.error_m < 0.8  # the last attitude is kept meanwhile
    flown = history.gather(pair.log(tmp_path))
    skipped = round(seconds / PERIOD_S) - 1
    assert score(flown).missed_ticks == skipped
    told = summary(replace(score(flown), at_bound_share=0.5), flown)
    assert "at a limit" not in told  # whose cause is this computer
    for busy in (told["computer"], pair.companion.snapshot().computer):
        assert busy.startswith(f"this computer was too busy: {skipped} of ")
        assert busy.endswith(f" ticks were skipped, pauses up to {seconds:.2f} s")


def test_what_happens_often_is_told_once_a_second_and_summed_up() -> None:
    """Ten times within 1.3 s messages are dropped, and this process pauses three times."""
    pair = ON_PX4(deadline_s=DEADLINE_S)
    for number in range(10):
        when = in_phase(Phase.TRACK, 2.0 + 0.13 * number)
        pair.at.append((when, lambda pair: pair.companion.on_dropped(2)))
    for number in range(3):
        pair.at.append((in_phase(Phase.TRACK, 2.0 + 0.4 * number), lambda pair: pair.pause(0.32)))
    pair.fly()
    said = pair.companion.announced
    dropped = [each for each in said if "of our messages to the vehicle dropped" in each]
    pauses = [each for each in said if each.startswith("this computer paused")]
    assert sum(int(each.split()[0]) for each in dropped) == 20
    assert len(dropped) <= 3
    assert len(pauses) == 2
    assert "(the longest of 2)" in pauses[1]


def test_after_three_seconds_a_px4_in_its_failsafe_is_landed_without_a_setpoint() -> None:
    pair, _, end_s = paused(ON_PX4, 3.0)
    outcome = pair.companion.outcome
    assert outcome is not None
    assert outcome.exit_code == ExitCode.ABORTED
    assert "the vehicle's own failsafe flies it, in POSCTL" in outcome.sentence
    assert pair.went_through(Phase.DISARMED)
    assert [at_s for at_s, _, _ in pair.setpoints if at_s > end_s - 3.0 + 0.01] == []


def test_after_three_seconds_an_arducopter_gets_nothing_old() -> None:
    """It is still in GUIDED, and ours. The supervisor would have taken over; this is without it."""
    pair, _, end_s = paused(ON_ARDUCOPTER, 3.0)
    assert pair.went_through(Phase.DISARMED)
    assert said(pair, "this computer paused for 3.00 s")
    assert len([True for at_s, _, _ in pair.setpoints if end_s - 2.9 < at_s < end_s + 0.05]) <= 1
    assert max(ages_s(pair, end_s - 2.9)) < 0.03


def test_after_a_pause_a_report_of_the_mode_is_awaited() -> None:
    """A PX4 with HEARTBEAT alone, at 1 Hz: one that arrived more than 0.6 s ago does not count."""
    beats_s: list[float] = []
    rest = without(CURRENT_MODE)

    def noting(time_s: float, datagrams: Bytes) -> Bytes:
        if any(frame_id(frame) == HEARTBEAT for d in datagrams for frame in frames_of(d)):
            beats_s.append(time_s)
        return rest(time_s, datagrams)

    def just_after_a_beat(pair: Pair) -> bool:
        return IN_TRACK(pair) and 0.28 < pair.time_s - beats_s[-1] < 0.3

    pair, watch, end_s = paused(ON_PX4, 0.35, down=noting, when=just_after_a_beat)
    first_s = next(at_s for at_s, _, _ in pair.setpoints if at_s > end_s - 0.34)
    beat_s = next(at_s for at_s in beats_s if at_s > end_s)
    assert 0.3 < beat_s - end_s < 0.4
    assert beat_s <= first_s <= beat_s + PERIOD_S
    assert pair.companion.outcome is not None
    assert pair.companion.outcome.exit_code == ExitCode.FLOWN
    assert watch.error_m < 0.3


# -- the vehicle's clock ---------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("case", "fly"), alternately(("clock_jump", "3.0"), ("clock_jump_35s", "35.0"))
)
def test_a_jump_of_the_clock_lands(case: tuple[str, str], fly: Fly, tmp_path: Path) -> None:
    scenario, jump = case
    pair = fly(scenario=early(scenario), deadline_s=DEADLINE_S)
    outcome = pair.fly()
    assert outcome.exit_code == ExitCode.ABORTED
    assert outcome.sentence == f"the clock of the vehicle jumped by {jump} s"
    assert pair.phases[-1][1] is Phase.DISARMED
    assert pair.score(tmp_path).completed == 0.0
    level = [m for _, phase, m in pair.setpoints if phase is Phase.LAND]
    assert all(abs(m.q[1]) + abs(m.q[2]) < 1e-6 for m in level)


@BOTH
def test_a_clock_that_wraps_is_flown(fly: Fly) -> None:
    wraps = simulated.scenario("clock_wrap")
    before_s = 2.0**32 / 1e3 - 22.0  # it has hovered for a while when its links open
    conditions = wraps.conditions.model_copy(update={"clock_start_s": before_s})
    pair = fly(scenario=wraps.model_copy(update={"conditions": conditions}), deadline_s=DEADLINE_S)
    watch = watched(pair)
    assert pair.fly().exit_code == ExitCode.FLOWN
    assert watch.error_m < 0.05
    assert pair.failsafes == {}
    stamps_ms = [m.time_boot_ms for _, _, m in pair.setpoints]
    assert max(stamps_ms) > 2**32 - 1000
    assert min(stamps_ms) < 1000


# -- no false alarms -------------------------------------------------------------------------------


@pytest.mark.parametrize(("scenario", "fly"), alternately(*HARSH))
def test_a_normal_flight_needs_no_failsafe(scenario: str, fly: Fly) -> None:
    """As `offboard fly` does it: nothing known of the vehicle, identified in flight. Milder
    scenarios are in test_figures.py."""
    pair = fly(
        aloft=False,
        scenario=scenario,
        believed=simulated.vehicle("neutral"),
        learning=IdentifySettings(),
        deadline_s=DEADLINE_S,
        seed=1 + HARSH.index(scenario),
    )
    outcome = pair.fly()
    assert (outcome.exit_code, outcome.sentence) == (ExitCode.FLOWN, "flown and landed")
    assert max(pair.failsafes.values(), default=Action.FLY) <= Action.LEVEL
