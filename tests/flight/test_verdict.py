"""The verdict of the score: completed only if all was tracked, landed and disarmed; else why not.

Also what the score must not depend on: the rate of the telemetry, jumps and the wrap of its clock.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from faults import die, kill_motors, stop, take_over
from pair import UNIX_EPOCH_US, Pair, calm_hover, decode, frames_of, hover, in_phase, make
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from typer.testing import CliRunner

from offboard.analysis import history, tlog
from offboard.analysis.history import OUR_COMPONENTS, History
from offboard.analysis.score import Score, judged, score
from offboard.analysis.score_table import summary, verdict
from offboard.cli.commands import app
from offboard.flight.flight import Outcome
from offboard.flight.ground_contact import Touchdown
from offboard.flight.phases import PHASE_CODES, Phase
from offboard.identification.learner import IdentifySettings
from offboard.link.log import FlightLog
from offboard.model.frames import thrust_direction_from_quaternion

WRAP_MS = 2**32
TRACKED_S = 3.0
STAMPED = {"LOCAL_POSITION_NED", "ATTITUDE_QUATERNION"}


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> History:
    return history.gather(calm_hover().log(tmp_path_factory.mktemp("flown")))


def test_decisions_at_the_tilt_limit_are_counted_and_reported(tmp_path: Path) -> None:
    """The wind of `wind_light` needs more than 45 degrees of tilt, to which the gate turns back."""
    pair = make(reference="lemniscate", vehicle="neutral", scenario="wind_light", seed=2)
    pair.track()
    flown = history.gather(pair.log(tmp_path))
    down = thrust_direction_from_quaternion(flown.setpoint["quaternion"])[:, 2]
    limited = np.degrees(np.arccos(down)) > 44.9
    assert limited.sum() > 20
    scored = score(flown)
    assert scored.at_bound_share >= limited.sum() / scored.decisions > 0.1
    texts = summary(scored, flown)
    assert texts["at a limit"].endswith("% of the decisions: fly slower, or in less wind")


def test_a_calm_flight_is_not_at_a_limit(flown: History) -> None:
    scored = score(flown)
    assert scored.at_bound_share == 0.0
    assert "at a limit" not in summary(scored, flown)


def test_a_whole_flight_is_completed(flown: History) -> None:
    whole = score(flown)
    assert (whole.completed, whole.ended_by) == (1.0, "reference over")
    assert whole.tracked_s == pytest.approx(TRACKED_S, abs=0.2)
    assert 0.3 < whole.touchdown_mps < 1.2  # MPC_LAND_CRWL is 0.7


def judged_by(pair: Pair, directory: Path) -> tuple[object, ...]:
    """Verdict, touch-down and events of the log."""
    flown = history.gather(pair.log(directory))
    judged = score(flown)
    rows = [repr(event) for event in flown.events()]  # a NaN does not equal itself
    return judged.completed, judged.ended_by, judged.reason, repr(judged.touchdown_mps), rows


def judged_without_texts(pair: Pair, directory: Path) -> tuple[object, ...]:
    """The same of the log without any STATUSTEXT of ours."""
    ours = [
        frame
        for frame in pair.logged
        if frame[7:10] == b"\xfd\0\0" and decode(frame).get_srcComponent() in OUR_COMPONENTS
    ]
    assert len(ours) > 5
    return judged_by(replace(pair, logged=[f for f in pair.logged if f not in ours]), directory)


def test_the_verdict_needs_no_texts(tmp_path: Path) -> None:
    muted = judged_without_texts(calm_hover(), tmp_path / "mute")
    assert muted == judged_by(calm_hover(), tmp_path / "log")
    assert muted[:2] == (1.0, "reference over")
    begun = [
        event.phase for event in history.gather(tlog.read(tlog.find(tmp_path / "mute"))).phases
    ]
    assert (begun[0], begun[-1]) == ("health", "disarmed")
    assert {"arm", "takeoff", "track", "hover", "land"} < set(begun)


def our_ids(pair: Pair) -> None:
    """Another program says that it tracks: the autopilot is asked to hold, then to land."""
    frame = mavlink.MAVLink_heartbeat_message(18, 8, 0, 8, 4, 3).pack(mavlink.MAVLink(None, 1, 191))
    pair.down = lambda _, datagrams: [*datagrams, frame]


@pytest.mark.parametrize(
    ("moment", "act", "ended_by"),
    [
        (in_phase(Phase.TRACK, 1.0), stop, "operator"),
        (in_phase(Phase.TRACK, 1.0), take_over, "pilot"),
        (in_phase(Phase.LAND, 0.5), take_over, "pilot"),
        (in_phase(Phase.TRACK, 1.0), die, "link"),
        (in_phase(Phase.TRACK, 1.0), our_ids, "second sender"),
        (in_phase(Phase.TRACK, 1.0), kill_motors, "disarmed in flight"),
        (in_phase(Phase.ARM), stop, "operator"),
    ],
)
def test_a_flight_that_ended_early_says_what_ended_it(
    moment: Callable[[Pair], bool], act: Callable[[Pair], None], ended_by: str, tmp_path: Path
) -> None:
    pair = hover(at=[(moment, act)])
    assert pair.fly().exit_code != 0
    ended = pair.score(tmp_path)
    assert (ended.completed, ended.ended_by) == (0.0, ended_by)
    assert judged_without_texts(pair, tmp_path / "mute") == judged_by(pair, tmp_path / "log")
    assert ended.reason
    assert any(line.endswith(f": {ended.reason}") for line in pair.companion.announced)
    assert verdict(ended) == f"not completed ({ended_by}): {ended.reason}"


def test_others_on_the_link_have_no_effect(flown: History, tmp_path: Path) -> None:
    """Another autopilot, heard first, its companion with our component id, and a camera of the same
    system: none of them is what `--system 1` flies."""
    battery = mavlink.MAVLink_sys_status_message(0, 0, 0, 0, 9000, 0, 5, 0, 0, 0, 0, 0, 0)
    text = b"offboard: land: the battery holds 9 %"
    others = [
        (2, 1, mavlink.MAVLink_heartbeat_message(2, 3, 0, 4, 4, 3)),
        (2, 1, mavlink.MAVLink_local_position_ned_message(10, 9, 9, -9, 9, 9, 9)),
        (2, 191, mavlink.MAVLink_statustext_message(4, text)),
        (1, 100, mavlink.MAVLink_statustext_message(4, text)),
        (1, 100, mavlink.MAVLink_heartbeat_message(30, 8, 128, 0, 5, 3)),
        (1, 100, mavlink.MAVLink_local_position_ned_message(10, 9, 9, -9, 9, 9, 9)),
        (1, 100, mavlink.MAVLink_extended_sys_state_message(0, 2)),
        (1, 100, battery),
        (1, 192, mavlink.MAVLink_heartbeat_message(18, 8, 0, 0, 4, 3)),
        (1, 192, mavlink.MAVLink_statustext_message(4, text)),
    ]
    frames = [each.pack(mavlink.MAVLink(None, *ids)) for *ids, each in others]
    pair = hover(system_id=1, down=lambda _, heard: [*frames, *heard] if heard else [])
    assert pair.fly() == calm_hover().companion.outcome
    assert pair.failsafes == {}
    among = score(history.gather(pair.log(tmp_path)))
    alone = score(flown)
    assert (among.completed, among.ended_by) == (1.0, "reference over")
    assert among.rmse_position_m == alone.rmse_position_m


@pytest.mark.parametrize("height", [1.5, 0.6])
def test_a_fall_is_no_landing(height: float, tmp_path: Path) -> None:
    """The motors are cut above the ground while it lands: all phases are gone through."""

    def low(pair: Pair) -> bool:
        return pair.companion.phase is Phase.LAND and height_m(pair) < height

    assignments = ("reference.height_m=3.0", "reference.duration_s=1.0")
    pair = make(*assignments, reference="hover", at=[(low, kill_motors)])
    pair.fly()
    assert pair.companion.phase is Phase.FAILED
    fallen = pair.score(tmp_path)
    assert fallen.completed == 0.0
    assert "fell at up to " in fallen.ended_by
    fastest_mps = float(fallen.ended_by.split()[-2])
    free_mps = math.sqrt(0.7**2 + 2 * 9.81 * height)
    assert 0.75 * free_mps < fastest_mps < free_mps  # less by drag


def height_m(pair: Pair) -> float:
    return -float(pair.instance.autopilot.state.truth.position_ned_m[2])


def test_a_requirement_on_a_cut_log_is_missed(tmp_path: Path) -> None:
    """In the middle of the track, as after a crash of the machine; without a requirement it is
    scored."""
    frames = calm_hover().logged
    track = next(n for n, frame in enumerate(frames) if b"offboard: track" in frame)
    with FlightLog(tmp_path / "cut", "") as log:
        for number, frame in enumerate(frames[: track + 500]):
            log.write(UNIX_EPOCH_US + 100 * number, frame)
    command = ["score", str(tmp_path / "cut"), "--require", "rmse_position_m<9"]
    assert CliRunner().invoke(app, command[:2]).exit_code == 0
    required = CliRunner().invoke(app, command)
    assert required.output.startswith("not completed: the log ends in the phase track\n")
    assert required.exception is not None
    assert "not completed: the log ends in the phase track" in str(required.exception)


def touchdown(fall_m: float, *, rests_s: float, noise_mps: float = 0.0) -> Touchdown:
    """A descent at 0.7 m/s from 3 m, a fall from `fall_m`, then the ground; 50 Hz."""
    landing, rng = Touchdown((0.0, 0.0, 0.0)), np.random.default_rng(5)
    time_s, height, down_mps, end_s = 0.0, 3.0, 0.7, math.inf
    while time_s < end_s:
        noise = rng.normal(0.0, max(noise_mps, 1e-4))  # no estimator repeats itself
        landing.on_position(time_s, (0.0, 0.0, -height), down_mps + noise)
        time_s += 0.02
        if height > 0.0:
            down_mps += 0.02 * 9.81 if height < fall_m else 0.0
            height -= 0.02 * down_mps
        if height <= 0.0 and end_s == math.inf:
            height, down_mps, end_s = 0.0, 0.0, time_s + rests_s
    return landing


def test_landings_and_falls() -> None:
    """Speeds by sqrt(v^2 + 2 g h)."""
    soft = touchdown(0.0, rests_s=2.0, noise_mps=0.15)
    assert soft.not_landed(on_ground=True) == ""
    assert soft.speed_mps == pytest.approx(0.7, abs=0.5)
    assert soft.not_landed(on_ground=False) == "the land detector does not report the ground"
    assert touchdown(0.0, rests_s=0.1).not_landed(on_ground=True) == "it has not come to rest"
    hard = touchdown(2.8, rests_s=2.0)
    assert hard.speed_mps == pytest.approx(math.sqrt(0.7**2 + 2 * 9.81 * 2.8), rel=0.05)
    assert hard.not_landed(on_ground=True) == f"fell at up to {hard.speed_mps:.1f} m/s"
    hovering = Touchdown((0.0, 0.0, 0.0))
    for tick in range(100):
        hovering.on_position(0.02 * tick, (3.0, 4.0, -2.8), 1e-4 * (tick % 2))
    assert hovering.not_landed(on_ground=True) == "2.8 m above the take-off point"
    frozen = Touchdown((0.0, 0.0, 0.0))
    for tick in range(100):
        frozen.on_position(0.02 * tick, (3.0, 4.0, -0.8), 0.7)
    assert frozen.not_landed(on_ground=True) == "it has not come to rest"


def test_the_outcome_follows_the_log(flown: History) -> None:
    """`fly`, `compare` and the fixture: an exit code of 0 needs a completed flight."""
    landed, refused = Outcome(0, "flown and landed"), Outcome(3, "not ready")
    completed, fallen = score(flown), Score(completed=0.0, ended_by="fell at up to 5.1 m/s")
    assert judged(landed, completed) == landed
    sentence = "flown and landed, but not completed: fell at up to 5.1 m/s"
    assert judged(landed, fallen) == Outcome(4, sentence)
    assert judged(refused, fallen) == refused


def test_a_record_says_what_was_sent(tmp_path: Path) -> None:
    """Identification steps change the command after the decision: no certificate then."""
    pair = hover(scenario="px4_like", learning=IdentifySettings())
    pair.track()
    flown = history.gather(pair.log(tmp_path))
    excited = flown.records["phase"] == PHASE_CODES[Phase.EXCITE]
    certified = np.isfinite(flown.records["gap"])
    assert excited.sum() > 20
    assert certified[~excited].all()
    assert 0.0 < certified[excited].mean() < 0.9
    assert score(flown).certified_share == pytest.approx(certified.mean())
    rows = np.searchsorted(flown.setpoint["time_s"], flown.records["time_s"])
    sent = thrust_direction_from_quaternion(flown.setpoint["quaternion"][rows])
    recorded = [flown.records[f"thrust_direction_{axis}"] for axis in ("north", "east", "down")]
    assert np.array_equal(flown.setpoint["time_s"][rows], flown.records["time_s"])
    assert np.abs(sent - np.stack(recorded, axis=1)).max() < 1e-6


# --- what the figures must not depend on ----------------------------------------------------------


def beside(flown: History, offset_m: Callable[[np.ndarray], np.ndarray]) -> History:
    """The flight as if the vehicle had been on the reference but for an offset to the north."""
    position = flown.position.copy()
    times, reference = position["time_s"], flown.reference
    for axis in range(3):
        position["position_ned_m"][:, axis] = np.interp(
            times, reference["time_s"], reference["position_ned_m"][:, axis]
        )
    position["position_ned_m"][:, 0] += offset_m(times - track_begin_s(flown))
    return replace(flown, position=position)


def track_begin_s(flown: History) -> float:
    track = flown.records["phase"] == PHASE_CODES[Phase.TRACK]
    return float(flown.records["time_s"][track][0])


def test_thinned_telemetry_does_not_lower_the_error(flown: History) -> None:
    """1 m off for 0.5 of 3 s: sqrt(1/6) m; with one sample in ten meanwhile, per sample it would be
    0.14 m. A gap of 0.4 s while the error falls from 1 m to 0 counts with its length."""
    off = beside(flown, lambda t: np.where((t >= 1.0) & (t < 1.5), 1.0, 0.0))
    in_track_s = off.position["time_s"] - track_begin_s(off)
    expected_m = math.sqrt(0.5 / score(off).tracked_s)
    assert score(off).rmse_position_m == pytest.approx(expected_m, rel=0.03)
    kept = (in_track_s < 1.0) | (in_track_s >= 1.5) | (np.arange(len(in_track_s)) % 10 == 0)
    thinned = replace(off, position=off.position[kept])
    assert score(thinned).rmse_position_m == pytest.approx(expected_m, rel=0.12)
    lost = (in_track_s > 1.3) & (in_track_s < 1.7)
    gap = score(replace(off, position=off.position[~lost]))
    assert gap.rmse_position_m == pytest.approx(expected_m, rel=0.03)
    assert gap.position_gap_max_s == pytest.approx(0.4, abs=0.02)


def jumped(flown: History, by_s: float, *, reference_too: bool) -> History:
    """The flight with the vehicle's clock jumping in the middle of the track."""
    moment_s = track_begin_s(flown) + 1.5
    tables = {}
    for name in ("position", "attitude", "truth", "reference", "setpoint", "landed", "heartbeat"):
        rows = getattr(flown, name).copy()
        rows["time_s"][rows["time_s"] > moment_s] += by_s
        tables[name] = rows
    records = flown.records.copy()
    late = records["time_s"] > moment_s
    if reference_too:
        records["track_time_s"][late] += by_s
    records["time_s"][late] += by_s
    phases = tuple(
        replace(event, time_s=event.time_s + (by_s if event.time_s > moment_s else 0.0))
        for event in flown.phases
    )
    return replace(flown, **tables, records=records, phases=phases)


