"""The metrics of one flight, its verdict, requirements on it, and score.json.

Tracking, activity and telemetry are scored during the phase TRACK, setpoints from the first one to
the landing, decisions over the whole flight. A metric for which the log has no data is NaN.
"""

from __future__ import annotations

import json
import math
import operator
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from offboard.analysis import tlog
from offboard.analysis.history import History, gather
from offboard.analysis.tracking import Track, tracking_metrics
from offboard.analysis.verdict import begin_times, verdict_metrics
from offboard.documents.errors import UserError, meant, plain
from offboard.flight.phases import ExitCode, Outcome, Phase
from offboard.flight.record import DECISION_FAILED, Refusal
from offboard.link.log import LogError, replace_file

Array = NDArray[np.float64]


def _metric(meaning: str, unit: str = "", *, wall: bool = False) -> float:
    """Declare a metric. `wall`: whether it is measured with this computer's clock, and so differs
    between runs of the same flight."""
    about = {"meaning": meaning, "unit": unit, "wall": wall}
    value: float = field(default=math.nan, metadata=about)
    return value


@dataclass(frozen=True, slots=True)
class Score:
    """All metrics of a flight, by the names that --require takes, and what ended it.

    `completed` is 1 if the whole reference was tracked in the air, the vehicle landed according to
    its land detector, height and speed, and it was disarmed; else 0. Then `ended_by` says in a few
    words why, and `reason` is the sentence that the flight announced, or empty.

    Errors are relative to the reference, during the phase TRACK: `position` is the vehicle's own
    estimate (LOCAL_POSITION_NED), `truth` the true position in the simulator (HIL_STATE_QUATERNION
    or SIM_STATE). RMSE, mean, sd and percentiles of errors and motion are weighted by the time of
    the reference: each sample stands for half of the interval before it and half of the one after
    it, so that a gap in the telemetry counts with the mean of the samples around it
    (`analysis.tracking`). Rates and gaps of the telemetry are those in TRACK, too. The metrics of
    the certificate are computed from the decisions that were sent as they were certified, which are
    the share `certified_share` of all. A tick counts as one of `decisions`, `failed_decisions` or
    `missed_ticks`; `refused_setpoints` are among `decisions`. The distance to keep-out volumes is
    no metric; it is the margin `clearance` of a campaign. Times are vehicle time. A metric for
    which the log has no data is NaN.
    """

    completed: float = _metric("1: all tracked, landed, disarmed")
    ended_by: str = ""
    reason: str = ""
    touchdown_mps: float = _metric("downward speed at touch-down", "m/s")
    rmse_position_m: float = _metric("position error, RMSE", "m")
    mean_position_m: float = _metric("position error, mean", "m")
    p95_position_m: float = _metric("position error, 95th percentile", "m")
    max_position_m: float = _metric("position error, maximum", "m")
    rmse_truth_m: float = _metric("true position error, RMSE", "m")
    max_truth_m: float = _metric("true position error, maximum", "m")
    rmse_velocity_mps: float = _metric("velocity error, RMSE", "m/s")
    p95_velocity_mps: float = _metric("velocity error, 95th percentile", "m/s")
    max_velocity_mps: float = _metric("velocity error, maximum", "m/s")
    rmse_heading_deg: float = _metric("heading error, RMSE", "deg")
    max_heading_deg: float = _metric("heading error, maximum", "deg")
    mu_e: float = _metric("fitness of the paper, Eq. 31")
    e_u: float = _metric("Eq. 32, body velocity u", "m2/s2")
    e_v: float = _metric("Eq. 32, body velocity v", "m2/s2")
    e_w: float = _metric("Eq. 32, body velocity w", "m2/s2")
    e_x: float = _metric("Eq. 32, north", "m2")
    e_y: float = _metric("Eq. 32, east", "m2")
    e_z: float = _metric("Eq. 32, down", "m2")
    e_psi: float = _metric("Eq. 32, heading", "deg2")
    tracked_s: float = _metric("time of the reference tracked", "s")
    thrust_sd: float = _metric("commanded thrust (0 .. 1), sd")
    tilt_command_step_deg: float = _metric("commanded tilt, RMS of its steps", "deg")
    tilt_max_deg: float = _metric("tilt, maximum", "deg")
    tilt_agitation_deg: float = _metric("tilt not due to the reference, RMS", "deg")
    rate_agitation_radps: float = _metric("rates not due to the reference, RMS", "rad/s")
    roll_rate_sd_radps: float = _metric("roll rate, sd", "rad/s")
    pitch_rate_sd_radps: float = _metric("pitch rate, sd", "rad/s")
    setpoint_hz: float = _metric("setpoints sent, each repeat counts", "Hz")
    setpoint_gap_max_s: float = _metric("longest gap of setpoints", "s")
    setpoint_gap_wall_max_s: float = _metric("longest gap of setpoints, wall time", "s", wall=True)
    answer_p50_ms: float = _metric("telemetry to setpoint, median", "ms", wall=True)
    answer_p99_ms: float = _metric("telemetry to setpoint, 99th perc.", "ms", wall=True)
    answer_max_ms: float = _metric("telemetry to setpoint, maximum", "ms", wall=True)
    setpoint_age_p99_ms: float = _metric("telemetry age at setpoint, 99th perc.", "ms")
    setpoint_age_max_ms: float = _metric("telemetry age at setpoint, maximum", "ms")
    missed_ticks: float = _metric("control periods without telemetry")
    skipped_ticks: float = _metric("of these, in pauses of this process")
    pause_max_s: float = _metric("longest pause of this process", "s")
    refused_setpoints: float = _metric("setpoints not sent")
    refused_late: float = _metric("setpoints decided too late")
    refused_stale: float = _metric("setpoints from outdated telemetry")
    refused_not_ours: float = _metric("setpoints without authority")
    refused_unusable: float = _metric("setpoints not finite or beyond limits")
    decisions: float = _metric("decisions")
    failed_decisions: float = _metric("decisions that raised an error")
    solve_time_p50_ms: float = _metric("time of a decision, median", "ms", wall=True)
    solve_time_p99_ms: float = _metric("time of a decision, 99th perc.", "ms", wall=True)
    certified_share: float = _metric("share of decisions sent as certified")
    gap_median: float = _metric("cost above the exact optimum, median")
    gap_max: float = _metric("cost above the optimum, maximum")
    spread_median: float = _metric("epsilon of Eq. 29, median")
    at_bound_share: float = _metric("share of decisions at a limit")
    cut_short_share: float = _metric("share of decisions cut by deadline")
    other_datagrams: float = _metric("datagrams of others, frames refused")
    position_hz: float = _metric("LOCAL_POSITION_NED while tracking", "Hz")
    attitude_hz: float = _metric("ATTITUDE_QUATERNION while tracking", "Hz")
    position_gap_max_s: float = _metric("longest gap of positions in tracking", "s")
    attitude_gap_max_s: float = _metric("longest gap of attitudes in tracking", "s")
    stale_share: float = _metric("share of repeated or late positions")
    link_delay_p50_ms: float = _metric("round trip of the link, median", "ms")
    link_delay_p99_ms: float = _metric("round trip of the link, 99th perc.", "ms")
    delay_ms: float = _metric("identified delay to the effect", "ms")
    delay_sd_ms: float = _metric("identified delay, sd", "ms")
    hover_thrust: float = _metric("hover thrust, estimated at the end")
    flight_s: float = _metric("from arming to the end of the log", "s")

    def metrics(self) -> dict[str, float]:
        """The metrics by name, without the texts."""
        return {name: getattr(self, name) for name in METRICS}


