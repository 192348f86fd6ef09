"""Safety: old telemetry, slow decisions, pauses of the computer, clocks.

When a setpoint reaches the vehicle, its telemetry is never older than the delay of the link plus
`limits.setpoint_age_s` plus one control period.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import count
from typing import Any

import control
import pytest
from faults import CURRENT_MODE, HEARTBEAT, late, without
from pair import OBEDIENT, Bytes, HostClock, Pair, decode, frame_id, frames_of, hover, in_phase
from watch import (
    HIGH,
    LANDED,
    REQUEST_MESSAGE,
    Vehicle,
    Watch,
    aborted,
    announced,
    begun_s,
    copter,
    early,
    flown,
    px4,
    said,
    scenario_of,
)

from offboard.analysis.score import score
from offboard.analysis.score_table import summary
from offboard.estimation.observer import Observer
from offboard.flight.phases import BEFORE_FLIGHT, Action, ExitCode, Phase
from offboard.identification.learner import IdentifySettings, Learner
from offboard.link.interface import Chunk
from simulator import config as simulated

DEADLINE_S, PERIOD_S = 0.05, 0.1
IN_TRACK = in_phase(Phase.TRACK, 2.0)


def oldest_s(pair: Pair) -> float:
    """Return the greatest age of the telemetry of a setpoint when it reached the vehicle."""
    offset_s = 1e-6 * pair.instance.view.clock_offset_us
    return max(at_s + offset_s - 1e-3 * m.time_boot_ms for at_s, _, m in pair.setpoints)


# -- the link --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("scenario", "on"),
    [("later_and_later", copter), pytest.param("link_saturates", px4, marks=pytest.mark.slow)],
)
def test_growing_link_delay_ends_in_hold_and_landing(scenario: str, on: Vehicle) -> None:
    traffic = {"firmware": OBEDIENT} if on is px4 else {}
    pair = on.lap(
        HIGH, "reference.laps=2", scenario=early(scenario), deadline_s=DEADLINE_S, **traffic
    )
    says = r"telemetry is 0\.[0-9]+ s old|the delay of the link has grown by 0\."
    watch = aborted(pair, says, error_m=0.6, top_m=4.0)
    ends = [Phase.TRACK, Phase.HOLD, Phase.LAND, Phase.DISARMED]
    assert [phase for _, phase in pair.phases][-4:] == ends
    assert pair.failsafes == {"age": Action.LEVEL, "late": Action.HOLD}
    dialect = pair.companion.current.dialect
    assert dialect is not None
    hold = (*dialect.hold().parameters, 0.0)[1:3]  # a missing parameter is sent as 0
    assert hold in [(m.param2, m.param3) for m in pair.modes]
    assert pair.landings
    began, *after = watch.during(Phase.HOLD, Phase.LAND)
    assert all(
        sum((moment.position_ned_m[:2] - began.position_ned_m[:2]) ** 2) < 2.0**2
        for moment in after
    )


POSITION, ATTITUDE = "LOCAL_POSITION_NED", "ATTITUDE_QUATERNION"
NO_POSITION, NOT_SHOWN = (
    "no new LOCAL_POSITION_NED for 0.[56] s",
    "disarmed, landing not confirmed: no new LOCAL_POSITION_NED arrives to show it",
)
# vehicle, message, its fields that repeat (none: all), event and time of the fault, sentence
STUCK = {
    "height": (px4, POSITION, ["z"], ("armed", 0.1), NO_POSITION),
    "height and its velocity": (copter, POSITION, ["z", "vz"], ("armed", 2.5), NO_POSITION),
    "position in the landing": (px4, POSITION, [], ("landing", 0.5), NOT_SHOWN),
    "attitude": (copter, ATTITUDE, [], ("engaged", 2.0), "no new ATTITUDE_QUATERNION for 0.[56] s"),
}


@pytest.mark.parametrize("case", STUCK)
def test_repeated_telemetry_counts_as_missing(case: str) -> None:
    """Values repeat with new stamps, until the end. Thrust is twice that of the vehicle file. The
    vehicle climbs at most 3 m above the last correct height, and is never disarmed in the air."""
    on, message, fields, (after, at_s), says = STUCK[case]
    stuck = {"fault": "stuck_message", "message": message, "fields": fields}
    scenario = scenario_of(
        {**stuck, "after": after, "at_s": at_s}, conditions={"thrust_scale": 2.0}
    )
    on_the_ground = after == "armed"
    pair = on.hop(HIGH, scenario=scenario, aloft=not on_the_ground)
    seen_m: list[float] = []  # the last true height

    def begins(pair: Pair) -> None:
        seen_m.append(-float(pair.instance.autopilot.state.truth.position_ned_m[2]))

    pair.at.append((lambda flying: flying.instance.view.stuck, begins))
    watch = aborted(pair, says)
    lands_s = begun_s(pair, Phase.LAND)
    assert max(-m.position_ned_m[2] for m in watch.moments if m.time_s > lands_s) < seen_m[0] + 3.0
    assert all(m.armed for m in watch.during(Phase.LAND) if m.position_ned_m[2] < -0.1)
    assert pair.armings == ([1.0] if on_the_ground else [])


# -- this computer ---------------------------------------------------------------------------------


def slowly(function: Any, clock: HostClock, seconds: float, after: int = 0) -> Callable[..., Any]:
    """Return the function with a duration of `seconds`, which begins after `after` calls."""
    numbers = count(1)

    def later(*given: Any) -> Any:
        clock.spend(seconds if next(numbers) > after else 0.0)
        return function(*given)

    return later


def slow_law(clock: HostClock, seconds: float, after: int = 0) -> Callable[[Any], Any]:
    def wrap(law: Any) -> Any:
        law.decide = slowly(law.decide, clock, seconds, after)
        return law

    return wrap


@pytest.mark.parametrize(("seconds", "on"), [(0.08, px4), (0.15, copter)])
def test_law_slower_than_the_period_ends_in_a_landing(seconds: float, on: Vehicle) -> None:
    clock = HostClock()
    law = slow_law(clock, seconds, after=59)
    pair = on.lap(wrap=law, deadline_s=DEADLINE_S, clock=clock)
    if seconds < PERIOD_S:
        flown(pair, failsafes=(), error_m=0.1)
        assert oldest_s(pair) < 0.1 + PERIOD_S
        return
    says, rows = "the controller failed: decided 54.0 ms too late", ("decision", "decisions")
    aborted(pair, says, failsafes=rows, error_m=0.5, ended_by="controller")
    assert pair.score().refused_late == 3.0
    assert not pair.armed


@pytest.mark.parametrize(
    ("slow_s", "says", "cause"),
    [
        (
            0.28,
            r"telemetry was too old for a setpoint: .* telemetry that is 0\.2[89] s old \(limits",
            "link",
        ),
        (
            0.16,
            r"this computer was too busy: decided [67][0-9]\.[0-9] ms too late \(limits",
            "computer",
        ),
    ],
)
def test_slow_prediction_is_not_blamed_on_the_law(
    slow_s: float, says: str, cause: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The time is exceeded before the law is called, which then decides at once."""
    clock = HostClock()
    predict = slowly(Observer.predict, clock, slow_s)
    pair = copter.lap(deadline_s=DEADLINE_S, clock=clock)
    pair.at.append((IN_TRACK, lambda _: monkeypatch.setattr(Observer, "predict", predict)))
    aborted(pair, says, failsafes=("decision", "decisions"), ended_by=cause)
    assert not pair.armed


