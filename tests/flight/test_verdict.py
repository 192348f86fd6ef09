"""The score of a flight: what the default flight must achieve; the verdict (completed only if the
whole reference was tracked, landed and disarmed; else why not); what must not influence either."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from itertools import count
from pathlib import Path

import numpy as np
import pytest
from faults import ATTITUDE, POSITION, rewritten, setting
from pair import (
    PX4,
    UNIX_EPOCH_US,
    Pair,
    calm_hover,
    frame_id,
    frames_of,
    hover,
    in_phase,
    make,
)
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from typer.testing import CliRunner
from watch import scenario_of, watched

from offboard.analysis.history import History
from offboard.analysis.score import Score, judged, score
from offboard.analysis.score_table import summary, verdict
from offboard.cli.commands import app
from offboard.flight.ground_contact import Touchdown
from offboard.flight.phases import Action, Outcome, Phase
from offboard.identification.learner import IdentifySettings
from offboard.link.log import FlightLog
from offboard.model.frames import thrust_direction_from_quaternion
from simulator import config as simulated


@pytest.fixture(scope="module")
def flown() -> History:
    return calm_hover().history()


def default_flight(scenario: str) -> Pair:
    """Return a finished default flight. Nothing is known of the vehicle before its identification
    in flight."""
    neutral = simulated.vehicle("neutral")
    pair = make(scenario=scenario, believed=neutral, learning=IdentifySettings(), deadline_s=0.05,
                firmware=PX4)  # fmt: skip
    watched(pair)
    assert pair.fly() == Outcome(0, "flown and landed")
    return pair


@pytest.fixture(scope="module")
def px4_like() -> Pair:
    return default_flight("px4_like")


def achieves(pair: Pair, most_m: float) -> None:
    """Check what a flight must achieve."""
    scored = pair.score()
    assert scored.rmse_position_m <= most_m
    assert scored.tracked_s == pytest.approx(16.0, abs=0.3)
    assert scored.setpoint_gap_max_s <= 0.12
    assert scored.missed_ticks == 0
    assert scored.gap_median <= 1e-9
    assert max(pair.failsafes.values(), default=Action.FLY) <= Action.LEVEL
    assert abs(pair.instance.autopilot.state.truth.position_ned_m[2]) < 0.05
    assert not pair.armed
    true_m = max(moment.error_m for moment in pair.watch.during(Phase.TRACK))
    assert scored.max_truth_m == pytest.approx(true_m, abs=0.01)  # a step at 2 m/s


def test_default_flight_tracks_within_4_cm(px4_like: Pair) -> None:
    achieves(px4_like, 0.04)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("scenario", "most_m"),
    [
        ("calm", 0.01),
        ("noise", 0.04),
        ("thrust_minus_15", 0.02),
        ("mass_plus_20", 0.03),
        ("wind_2mps", 0.03),
        ("gusts", 0.06),
    ],
)
def test_default_flight_tracks_well_in_other_scenarios(scenario: str, most_m: float) -> None:
    """All scenarios are flown with the same configuration."""
    achieves(default_flight(scenario), most_m)


def test_decisions_at_the_tilt_limit_are_counted_and_reported() -> None:
    """The wind of `wind_light` needs more than 45 degrees of tilt; setpoints are limited to 45."""
    pair = make("reference.laps=1", reference="lemniscate", vehicle="neutral",
                scenario="wind_light", seed=2, aloft=True)  # fmt: skip
    pair.track()
    flown = pair.history()
    assert np.abs(np.linalg.norm(flown.setpoint["quaternion"], axis=1) - 1.0).max() < 1e-6
    down = thrust_direction_from_quaternion(flown.setpoint["quaternion"])[:, 2]
    tilt_deg = np.degrees(np.arccos(down))
    assert tilt_deg.max() < 45.0 + 1e-3
    limited = tilt_deg > 44.9
    assert limited.sum() > 20
    scored = score(flown)
    assert scored.at_bound_share >= limited.sum() / scored.decisions > 0.1
    texts = summary(scored, flown)
    fixes = "fly slower, in less wind, or with a lower bandwidth of the controller"
    assert texts["at a limit"].endswith(f"% of the decisions: {fixes}")


def test_whole_flight_is_completed(flown: History) -> None:
    whole = score(flown)
    assert (whole.completed, whole.ended_by) == (1.0, "reference over")
    assert whole.tracked_s == pytest.approx(3.0, abs=0.2)
    assert 0.3 < whole.touchdown_mps < 1.2  # MPC_LAND_CRWL is 0.7
    assert whole.at_bound_share == 0.0
    assert "at a limit" not in summary(whole, flown)


def test_completed_flight_must_track_land_and_disarm(flown: History) -> None:
    records, heartbeat = flown.records, flown.heartbeat.copy()
    since_s = records["time_s"] - track_begin_s(flown)
    heartbeat["armed"][-1] = 1
    tracked = records["phase"] == Phase.TRACK.code
    cut = tuple(event for event in flown.phases if event.phase != "hover")  # by damage to the log
    for changed, why in (
        ({"phases": cut}, "the log lacks a part of the flight"),
        ({"records": records[(since_s < 0.45) | (since_s > 2.45)]}, "2.1 s of the reference were"),
        ({"records": records[~tracked | (since_s < 0.05)]}, "too short at full speed to be scored"),
        ({"landed": flown.landed[:0]}, "the land detector does not report the ground"),
        ({"heartbeat": heartbeat}, "not disarmed"),
    ):
        scored = score(replace(flown, **changed))
        assert (scored.completed, scored.ended_by.startswith(why)) == (0.0, True), scored.ended_by


def test_flight_with_ground_contact_is_not_completed() -> None:
    """Without thrust for 0.9 s the vehicle falls 3 m, bounces, and flies on. The time is too short
    for any row of the failsafe, and the outcome is "flown and landed"."""
    fault = {"fault": "motors_cut", "after": "engaged", "at_s": 10.0, "for_s": 0.9}
    pair = hover("reference.height_m=3", "reference.duration_s=8", scenario=scenario_of(fault))
    assert pair.fly() == Outcome(0, "flown and landed")
    scored = pair.score()
    assert scored.ended_by.startswith("it came down to the ground before"), scored.ended_by
    assert scored.completed == 0.0


def test_restart_before_the_flight_is_not_scored() -> None:
    """The stamps of its reports before the restart, in the air, occur again in the flight.
    Regression: both were mixed, and by the score a flight ended 3.3 m above the takeoff point."""
    restarts = {"fault": "reboot", "after": "boot", "at_s": 1.0}
    scenario = scenario_of(restarts, conditions={"clock_start_s": 12.0})
    pair = hover(scenario=scenario, aloft=True)
    assert pair.fly() == Outcome(0, "flown and landed")
    logged = pair.history()
    assert np.diff(logged.position["time_s"]).min() > 0.0
    assert (score(logged).completed, score(logged).ended_by) == (1.0, "reference over")


def test_log_without_a_needed_message_has_a_nan_error(flown: History) -> None:
    whole = score(flown)
    assert whole.rmse_position_m < 0.05
    for part in ("position", "attitude", "setpoint", "reference"):
        rows = getattr(flown, part)
        for kept in (rows[:0], rows[:1]):
            assert math.isnan(score(replace(flown, **{part: kept})).rmse_position_m)
    twice = np.concatenate((flown.reference, flown.reference))
    assert score(replace(flown, reference=twice)).rmse_position_m == whole.rmse_position_m


def test_hover_reference_explains_no_motion(flown: History) -> None:
    """Regression: rounding in its derivatives explained some motion, depending on its position."""
    moved = flown.reference.copy()
    moved["position_ned_m"] += 1 / 3
    told = [score(each).tilt_agitation_deg for each in (flown, replace(flown, reference=moved))]
    assert told[0] == told[1] > 0.0


def test_foreign_senders_and_impossible_values_have_no_effect(flown: History) -> None:
    """With `--system 1` these senders are ignored: another autopilot, heard first; its companion
    with our component id; a ground station with the vehicle's ids; a camera of the same system. So
    are frames of the vehicle with a correct checksum and impossible values, each before a true one.
    """
    text = mavlink.MAVLink_statustext_message(4, b"offboard: land: the battery holds 9 %")
    place = mavlink.MAVLink_local_position_ned_message(10, 9, 9, -9, 9, 9, 9)
    others = [
        (2, 1, mavlink.MAVLink_heartbeat_message(2, 3, 0, 4, 4, 3)),
        (2, 1, place),
        (2, 191, text),
        (1, 1, mavlink.MAVLink_heartbeat_message(6, 8, 128, 0, 5, 3)),  # armed, in a failsafe
        (1, 100, text),
        (1, 100, mavlink.MAVLink_heartbeat_message(30, 8, 128, 0, 5, 3)),
        (1, 100, place),
        (1, 100, mavlink.MAVLink_extended_sys_state_message(0, 2)),
        (1, 100, mavlink.MAVLink_sys_status_message(0, 0, 0, 0, 9000, 0, 5, 0, 0, 0, 0, 0, 0)),
        (1, 192, mavlink.MAVLink_heartbeat_message(18, 8, 0, 0, 4, 3)),
        (1, 192, text),
    ]
    frames = [each.pack(mavlink.MAVLink(None, *ids)) for *ids, each in others]
    turns, wrong = count(), [
        {"y": math.nan}, {"y": -3.4e38}, {"vz": math.inf}, {"time_boot_ms": 2**31},
        {"q2": math.nan}, {"q2": 3e38},
    ]  # fmt: skip

    def among(_: float, heard: list[bytes]) -> list[bytes]:
        if wrong and in_phase(Phase.TRACK, 2.0 - 0.2 * len(wrong))(pair):
            kind = ATTITUDE if "q2" in wrong[0] else POSITION
            own = [each for datagram in heard for each in frames_of(datagram)]
            own = [each for each in own if frame_id(each) == kind]
            if own:
                return [*rewritten(setting(**wrong.pop(0)), kind)(0.0, own), *heard]
        return [*frames, *heard] if heard and next(turns) % 5 == 0 else heard

    pair = hover(system_id=1, down=among)
    assert pair.fly() == calm_hover().companion.outcome
    assert (pair.failsafes, wrong) == ({}, [])
    scored, alone = pair.score(), score(flown)
    assert (scored.completed, scored.ended_by) == (1.0, "reference over")
    assert scored.rmse_position_m == alone.rmse_position_m
    assert scored.max_velocity_mps == alone.max_velocity_mps
    assert scored.tilt_max_deg == alone.tilt_max_deg
    assert [event.what for event in pair.history().modes] == [event.what for event in flown.modes]


def test_requirement_on_a_truncated_log_is_missed(tmp_path: Path) -> None:
    """The log ends in the middle of the track, as after a crash of the computer. Without a
    requirement it is scored."""
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


def touchdown(
    fall_m: float = 0.0, rests_s: float = 2.0, noise_mps: float = 1e-4, before_mps: float = 0.7
) -> Touchdown:
    """Return a landing that was reported at 50 Hz: from 3 m at 0.7 m/s (`before_mps` above that), a
    fall from `fall_m` on, and `rests_s` on the ground."""
    landing, rng = Touchdown((0.0, 0.0, 0.0)), np.random.default_rng(5)
    landing.on_position(-0.02, (0.0, 0.0, -3.1), before_mps)
    time_s, height, down_mps, end_s = 0.0, 3.0, 0.7, math.inf
    while time_s < end_s:
        noise = rng.normal(0.0, noise_mps)  # an estimator never reports the same value twice
        landing.on_position(time_s, (0.0, 0.0, -height), down_mps + noise)
        time_s += 0.02
        if height > 0.0:
            down_mps += 0.02 * 9.81 if height < fall_m else 0.0
            height -= 0.02 * down_mps
        if height <= 0.0 and end_s == math.inf:
            height, down_mps, end_s = 0.0, 0.0, time_s + rests_s
    return landing


def reporting(height_m: float, down_mps: float, changing_mps: float) -> Touchdown:
    """Return a landing with two seconds of reports of the same place."""
    landing = Touchdown((0.0, 0.0, 0.0))
    for tick in range(100):
        landing.on_position(
            0.02 * tick, (3.0, 4.0, -height_m), down_mps + changing_mps * (tick % 2)
        )
    return landing


def test_touchdown_tells_landings_from_falls() -> None:
    """The expected speed is sqrt(v^2 + 2 g h)."""
    soft, hard = touchdown(noise_mps=0.15), touchdown(2.8)
    assert soft.speed_mps == pytest.approx(0.7, abs=0.5)
    assert hard.speed_mps == pytest.approx(math.sqrt(0.7**2 + 2 * 9.81 * 2.8), rel=0.05)
    assert soft.not_landed(on_ground=False) == "the land detector does not report the ground"
    for landing, says in (
        (soft, ""),
        (touchdown(before_mps=3.0), ""),
        (touchdown(rests_s=0.1), "it has not come to rest"),
        (hard, f"fell at up to {hard.speed_mps:.1f} m/s"),
        (reporting(2.8, 0.0, 1e-4), "2.8 m above the takeoff point"),
        (reporting(0.8, 0.7, 0.0), "it has not come to rest"),
    ):
        assert landing.not_landed(on_ground=True) == says


def test_exit_code_0_needs_a_completed_flight(flown: History) -> None:
    """For `fly`, `compare` and the fixture, exit code 0 needs a completed flight."""
    landed, refused = Outcome(0, "flown and landed"), Outcome(3, "not ready")
    completed, fallen = score(flown), Score(completed=0.0, ended_by="fell at up to 5.1 m/s")
    assert judged(landed, completed) == landed
    sentence = "flown and landed, but not completed: fell at up to 5.1 m/s"
    assert judged(landed, fallen) == Outcome(4, sentence)
    assert judged(refused, fallen) == refused
    ended = replace(fallen, ended_by="mode change", reason="the vehicle left OFFBOARD")
    assert verdict(ended) == "not completed (mode change): the vehicle left OFFBOARD"


def test_decision_records_equal_the_sent_setpoints(px4_like: Pair) -> None:
    """Identification steps change the command after the decision, which then has no certificate."""
    flown = px4_like.history()
    excited = flown.records["phase"] == Phase.EXCITE.code
    certified = np.isfinite(flown.records["gap"])
    assert excited.sum() > 20
    assert certified[~excited].all()
    assert 0.0 < certified[excited].mean() < 0.9
    assert score(flown).certified_share == pytest.approx(certified.mean())
    assert score(flown).at_bound_share < 0.01  # steps do not count as decisions at a limit
    rows = np.searchsorted(flown.setpoint["time_s"], flown.records["time_s"])
    sent = thrust_direction_from_quaternion(flown.setpoint["quaternion"][rows])
    recorded = [flown.records[f"thrust_direction_{axis}"] for axis in ("north", "east", "down")]
    assert np.array_equal(flown.setpoint["time_s"][rows], flown.records["time_s"])
    assert np.abs(sent - np.stack(recorded, axis=1)).max() < 1e-6


def beside(flown: History, offset_m: Callable[[np.ndarray], np.ndarray]) -> History:
    """Return the flight as if the vehicle had been on the reference plus an offset to the north."""
    position = flown.position.copy()
    times, reference = position["time_s"], flown.reference
    for axis in range(3):
        position["position_ned_m"][:, axis] = np.interp(
            times, reference["time_s"], reference["position_ned_m"][:, axis]
        )
    position["position_ned_m"][:, 0] += offset_m(times - track_begin_s(flown))
    return replace(flown, position=position)


def track_begin_s(flown: History) -> float:
    track = flown.records["phase"] == Phase.TRACK.code
    return float(flown.records["time_s"][track][0])


def test_thinned_telemetry_does_not_lower_the_error(flown: History) -> None:
    """An error of 1 m for 0.5 of 3 s is an RMSE of sqrt(1/6) m. If only one sample in ten is kept
    meanwhile, the RMSE per sample would be 0.14 m. A gap of 0.4 s while the error falls from 1 m to
    0 counts with its length."""
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