METRICS = {each.name: each.metadata for each in fields(Score) if each.metadata}


def score(flown: History) -> Score:
    """Compute all values of a flight from its columns."""
    track = Track.of(flown)
    values: dict[str, Any] = verdict_metrics(flown, track.skipped_s if track else 0.0)
    values |= link_metrics(flown, track) | decision_metrics(flown)
    if track:
        values |= tracking_metrics(flown, track)
    elif values["completed"] == 1.0:
        values |= {"completed": 0.0, "ended_by": "too short at full speed to be scored"}
    return Score(**values)


def score_flight(flight: Path) -> tuple[Score, History]:
    """Score a flight from its log alone.

    `flight` is a flight directory or a .tlog file. Returns the score and the columns and events of
    the log. Raises UserError.

    Example:

        score, history = score_flight(Path("flights/20261121-093000"))
        print(score.rmse_position_m, history.phases)
    """
    flown = gather(tlog.read(flight))
    return score(flown), flown


def judged(outcome: Outcome, score: Score) -> Outcome:
    """Return `outcome`, or ABORTED for a flown flight that is not completed by its log."""
    if outcome.exit_code != ExitCode.FLOWN or score.completed == 1.0:
        return outcome
    return Outcome(ExitCode.ABORTED, f"{outcome.sentence}, but not completed: {score.ended_by}")


