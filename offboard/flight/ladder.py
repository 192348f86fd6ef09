"""The ladder: what follows when a limit is exceeded in flight. One row for each condition.

The rung of the worst row that is active counts. A row is active once its condition has held for
its delay. The time that it has held runs down at a quarter of the speed while the condition does
not hold, so that a condition that comes and goes does not start from zero each time.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from offboard.flight import guards
from offboard.flight.facts import Facts
from offboard.flight.phases import Rung

RECOVERY = 0.25  # speed at which a delay runs back
SINK_MPS = 0.3  # that full thrust stops within the delay, on a vehicle that can be flown
STEP_MAX_S = 0.2  # what one sample counts for, also after a gap of telemetry


@dataclass(frozen=True, slots=True)
class LadderRow:
    """`rung` is taken when `exceeded` has held for `delay_s`. The names in braces in `reason` are
    keys of `facts.figures`. `meaning` and `limit` are for the documentation."""

    name: str
    meaning: str
    limit: str
    exceeded: guards.Guard
    delay_s: float
    rung: Rung
    reason: str


ROWS = (
    LadderRow(
        "authority",
        "age of the newest report of the mode",
        "2.5 s",
        guards.authority_unknown,
        0.0,
        Rung.LAND,  # of which nothing is asked before the mode is known again
        "no report of the mode for {authority_age_s:.1f} s: another may control the vehicle",
    ),
    LadderRow(
        "silence",
        "host time without position and attitude",
        "limits.silence_s",
        guards.silent,
        0.0,
        Rung.LAND,
        "no telemetry for {silence_s:.1f} s",
    ),
    LadderRow(
        "blind",
        "age of the older of position and attitude",
        "limits.blind_s",
        guards.blind,
        0.0,
        Rung.LAND,
        "no {blind_to} for {blind_s:.1f} s",
    ),
    LadderRow(
        "age",
        "age of the newest telemetry beyond the known delay of the link",
        "limits.setpoint_age_s",
        lambda now: now.telemetry_age_s > now.limits.setpoint_age_s,
        0.0,
        Rung.LEVEL,
        "telemetry is {telemetry_age_s:.2f} s old",
    ),
    LadderRow(
        "link",
        "growth of the link's delay since take-off (TIMESYNC), or the age of telemetry",
        "limits.link_growth_s, limits.setpoint_age_s",
        lambda now: (
            now.link_growth_s > now.limits.link_growth_s
            or now.telemetry_age_s > now.limits.setpoint_age_s
        ),
        0.5,
        Rung.HOLD,
        "the delay of the link has grown by {link_growth_s:.2f} s",
    ),
    LadderRow(
        "decision",
        "a decision failed, came too late, or was not fit to be sent",
        "one",
        lambda now: now.missed_decisions > 0,
        0.0,
        Rung.LEVEL,
        "{failure}",
    ),
    LadderRow(
        "decisions",
        "decisions missed in a row",
        "limits.missed_decisions",
        lambda now: now.missed_decisions >= now.limits.missed_decisions,
        0.0,
        Rung.LAND,
        "{failure}",
    ),
    LadderRow(
        "tilt",
        "tilt of the vehicle",
        "limits.tilt_rad",
        lambda now: now.tilt_rad > now.limits.tilt_rad,
        0.0,
        Rung.LAND,
        "tilt {tilt_deg:.0f} deg",
    ),
    LadderRow(
        "tilt error",
        "angle between the thrust direction and the nearest of the newest commands",
        "limits.tilt_error_rad",
        lambda now: now.tilt_error_rad > now.limits.tilt_error_rad,
        0.5,
        Rung.LAND,
        "the attitude is {tilt_error_deg:.0f} deg away from every recent command{companion}",
    ),
    LadderRow(
        "position error",
        "distance from the reference",
        "limits.position_error_m",
        lambda now: now.position_error_m > now.limits.position_error_m,
        0.0,
        Rung.LAND,
        "{position_error_m:.1f} m from the reference (limit {position_error_limit_m:.1f} m)"
        "{companion}",
    ),
    LadderRow(
        "prediction",
        "distance from the position that the decision before predicted",
        "limits.prediction_error_m",
        lambda now: now.prediction_error_m > now.limits.prediction_error_m,
        0.3,
        Rung.HOLD,
        "{prediction_error_m:.1f} m from the predicted position",
    ),
    LadderRow(
        "estimator",
        "jumps of the reported position in the last 10 s",
        "limits.position_jump_m",
        lambda now: now.position_jump_m > now.limits.position_jump_m,
        0.0,
        Rung.HOLD,
        "the estimated position jumped by {position_jump_m:.1f} m",
    ),
    LadderRow(
        "positioning",
        "GPS fix, validity and accuracy of the estimate, their messages: lost since take-off",
        "limits.gps_s, limits.accuracy_m",
        lambda now: now.positioning_lost,
        0.5,
        Rung.LAND,
        "{positioning}",
    ),
    LadderRow(
        "volume",
        "height and distance from the take-off point",
        "limits.ceiling_m, limits.radius_m",
        lambda now: now.height_m > now.limits.ceiling_m or now.distance_m > now.limits.radius_m,
        0.0,
        Rung.LAND,
        "{height_m:.0f} m above and {distance_m:.0f} m from the take-off point "
        "(limits.ceiling_m, limits.radius_m)",
    ),
    LadderRow(
        "battery",
        "remaining charge",
        "limits.battery",
        lambda now: now.battery < now.limits.battery,
        2.0,
        Rung.LAND,
        "the battery holds {battery_percent:.0f} %",
    ),
    LadderRow(
        "thrust reserve",
        "normalised thrust that hovers now",
        "limits.hover_thrust",
        lambda now: now.hover_thrust > now.limits.hover_thrust,
        2.0,
        Rung.LAND,
        "the vehicle hovers with {hover_thrust_percent:.0f} % of its thrust (limits.hover_thrust)",
    ),
    LadderRow(
        "full thrust",
        "downward speed while setpoints demand the full thrust",
        f"{SINK_MPS:g} m/s",
        lambda now: now.full_thrust_sink_mps > SINK_MPS,
        1.0,
        Rung.LAND,
        "the vehicle sinks at {full_thrust_sink_mps:.1f} m/s with full thrust",
    ),
    LadderRow(
        "second sender",
        "another program sends setpoints or commands modes on this link, or says in its HEARTBEAT "
        "that it flies the vehicle",
        "one message",
        guards.other_sender,
        0.0,
        Rung.HOLD,
        "another program controls the vehicle on this link, too: {other_sender}",
    ),
    LadderRow(
        "other setpoints",
        "thrust of the setpoint that PX4 follows (ATTITUDE_TARGET): none of our newest 40",
        "1e-5",
        guards.follows_others,
        2.5,  # a pilot's change of the mode is seen within this time, or `authority` acts
        Rung.HOLD,
        "the vehicle follows setpoints of another program{companion}",
    ),
    LadderRow(
        "clock",
        "jump of the vehicle's clock",
        "0.5 s",
        lambda now: now.clock_jump_s > 0.0,
        0.0,
        Rung.LAND,
        "the clock of the vehicle jumped by {clock_jump_s:.1f} s",
    ),
    LadderRow(
        "contradiction",
        "identified constants out of bounds",
        "BOUNDS of identification",
        lambda now: now.contradicted,
        0.0,
        Rung.LAND,
        "{contradiction}",
    ),
)


class Ladder:
    """How long each condition has held, and the worst row that is active."""

    def __init__(self) -> None:
        self._held_s: Mapping[str, float] = {}
        self._stepped_s: float | None = None
        self.worst: LadderRow | None = None

    @property
    def held_s(self) -> Mapping[str, float]:
        """For how long each condition has held, by the name of its row."""
        return self._held_s

    @property
    def rung(self) -> Rung:
        return self.worst.rung if self.worst else Rung.FLY

    def step(self, now: Facts, time_s: float) -> None:
        """Judge the facts of `time_s`, any monotonic time."""
        passed_s = 0.0 if self._stepped_s is None else time_s - self._stepped_s
        step_s = min(max(passed_s, 0.0), STEP_MAX_S)
        self._stepped_s = time_s
        exceeded = {row.name: row.exceeded(now) for row in ROWS}
        self._held_s = {name: self._held(name, holds, step_s) for name, holds in exceeded.items()}
        active = [r for r in ROWS if exceeded[r.name] and self._held_s[r.name] >= r.delay_s]
        self.worst = max(active, key=lambda row: row.rung, default=None)

    def _held(self, name: str, holds: bool, step_s: float) -> float:
        held_s = self._held_s.get(name, 0.0)
        return held_s + step_s if holds else max(held_s - RECOVERY * step_s, 0.0)


def markdown() -> str:
    """The table for the README of `flight/`."""
    lines = ["| row | what is measured | limit | held for | then |", "|---|---|---|---|---|"]
    for row in ROWS:
        then = row.rung.name.lower()
        lines.append(f"| {row.name} | {row.meaning} | {row.limit} | {row.delay_s:g} s | {then} |")
    return "\n".join(lines)
