"""The figures of one flight.

Tracking, activity and telemetry are scored during the phase TRACK, setpoints from the first one to
the landing, decisions over the whole flight. A figure that the log does not hold is NaN.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields
from typing import Any

from offboard.analysis.history import History
from offboard.analysis.link_metrics import decision_figures, link_figures
from offboard.analysis.tracking import passed_s, tracking_figures, window_of
from offboard.analysis.verdict import verdict_figures

NAN = math.nan


def _figure(meaning: str, unit: str = "") -> float:
    value: float = field(default=NAN, metadata={"meaning": meaning, "unit": unit})
    return value


@dataclass(frozen=True, slots=True)
class Score:
    """All figures of a flight, by the names that --require takes, and what ended it.

    `completed` is 1 if the whole reference was tracked, the vehicle landed by its land detector,
    height and speed, and it was disarmed; else 0, and `ended_by` says why not in a word or a few,
    `reason` in the sentence that the flight announced, if it announced one.

    Errors are relative to the reference, during the phase TRACK: `position` as the vehicle
    estimates it (LOCAL_POSITION_NED), `truth` as it is in the simulator (HIL_STATE_QUATERNION or
    SIM_STATE). RMSE, mean, sd and percentiles of errors and motion are weighted by the time of the
    reference: each sample stands for half of the interval before it and half of the one after it,
    so that telemetry which is thinned or lost counts with the mean of what surrounds it
    (`analysis.samples`). `position_gap_max_s` is the longest gap. The figures of the certificate
    are of the decisions that were sent as they were certified, a share `certified_share` of all.
    Times are vehicle time. A figure that the log does not hold is NaN.

    Example, with the pytest fixture `fly`:

        assert fly(reference="hover").score.rmse_position_m < 0.05
    """

    completed: float = _figure("1: all tracked, landed, disarmed")
    ended_by: str = ""
    reason: str = ""
    touchdown_mps: float = _figure("downward speed at touch-down", "m/s")
    rmse_position_m: float = _figure("position error, RMSE", "m")
    mean_position_m: float = _figure("position error, mean", "m")
    p95_position_m: float = _figure("position error, 95th percentile", "m")
    max_position_m: float = _figure("position error, maximum", "m")
    rmse_truth_m: float = _figure("true position error, RMSE", "m")
    max_truth_m: float = _figure("true position error, maximum", "m")
    rmse_velocity_mps: float = _figure("velocity error, RMSE", "m/s")
    p95_velocity_mps: float = _figure("velocity error, 95th percentile", "m/s")
    max_velocity_mps: float = _figure("velocity error, maximum", "m/s")
    rmse_heading_deg: float = _figure("heading error, RMSE", "deg")
    max_heading_deg: float = _figure("heading error, maximum", "deg")
    mu_e: float = _figure("fitness of the paper, Eq. 31")
    e_u: float = _figure("Eq. 32, body velocity u", "m2/s2")
    e_v: float = _figure("Eq. 32, body velocity v", "m2/s2")
    e_w: float = _figure("Eq. 32, body velocity w", "m2/s2")
    e_x: float = _figure("Eq. 32, north", "m2")
    e_y: float = _figure("Eq. 32, east", "m2")
    e_z: float = _figure("Eq. 32, down", "m2")
    e_psi: float = _figure("Eq. 32, heading", "deg2")
    tracked_s: float = _figure("time of the reference tracked", "s")
    thrust_sd: float = _figure("commanded thrust (0 .. 1), sd")
    tilt_command_step_deg: float = _figure("commanded tilt, RMS of its steps", "deg")
    tilt_max_deg: float = _figure("tilt, maximum", "deg")
    tilt_agitation_deg: float = _figure("tilt beside the reference's, RMS", "deg")
    rate_agitation_radps: float = _figure("rates beside the reference's, RMS", "rad/s")
    roll_rate_sd_radps: float = _figure("roll rate, sd", "rad/s")
    pitch_rate_sd_radps: float = _figure("pitch rate, sd", "rad/s")
    setpoint_hz: float = _figure("setpoints sent", "Hz")
    setpoint_gap_max_s: float = _figure("longest gap of setpoints", "s")
    setpoint_gap_wall_max_s: float = _figure("longest gap of setpoints, wall time", "s")
    answer_p50_ms: float = _figure("telemetry in to setpoint out, median", "ms")
    answer_p99_ms: float = _figure("telemetry in to setpoint out, 99th p.", "ms")
    answer_max_ms: float = _figure("telemetry in to setpoint out, maximum", "ms")
    setpoint_age_p99_ms: float = _figure("telemetry at its setpoint, 99th perc.", "ms")
    setpoint_age_max_ms: float = _figure("telemetry at its setpoint, maximum", "ms")
    missed_ticks: float = _figure("control periods without telemetry")
    skipped_ticks: float = _figure("of these, in pauses of this process")
    pause_max_s: float = _figure("longest pause of this process", "s")
    refused_setpoints: float = _figure("setpoints not sent")
    refused_late: float = _figure("setpoints decided too late")
    refused_stale: float = _figure("setpoints of too old telemetry")
    refused_not_ours: float = _figure("setpoints without authority")
    refused_unusable: float = _figure("setpoints not finite or beyond limits")
    decisions: float = _figure("decisions")
    solve_time_p50_ms: float = _figure("time of a decision, median", "ms")
    solve_time_p99_ms: float = _figure("time of a decision, 99th perc.", "ms")
    certified_share: float = _figure("share of decisions sent as certified")
    gap_median: float = _figure("cost above the exact optimum, median")
    gap_max: float = _figure("cost above the optimum, maximum")
    spread_median: float = _figure("epsilon of Eq. 29, median")
    at_bound_share: float = _figure("share of decisions at a limit")
    cut_short_share: float = _figure("share of decisions cut by deadline")
    other_datagrams: float = _figure("datagrams of others, frames refused")
    position_hz: float = _figure("LOCAL_POSITION_NED received", "Hz")
    attitude_hz: float = _figure("ATTITUDE_QUATERNION received", "Hz")
    position_gap_max_s: float = _figure("longest gap of positions", "s")
    attitude_gap_max_s: float = _figure("longest gap of attitudes", "s")
    stale_share: float = _figure("share of repeated or late positions")
    link_delay_p50_ms: float = _figure("round trip of the link, median", "ms")
    link_delay_p99_ms: float = _figure("round trip of the link, 99th perc.", "ms")
    delay_ms: float = _figure("identified delay to the effect", "ms")
    delay_sd_ms: float = _figure("identified delay, sd", "ms")
    hover_thrust: float = _figure("hover thrust, estimated at the end")
    flight_s: float = _figure("from arming to the end of the log", "s")

    def figures(self) -> dict[str, float]:
        """The figures by name, without the texts."""
        return {name: getattr(self, name) for name in FIGURES}


FIGURES = {figure.name: figure.metadata for figure in fields(Score) if figure.metadata}


def score(flown: History) -> Score:
    """Compute all values of a flight from its columns."""
    window = window_of(flown)
    skipped_s = passed_s(flown, window)[1] if window else 0.0
    values: dict[str, Any] = verdict_figures(flown, skipped_s)
    values |= link_figures(flown, window) | decision_figures(flown)
    if window:
        values |= tracking_figures(flown, window)
    elif values["completed"] == 1.0:
        values |= {"completed": 0.0, "ended_by": "too short at full speed to be scored"}
    return Score(**values)