def keep_score(directory: Path, score: Score, flown: History) -> None:
    """Write score.json into a flight directory. An older score.json is replaced only when the new
    one is complete. Raises LogError."""
    path = directory / "score.json"
    try:
        replace_file(path, as_text(score, flown))
    except OSError as error:
        raise LogError(f"{path} cannot be written ({error.strerror})") from None


def as_text(score: Score, history: History) -> str:
    """Return all metrics, the events and the number of messages as JSON text; a metric that is NaN
    becomes null."""
    document = {
        "ended_by": score.ended_by,
        "reason": score.reason,
        **score.metrics(),
        **{
            name: [{"time_s": event.time_s, "what": event.what} for event in getattr(history, name)]
            for name in ("phases", "modes", "vehicle_messages")
        },
        "messages": dict(sorted(history.messages.items())),
        "wall_s": history.wall_s,
        "unread": history.unread,
    }
    return json.dumps(plain(document), indent=2, allow_nan=False) + "\n"


_OPERATORS: dict[str, Callable[[float, float], bool]] = {
    "<=": operator.le,
    ">=": operator.ge,
    "==": operator.eq,
    "<": operator.lt,
    ">": operator.gt,
}
_NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
_PATTERN = re.compile(rf"\s*(\w+)\s*(<=|>=|==|<|>)\s*({_NUMBER})\s*")


@dataclass(frozen=True, slots=True)
class Requirement:
    """One metric of the score compared with a number."""

    metric: str
    comparison: str
    limit: float

    @classmethod
    def parse(cls, text: str) -> Requirement:
        """Read 'METRIC<NUMBER'. Raises UserError."""
        match = _PATTERN.fullmatch(text)
        if match is None:
            raise UserError(
                f"{text!r} is not understood; write METRIC<NUMBER, "
                "for example 'rmse_position_m<0.05' (also <=, >, >=, ==)"
            )
        metric, comparison, number = match.groups()
        if metric not in METRICS:
            near = meant(metric, METRICS) or ";"
            raise UserError(f"there is no metric {metric!r}{near} there are {', '.join(METRICS)}")
        return cls(metric, comparison, float(number))

    def met(self, metrics: Mapping[str, float]) -> bool:
        """Whether the metric is as required. A metric without data in the log (NaN) is not."""
        return _OPERATORS[self.comparison](metrics[self.metric], self.limit)

    def sentence(self, metrics: Mapping[str, float]) -> str:
        """Return for example `rmse_position_m is 0.031 (required < 0.05)`."""
        value = metrics[self.metric]
        found = "not in this log" if math.isnan(value) else f"{value:.4g}"
        return f"{self.metric} is {found} (required {self.comparison} {self.limit:g})"


# ---------------------------------------------------------------------- decisions and link

_PERCENT = {"p50": 50, "median": 50, "p99": 99, "max": 100}