@pytest.mark.parametrize("by_s", [3.0, 35.0])
def test_a_jump_of_the_clock_is_not_tracked(flown: History, by_s: float) -> None:
    """Where the reference jumps too, a part of it was not flown. Where it does not, nothing is
    missing, and the error is that of the flight without the jump."""
    whole = score(flown)
    stepped = score(jumped(flown, by_s, reference_too=True))
    assert stepped.completed == 0.0
    assert stepped.ended_by == f"{by_s + 0.1:.1f} s of the reference were not tracked"
    assert stepped.tracked_s == pytest.approx(whole.tracked_s - 0.1, abs=0.02)
    steady = score(jumped(flown, by_s, reference_too=False))
    assert (steady.completed, steady.tracked_s) == (1.0, whole.tracked_s)
    assert steady.rmse_position_m == pytest.approx(whole.rmse_position_m, rel=0.01)


def later(by_ms: int) -> Callable[[float, list[bytes]], list[bytes]]:
    """A link on which the vehicle's clock is later, and its stamps wrap."""
    codec = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)

    def restamped(frame: bytes) -> bytes:
        message = decode(frame)
        if message.get_type() in STAMPED:
            message.time_boot_ms = (message.time_boot_ms + by_ms) % WRAP_MS
        elif message.get_type() == "TIMESYNC":
            message.tc1 += by_ms * 10**6
        else:
            return frame
        codec.seq = frame[4]
        return bytes(message.pack(codec))

    return lambda _, datagrams: [b"".join(map(restamped, frames_of(d))) for d in datagrams]


