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
from pair import UNIX_EPOCH_US, calm_hover, hover, make
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from typer.testing import CliRunner

from offboard.analysis.history import History
from offboard.analysis.score import Score, judged, score
from offboard.analysis.score_table import summary, verdict
from offboard.cli.commands import app
from offboard.flight.flight import Outcome
from offboard.flight.ground_contact import Touchdown
from offboard.flight.phases import PHASE_CODES, Phase
from offboard.identification.learner import IdentifySettings
from offboard.link.log import FlightLog
from offboard.model.frames import thrust_direction_from_quaternion

TRACKED_S = 3.0


@pytest.fixture(scope="module")
def flown() -> History:
    return calm_hover().history()


def test_decisions_at_the_tilt_limit_are_counted_and_reported() -> None:
    """The wind of `wind_light` needs more than 45 degrees of tilt, to which the gate turns back."""
    pair = make(reference="lemniscate", vehicle="neutral", scenario="wind_light", seed=2)
    pair.track()
    flown = pair.history()
    down = thrust_direction_from_quaternion(flown.setpoint["quaternion"])[:, 2]
    limited = np.degrees(np.arccos(down)) > 44.9
    assert limited.sum() > 20
    scored = score(flown)
    assert scored.at_bound_share >= limited.sum() / scored.decisions > 0.1
    texts = summary(scored, flown)
    assert texts["at a limit"].endswith("% of the decisions: fly slower, or in less wind")


def test_a_whole_flight_is_completed(flown: History) -> None:
    whole = score(flown)
    assert (whole.completed, whole.ended_by) == (1.0, "reference over")
    assert whole.tracked_s == pytest.approx(TRACKED_S, abs=0.2)
    assert 0.3 < whole.touchdown_mps < 1.2  # MPC_LAND_CRWL is 0.7
    assert whole.at_bound_share == 0.0
    assert "at a limit" not in summary(whole, flown)


def test_others_on_the_link_have_no_effect(flown: History) -> None:
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
    among, alone = pair.score(), score(flown)
    assert (among.completed, among.ended_by) == (1.0, "reference over")
    assert among.rmse_position_m == alone.rmse_position_m


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
    ended = replace(fallen, ended_by="pilot", reason="the vehicle left OFFBOARD")
    assert verdict(ended) == "not completed (pilot): the vehicle left OFFBOARD"


def test_a_record_says_what_was_sent() -> None:
    """Identification steps change the command after the decision: no certificate then."""
    pair = hover(scenario="px4_like", learning=IdentifySettings())
    pair.track()
    flown = pair.history()
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
