"""Failsafe: what follows when a limit is exceeded in flight. One row for each condition.

The action of the worst row that is active counts. A row is active once its condition has held for
its delay. The time that it has held runs down at a quarter of the speed while the condition does
not hold, so that a condition that comes and goes does not start from zero each time.

Conditions and reasons are functions of the flight. They change nothing.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from offboard.flight.phases import TRACKING, Action
from offboard.flight.rows import (
    Condition,
    Reason,
    blind,
    mode_unknown,
    no_mode_report,
    no_position_or_attitude,
    no_telemetry,
    other_sender,
    other_sender_name,
    silent,
    why,
)
from offboard.flight.state import FlightState
from offboard.mavlink.events import ThrustReport
from offboard.model.frames import thrust_direction_from_quaternion

RECOVERY = 0.25  # speed at which a delay runs back
STEP_MAX_S = 0.2  # what one sample counts for, also after a gap of telemetry
SINK_MPS = 0.3  # that full thrust stops within the delay, on a vehicle that can be flown
FULL_THRUST = 0.99
THRUST_REPORT_S = 1.0  # age of a ThrustReport that counts


# ---------------------------------------------------------------------- what is measured


def _link_is_late(flight: FlightState) -> bool:
    limits = flight.limits
    return flight.link_growth_s > limits.link_growth_s or flight.age_s > limits.setpoint_age_s


def tilt_rad(flight: FlightState) -> float:
    """Angle between the thrust axis and the vertical; 0 before the first attitude."""
    attitude = flight.vehicle.attitude
    if attitude is None:
        return 0.0
    down = thrust_direction_from_quaternion(np.array(attitude.attitude))[2]
    return math.acos(min(1.0, max(-1.0, float(down))))


def tilt_error_rad(flight: FlightState) -> float:
    """Angle between the thrust direction and the nearest of the newest commands."""
    attitude, commands = flight.vehicle.attitude, flight.commands
    if attitude is None or len(commands) < (commands.maxlen or 0):
        return 0.0
    flown = thrust_direction_from_quaternion(np.array(attitude.attitude))
    nearest = max(float(flown @ np.array(each.thrust_direction_ned)) for each in commands)
    return math.acos(min(1.0, max(-1.0, nearest)))


def prediction_error_m(flight: FlightState) -> float:
    """Distance of the newest position from the newest prediction for an earlier moment."""
    position = flight.vehicle.position
    if position is None:
        return 0.0
    for predicted in reversed(flight.predictions):
        passed_s = position.time_s - predicted.time_s
        if passed_s >= 0.0:
            then = predicted.position_ned_m + passed_s * predicted.velocity_ned_mps
            return float(np.linalg.norm(np.array(position.position_ned_m) - then))
    return 0.0


def _outside_volume(flight: FlightState) -> bool:
    north_m, east_m, height_m = flight.from_takeoff_m
    distance_m = math.hypot(north_m, east_m)
    return height_m > flight.limits.ceiling_m or distance_m > flight.limits.radius_m


def _place(flight: FlightState) -> str:
    north_m, east_m, height_m = flight.from_takeoff_m
    return (
        f"{height_m:.0f} m above and {math.hypot(north_m, east_m):.0f} m from the take-off point "
        "(limits.ceiling_m, limits.radius_m)"
    )


def _hover_thrust(flight: FlightState) -> float:
    """Normalised, as setpoints that are followed show it now; NaN while none are."""
    return flight.observer.hover_thrust_estimate if flight.phase in TRACKING else math.nan


def _full_thrust_sink_mps(flight: FlightState) -> float:
    """Downward speed while the newest setpoint demands the full thrust, else 0. Other rows act on
    an old position (blind) and on missing setpoints (decisions)."""
    position, thrusts = flight.vehicle.position, flight.thrusts
    if flight.phase not in TRACKING or position is None or not thrusts:
        return 0.0
    return max(position.velocity_ned_mps[2], 0.0) if thrusts[-1] >= FULL_THRUST else 0.0


def _follows_others(flight: FlightState) -> bool:
    """The vehicle follows setpoints of another program in the mode that we asked for."""
    reported = flight.vehicle.age_s(ThrustReport) < THRUST_REPORT_S
    followed = flight.follows_others and reported and flight.phase in TRACKING
    return followed and flight.engaged and not flight.limits.begin_with_other_sender


def _other_companion(flight: FlightState) -> str:
    """What it may have to do with a vehicle that does not follow; empty without one."""
    other = flight.vehicle.other_companion
    if other is None:
        return ""
    return (
        f"; another companion computer, system {other.system_id} component {other.component_id}, "
        "may send setpoints, too"
    )


def _contradiction(flight: FlightState) -> str:
    return flight.identification.contradiction if flight.identification else ""


# ---------------------------------------------------------------------- the table


@dataclass(frozen=True, slots=True)
class Row:
    """`action` is taken when `condition` has held for `held_s`; `reason` then says why, `cause` in
    a word: empty without one. `measured` and `limit` are for the documentation."""

    name: str
    measured: str
    limit: str
    condition: Condition
    held_s: float
    action: Action
    reason: Reason
    cause: Reason = "limit"


ROWS = (
    Row(
        "authority",
        "age of the newest report of the mode",
        "2.5 s",
        mode_unknown,
        0.0,
        Action.LAND,  # of which nothing is asked before the mode is known again
        lambda flight: f"{no_mode_report(flight)}: another may control the vehicle",
        "link",
    ),
    Row(
        "silence",
        "host time without position and attitude",
        "limits.silence_s",
        silent,
        0.0,
        Action.LAND,
        no_telemetry,
        "link",
    ),
    Row(
        "blind",
        "age of the older of position and attitude",
        "limits.blind_s",
        blind,
        0.0,
        Action.LAND,
        no_position_or_attitude,
        "link",
    ),
    Row(
        "age",
        "age of the newest telemetry beyond the known delay of the link",
        "limits.setpoint_age_s",
        lambda flight: flight.age_s > flight.limits.setpoint_age_s,
        0.0,
        Action.LEVEL,
        "telemetry is {flight.age_s:.2f} s old",
        "link",
    ),
    Row(
        "link",
        "growth of the link's delay since take-off (TIMESYNC), or the age of telemetry",
        "limits.link_growth_s, limits.setpoint_age_s",
        _link_is_late,
        0.5,
        Action.HOLD,
        "the delay of the link has grown by {flight.link_growth_s:.2f} s",
        "link",
    ),
    Row(
        "decision",
        "a decision failed, came too late, or was not fit to be sent",
        "one",
        lambda flight: flight.missed > 0,
        0.0,
        Action.LEVEL,
        "{flight.failure}",
        "{flight.failure_cause}",
    ),
    Row(
        "decisions",
        "decisions missed in a row",
        "limits.missed_decisions",
        lambda flight: flight.missed >= flight.limits.missed_decisions,
        0.0,
        Action.LAND,
        "{flight.failure}",
        "{flight.failure_cause}",
    ),
    Row(
        "tilt",
        "tilt of the vehicle",
        "limits.tilt_rad",
        lambda flight: tilt_rad(flight) > flight.limits.tilt_rad,
        0.0,
        Action.LAND,
        lambda flight: f"tilt {math.degrees(tilt_rad(flight)):.0f} deg",
    ),
    Row(
        "tilt error",
        "angle between the thrust direction and the nearest of the newest commands",
        "limits.tilt_error_rad",
        lambda flight: tilt_error_rad(flight) > flight.limits.tilt_error_rad,
        0.5,
        Action.LAND,
        lambda flight: (
            f"the attitude is {math.degrees(tilt_error_rad(flight)):.0f} deg away from every "
            f"recent command{_other_companion(flight)}"
        ),
    ),
    Row(
        "position error",
        "distance from the reference",
        "limits.position_error_m",
        lambda flight: flight.position_error_m > flight.limits.position_error_m,
        0.0,
        Action.LAND,
        lambda flight: (
            f"{flight.position_error_m:.1f} m from the reference "
            f"(limit {flight.limits.position_error_m:.1f} m){_other_companion(flight)}"
        ),
    ),
    Row(
        "prediction",
        "distance from the position that the decision before predicted",
        "limits.prediction_error_m",
        lambda flight: prediction_error_m(flight) > flight.limits.prediction_error_m,
        0.3,
        Action.HOLD,
        lambda flight: f"{prediction_error_m(flight):.1f} m from the predicted position",
    ),
    Row(
        "estimator",
        "jumps of the reported position in the last 10 s",
        "limits.position_jump_m",
        lambda flight: flight.jumps.recent_m(flight.time_s) > flight.limits.position_jump_m,
        0.0,
        Action.HOLD,
        lambda flight: (
            f"the estimated position jumped by {flight.jumps.recent_m(flight.time_s):.1f} m"
        ),
        "",
    ),
    Row(
        "positioning",
        "GPS fix, validity and accuracy of the estimate, their messages: lost since take-off",
        "limits.gps_s, limits.accuracy_m",
        lambda flight: bool(flight.positioning.lost(flight.vehicle, flight.limits)),
        0.5,
        Action.LAND,
        lambda flight: flight.positioning.lost(flight.vehicle, flight.limits),
        "positioning",
    ),
    Row(
        "volume",
        "height and distance from the take-off point",
        "limits.ceiling_m, limits.radius_m",
        _outside_volume,
        0.0,
        Action.LAND,
        _place,
    ),
    Row(
        "battery",
        "remaining charge",
        "limits.battery",
        lambda flight: flight.vehicle.battery < flight.limits.battery,
        2.0,
        Action.LAND,
        lambda flight: f"the battery holds {100.0 * flight.vehicle.battery:.0f} %",
    ),
    Row(
        "thrust reserve",
        "normalised thrust that hovers now",
        "limits.hover_thrust",
        lambda flight: _hover_thrust(flight) > flight.limits.hover_thrust,
        2.0,
        Action.LAND,
        lambda flight: (
            f"the vehicle hovers with {100.0 * _hover_thrust(flight):.0f} % of its thrust "
            "(limits.hover_thrust)"
        ),
    ),
    Row(
        "full thrust",
        "downward speed while setpoints demand the full thrust",
        f"{SINK_MPS:g} m/s",
        lambda flight: _full_thrust_sink_mps(flight) > SINK_MPS,
        1.0,
        Action.LAND,
        lambda flight: (
            f"the vehicle sinks at {_full_thrust_sink_mps(flight):.1f} m/s with full thrust"
        ),
    ),
    Row(
        "second sender",
        "another program sends setpoints or commands modes on this link, or says in its HEARTBEAT "
        "that it flies the vehicle",
        "one message",
        other_sender,
        0.0,
        Action.HOLD,
        lambda flight: (
            f"another program controls the vehicle on this link, too: {other_sender_name(flight)}"
        ),
        "second sender",
    ),
    Row(
        "other setpoints",
        "thrust of the setpoint that PX4 follows (ATTITUDE_TARGET): none of our newest 40",
        "1e-5",
        _follows_others,
        2.5,  # a pilot's change of the mode is seen within this time, or `authority` acts
        Action.HOLD,
        lambda flight: (
            f"the vehicle follows setpoints of another program{_other_companion(flight)}"
        ),
        "second sender",
    ),
    Row(
        "clock",
        "jump of the vehicle's clock",
        "0.5 s",
        lambda flight: flight.clock.jumped_s > 0.0,
        0.0,
        Action.LAND,
        "the clock of the vehicle jumped by {flight.clock.jumped_s:.1f} s",
        "",
    ),
    Row(
        "contradiction",
        "identified constants out of bounds",
        "BOUNDS of identification",
        lambda flight: bool(_contradiction(flight)),
        0.0,
        Action.LAND,
        _contradiction,
        "",
    ),
)


# ---------------------------------------------------------------------- its application


def judge(flight: FlightState, rows: Sequence[Row] = ROWS) -> None:
    """Measure for how long each condition has held by now, and note the worst row that is active,
    the first of those that are equally bad."""
    known = flight.failsafe
    passed_s = 0.0 if known.judged_s is None else flight.now_s - known.judged_s
    step_s = min(max(passed_s, 0.0), STEP_MAX_S)
    known.judged_s = flight.now_s
    known.action, known.row = Action.FLY, ""
    for row in rows:
        holds, held_s = row.condition(flight), known.held_s.get(row.name, 0.0)
        held_s = held_s + step_s if holds else max(held_s - RECOVERY * step_s, 0.0)
        known.held_s[row.name] = held_s
        if holds and held_s >= row.held_s and row.action > known.action:
            known.action, known.row = row.action, row.name


def reason(flight: FlightState) -> str:
    """Why the action is taken; empty while none is."""
    return next((why(row.reason, flight) for row in ROWS if row.name == flight.failsafe.row), "")


def cause(flight: FlightState) -> str:
    """`reason` in a word; empty without one."""
    return next((why(row.cause, flight) for row in ROWS if row.name == flight.failsafe.row), "")


def markdown() -> str:
    """The table for the README of `flight/`."""
    lines = ["| row | what is measured | limit | held for | then |", "|---|---|---|---|---|"]
    for row in ROWS:
        then = row.action.name.lower()
        lines.append(f"| {row.name} | {row.measured} | {row.limit} | {row.held_s:g} s | {then} |")
    return "\n".join(lines)
