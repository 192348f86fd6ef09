"""A score as text for the terminal: the last rows that `fly` prints, and the tables of `score`."""

from __future__ import annotations

import math

from rich.console import Console
from rich.table import Table
from rich.text import Text

from offboard.analysis.history import History
from offboard.analysis.score import METRICS, Score
from offboard.flight.timing import too_busy

# first metric of a section -> title of the section
SECTIONS = {
    "completed": "verdict",
    "rmse_position_m": "tracking",
    "mu_e": "fitness of the paper",
    "tracked_s": "activity",
    "setpoint_hz": "setpoints",
    "decisions": "decisions",
    "position_hz": "telemetry",
    "delay_ms": "vehicle",
}

AT_LIMIT_SHARE = 0.2  # share of decisions at a limit from which the summary mentions it


def summary(score: Score, history: History) -> dict[str, str]:
    """Return the main results of a flight, text by label. Metrics without data in the log are left
    out."""
    rows: dict[str, str] = {}
    if math.isfinite(score.rmse_position_m):
        error = f"{score.rmse_position_m:.3f} m RMSE, {score.max_position_m:.3f} m maximum"
        rows["tracked error"] = f"{error}, over {score.tracked_s:.1f} s"
    if math.isfinite(score.rmse_truth_m):
        error = f"{score.rmse_truth_m:.3f} m RMSE, {score.max_truth_m:.3f} m maximum"
        rows["true error"] = f"{error} (simulated vehicle)"
    undecided = score.missed_ticks + score.failed_decisions
    ticks = score.decisions + undecided
    if math.isfinite(score.answer_p99_ms):
        answer = f"{score.answer_p50_ms:.1f} ms (p99 {score.answer_p99_ms:.1f} ms)"
        missed = f"{undecided + score.refused_setpoints:.0f} of {ticks:.0f} ticks missed"
        rows["timing"] = f"setpoint {answer} after its telemetry, {missed}"
    if busy := too_busy(score.skipped_ticks, ticks, score.pause_max_s):
        rows["computer"] = busy
    elif score.at_bound_share >= AT_LIMIT_SHARE and "tracked error" in rows:
        share = f"{100.0 * score.at_bound_share:.0f} % of the decisions"
        rows["at a limit"] = (
            f"{share}: fly slower, in less wind, or with a lower bandwidth of the controller"
        )
    if score.other_datagrams > 0:
        rows["ignored"] = (
            f"{score.other_datagrams:,.0f} datagrams of others or frames without signature"
        )
    if identified := _identified(history):
        rows["identified"] = identified
    return rows


def verdict(score: Score) -> str:
    """Return whether the flight was completed, and else what ended it, as text."""
    if math.isnan(score.completed):
        return score.ended_by
    if score.completed:
        return "completed"
    said = score.reason or score.ended_by
    if said.startswith(score.ended_by):
        return f"not completed: {said}"
    return f"not completed ({score.ended_by}): {score.reason}"


def _identified(history: History) -> str:
    """Return the last values of the main constants that the flight identified, as text; empty if
    there are none."""
    texts = []
    for constant, text in (
        ("tilt_delay_s", "delay {:.0f} ms"),
        ("tilt_natural_frequency_radps", "tilt {:.1f} rad/s"),
        ("hover_thrust", "hover thrust {:.3f}"),
        ("drag_ps", "drag {:.2f} 1/s"),
    ):
        _, estimates = history.estimates(constant)
        if len(estimates):
            texts.append(text.format(estimates[-1, 0] * (1e3 if "ms" in text else 1.0)))
    return ", ".join(texts)


def show(console: Console, score: Score, history: History) -> None:
    """Print the verdict, the events in the order of time, and every metric that is not NaN."""
    console.print(Text(verdict(score)))
    story = Table(box=None, pad_edge=False)
    story.add_column("t [s]", justify="right")
    story.add_column("who")
    story.add_column("what")
    for event in history.events():
        story.add_row(event.stamp, event.who, Text(event.what))
    if story.rows:
        console.print(story)
    known = {name: value for name, value in score.metrics().items() if not math.isnan(value)}
    if not known:
        console.print("the log has no flight that can be scored")
        return
    metrics = Table(box=None, pad_edge=False, show_header=False)
    metrics.add_column(no_wrap=True)
    metrics.add_column(justify="right")
    metrics.add_column()
    metrics.add_column(style="dim")
    for name, value in score.metrics().items():
        if name in SECTIONS:
            metrics.add_row(Text(f"\n{SECTIONS[name]}", "bold"))
        if name in known:
            metrics.add_row(name, f"{value:.4g}", METRICS[name]["unit"], METRICS[name]["meaning"])
    console.print(metrics)