def test_a_flight_across_the_wrap_of_the_clock(flown: History, tmp_path: Path) -> None:
    """`time_boot_ms` begins again at zero in the middle of the track."""
    by_ms = WRAP_MS - round(1e3 * (track_begin_s(flown) + 1.5))
    pair = hover(down=later(by_ms))
    outcome = pair.fly()
    assert (outcome.exit_code, outcome.sentence) == (0, "flown and landed")
    wrapped, whole = pair.score(tmp_path), score(flown)
    assert (wrapped.completed, wrapped.ended_by) == (1.0, "reference over")
    assert wrapped.tracked_s == pytest.approx(whole.tracked_s, abs=0.1)  # ticks fall elsewhere
    assert wrapped.rmse_position_m == pytest.approx(whole.rmse_position_m, abs=1e-3)
    assert wrapped.link_delay_p50_ms == pytest.approx(whole.link_delay_p50_ms, abs=1.0)
    again = history.gather(tlog.read(tmp_path / "flight.tlog"))
    for rows in (again.position, again.reference, again.setpoint):
        assert np.diff(rows["time_s"]).min() >= 0.0
        assert np.diff(rows["time_s"]).max() < 1.0


def test_stretch_that_is_too_short_to_be_scored_is_not_flown(tmp_path: Path) -> None:
    """One tick at full speed has no figures of the tracking."""
    table = tmp_path / "short.csv"
    rows = "0,0,0,3\n0.7,0.1,0,3\n1.4,0,0,3\n2.04,0,0,3\n"
    table.write_text(f"time_s,north_m,east_m,altitude_m\n{rows}")
    pair = make(reference=str(table))
    assert pair.fly().exit_code == 0
    scored = pair.score(tmp_path)
    assert math.isnan(scored.rmse_position_m)
    assert (scored.completed, scored.ended_by) == (0.0, "too short at full speed to be scored")