def test_identification_does_not_delay_setpoints(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each piece of the identification takes 60 ms, and a decision 2 ms."""
    clock = HostClock()
    monkeypatch.setattr(Learner, "learn", slowly(Learner.learn, clock, 0.06))
    law = slow_law(clock, 0.002)
    pair = hover(learning=IdentifySettings(), deadline_s=DEADLINE_S, clock=clock, wrap=law)
    pair.track()
    result = pair.score()
    assert result.answer_p50_ms == pytest.approx(2.0, abs=0.01)
    assert result.answer_max_ms < 8.0  # includes a step of the simulation
    assert result.missed_ticks == 0


def test_gains_are_computed_before_lift_off(monkeypatch: pytest.MonkeyPatch) -> None:
    """On the ground a turn may take long. No other test uses this drag, so that no gain of this
    vehicle has been computed before."""
    drag = {"drag_translation_npmps": (0.777, 0.777, 0.777)}
    believed = simulated.vehicle("px4_sih").model_copy(update=drag)
    pair = hover(learning=IdentifySettings(), believed=believed, down=late(0.03), up=late(0.03))
    computed: list[Phase] = []
    dlqr = control.dlqr
    monkeypatch.setattr(
        control, "dlqr", lambda *given: computed.append(pair.companion.phase) or dlqr(*given)
    )
    while pair.companion.phase is not Phase.EXCITE:
        pair.advance()
    assert computed
    assert set(computed) <= BEFORE_FLIGHT | {Phase.TAKEOFF}  # which begins on the ground


def paused(
    on: Vehicle,
    seconds: float,
    code: int = ExitCode.FLOWN,
    says: str = LANDED,
    *,
    when: Callable[[Pair], bool] = IN_TRACK,
    **options: Any,
) -> tuple[Pair, Watch, float]:
    """Fly, and pause the process two seconds into the track, where the acceleration is small.
    Return the pair, the watch, and the time of the end of the pause."""
    pair = on.lap("reference.run_in_s=4.0", deadline_s=DEADLINE_S, **options)
    ends_s: list[float] = []

    def stop(pair: Pair) -> None:
        pair.pause(seconds)
        ends_s.append(pair.time_s + seconds)

    pair.at.append((when, stop))
    return pair, flown(pair, code, says), ends_s[0]


@pytest.mark.parametrize(("seconds", "on"), [(0.9, px4), (3.0, copter)])
def test_one_setpoint_is_sent_after_a_pause(seconds: float, on: Vehicle) -> None:
    """The setpoint is decided from the newest telemetry. The pause is announced and counted. There
    is no supervisor here; it would have taken over in the pause of 3 s."""
    pair, watch, end_s = paused(on, seconds)
    within = [at_s for at_s, _, _ in pair.setpoints if end_s - seconds < at_s < end_s + 0.05]
    assert len(within) <= 1
    assert oldest_s(pair) < 0.03
    assert said(pair, f"this computer paused for {seconds:.2f} s")
    assert watch.error_m < 0.8 or seconds > 1.0  # the vehicle keeps its last attitude meanwhile
    logged = pair.history()
    skipped = round(seconds / PERIOD_S) - 1
    assert score(logged).missed_ticks == skipped
    told = summary(replace(score(logged), at_bound_share=0.5), logged)
    assert "at a limit" not in told  # because this computer is the cause
    for busy in (told["computer"], pair.companion.snapshot().computer):
        assert busy.startswith(f"this computer was too busy: {skipped} of ")
        assert busy.endswith(f" ticks were skipped, pauses up to {seconds:.2f} s")


def test_frequent_announcements_are_summed_once_a_second() -> None:
    """Messages are dropped ten times within 1.3 s, and this process pauses three times."""
    pair = px4.hover("reference.duration_s=5", deadline_s=DEADLINE_S)
    for number in range(10):
        when = in_phase(Phase.TRACK, 2.0 + 0.13 * number)
        pair.at.append((when, lambda pair: pair.companion.on_dropped(2)))
    for number in range(3):
        pair.at.append((in_phase(Phase.TRACK, 2.0 + 0.4 * number), lambda pair: pair.pause(0.32)))
    flown(pair)
    dropped = [
        each for each in announced(pair) if "our messages to the vehicle were not sent" in each
    ]
    pauses = [each for each in announced(pair) if each.startswith("this computer paused")]
    assert sum(int(each.split()[0]) for each in dropped) == 20
    assert len(dropped) <= 3
    assert len(pauses) == 2
    assert "(the longest of 2)" in pauses[1]


def test_px4_in_its_failsafe_gets_no_setpoint_after_a_pause() -> None:
    says = ".*the vehicle's own failsafe flies it, in POSCTL"
    pair, _, end_s = paused(px4, 3.0, ExitCode.ABORTED, says)
    assert pair.went_through(Phase.DISARMED)
    assert [at_s for at_s, _, _ in pair.setpoints if at_s > end_s - 3.0 + 0.01] == []


def test_setpoints_dropped_between_pauses_count_as_missing() -> None:
    """After pauses of 0.5 and 0.55 s, 50 ms apart, PX4 holds by its own failsafe, and is landed
    from there."""
    pair = px4.lap("reference.run_in_s=4.0", deadline_s=DEADLINE_S)
    pair.instance.autopilot.parameters.set("COM_OBL_RC_ACT", 5.0)
    turn, resumes_s = pair.companion.turn, [math.inf]

    def dropping(chunks: Sequence[Chunk], now_s: float) -> tuple[bytes, ...]:
        """Drop the frames of a turn, as the loop does after a pause between turn and sending."""
        frames = turn(chunks, now_s)
        if pair.time_s < resumes_s[0]:
            return frames
        if frames:
            pair.companion.on_dropped(len(frames))
        return ()

    def stop(pair: Pair) -> None:
        resumes_s[0] = pair.time_s + 0.5
        pair.pause(0.5)

    def again(pair: Pair) -> None:
        supervised = pair.companion.supervised
        assert supervised is not None
        assert -0.7 < supervised.setpoint_s - pair.host_s < -0.5  # not yet missing
        resumes_s[0] = math.inf
        pair.pause(0.55)

    pair.companion.turn = dropping  # type: ignore[method-assign]
    pair.at.append((IN_TRACK, stop))
    pair.at.append((lambda pair: pair.time_s > resumes_s[0] + 0.05, again))
    aborted(pair, ".*the vehicle's own failsafe flies it, in AUTO.LOITER")
    assert pair.landings
    assert not pair.armed


def test_mode_report_is_awaited_after_a_pause() -> None:
    """A PX4 sends only HEARTBEAT, at 1 Hz, and receives no request for another one. A HEARTBEAT
    from before the pause is too old: 0.6 s are allowed."""
    beats_s: list[float] = []
    rest = without(CURRENT_MODE)

    def noting(time_s: float, datagrams: Bytes) -> Bytes:
        if any(frame_id(frame) == HEARTBEAT for d in datagrams for frame in frames_of(d)):
            beats_s.append(time_s)
        return rest(time_s, datagrams)

    def just_after_a_beat(pair: Pair) -> bool:
        return IN_TRACK(pair) and 0.28 < pair.time_s - beats_s[-1] < 0.3

    def asks_for_none(_: float, frames: Bytes) -> Bytes:
        return [each for each in frames if getattr(decode(each), "command", 0) != REQUEST_MESSAGE]

    pair, watch, end_s = paused(px4, 0.35, down=noting, up=asks_for_none, when=just_after_a_beat)
    first_s = next(at_s for at_s, _, _ in pair.setpoints if at_s > end_s - 0.34)
    beat_s = next(at_s for at_s in beats_s if at_s > end_s)
    assert 0.3 < beat_s - end_s < 0.4
    assert beat_s <= first_s <= beat_s + PERIOD_S
    assert watch.error_m < 0.45  # wherever on the lap the pause begins


def test_stream_telemetry_is_not_late_after_a_pause() -> None:
    """Bytes of a stream that are read after a pause may have arrived at any time since the turn
    before."""
    pair = px4.hover(at=[(in_phase(Phase.TRACK, 0.5), lambda pair: pair.pause(0.45))])
    session, turn, before_s = pair.companion.session, pair.companion.turn, 0.0
    session.settings = replace(session.settings, stream=True)

    def as_read_from_a_stream(chunks: Sequence[Chunk], now_s: float) -> tuple[bytes, ...]:
        nonlocal before_s
        read, before_s = [replace(chunk, arrived_s=before_s) for chunk in chunks], now_s
        return turn(read, now_s)

    pair.companion.turn = as_read_from_a_stream  # type: ignore[assignment]
    flown(pair)
    assert said(pair, "paused for 0.4")