def decision_metrics(flown: History) -> dict[str, float]:
    """Return the values of a Score for decisions; without decisions at most `failed_decisions`."""
    columns = flown.records
    failed = float(sum(event.what.startswith(DECISION_FAILED) for event in flown.announcements))
    if not len(columns):
        return {"failed_decisions": failed} if failed else {}
    refused = columns["refused"].astype(np.int64)

    def known(name: str) -> Array:
        values = columns[name].astype(np.float64)
        return values[np.isfinite(values)]

    # A setpoint without certificate was changed by the limits of the last check or, in EXCITE,
    # perhaps by an identification step
    changed = np.isnan(columns["at_bound"]) & np.isfinite(columns["thrust_mps2"])
    limited = changed & (columns["phase"] != Phase.EXCITE.code)
    at_bound = np.where(limited, 1.0, columns["at_bound"])
    skipped = columns["missed_ticks"][columns["pause_s"] > 0.0]
    return {
        "decisions": float(len(refused)),
        "failed_decisions": failed,
        **_named("answer_{}_ms", "p50 p99 max", 1e3 * known("answer_s")),
        **_named("setpoint_age_{}_ms", "p99 max", 1e3 * known("age_s")),
        "missed_ticks": float(known("missed_ticks").sum()),
        "skipped_ticks": float(skipped.sum(dtype=np.float64)),
        "pause_max_s": float(columns["pause_s"].max()),
        "refused_setpoints": float((refused != 0).sum()),
        **{
            f"refused_{name.lower()}": float((refused & flag != 0).sum())
            for name, flag in Refusal.__members__.items()
        },
        "other_datagrams": float(known("other_datagrams").sum()),
        **_named("solve_time_{}_ms", "p50 p99", 1e3 * known("solve_time_s")),
        "certified_share": len(known("gap")) / len(refused),
        **_named("gap_{}", "median max", known("gap")),
        **_named("spread_{}", "median", known("spread")),
        "at_bound_share": _mean(at_bound[np.isfinite(at_bound)]),
        "cut_short_share": _mean(known("cut_short")),
        "hover_thrust": float(columns["hover_thrust"][-1]),
    }


def link_metrics(flown: History, track: Track | None) -> dict[str, float]:
    """Return the values of a Score for setpoints, link and telemetry. Without `track` the rates and
    gaps of the telemetry stay NaN."""
    begun = begin_times(flown.phases)
    last_s = float(flown.position["time_s"][-1]) if len(flown.position) else math.nan
    sent = flown.setpoint[flown.setpoint["time_s"] < begun.get("land", math.inf)]
    values = {"flight_s": last_s - begun.get("takeoff", math.nan)}
    if len(sent) > 1:
        span_s = float(sent["time_s"][-1] - sent["time_s"][0])
        values["setpoint_hz"] = (len(sent) - 1) / span_s if span_s > 0.0 else math.nan
        values["setpoint_gap_max_s"] = float(np.diff(sent["time_s"]).max(initial=0.0))
        values["setpoint_gap_wall_max_s"] = float(np.diff(sent["unix_s"]).max(initial=0.0))
    values |= _named("link_delay_{}_ms", "p50 p99", 1e3 * flown.link_delay["delay_s"])
    _, delays_s = flown.estimates("tilt_delay_s")
    if len(delays_s):
        values["delay_ms"], values["delay_sd_ms"] = (1e3 * delays_s[-1]).tolist()
    if track is None:
        return values
    for name, rows in (("position", flown.position), ("attitude", flown.attitude)):
        stamps = rows["time_s"][track.holds(rows["time_s"])]
        intervals = np.diff(np.maximum.accumulate(stamps))  # 0 for a repeated or late message
        span_s = float(np.ptp(stamps)) if len(stamps) else 0.0
        count = len(np.unique(stamps))
        values[f"{name}_hz"] = (count - 1) / span_s if span_s > 0.0 else math.nan
        values[f"{name}_gap_max_s"] = float(intervals.max(initial=0.0))
        if name == "position":
            values["stale_share"] = _mean(intervals <= 0.0)
    return values


def _named(pattern: str, kinds: str, values: Array) -> dict[str, float]:
    """Return percentiles of the values by name, which is `pattern` with each of `kinds` inserted;
    empty without values."""
    known = kinds.split() if len(values) else ()
    return {pattern.format(kind): float(np.percentile(values, _PERCENT[kind])) for kind in known}


def _mean(values: NDArray[Any]) -> float:
    return float(values.mean()) if len(values) else math.nan
