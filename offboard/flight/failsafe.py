"""The failsafe: what the flight does when a limit is exceeded. One row for each condition."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from offboard.flight.conditions import Condition, blind, mode_unknown, silent, wrong_thrust
from offboard.flight.ground_contact import STOOD_S
from offboard.flight.phases import TRACKING, Action, Limits, Phase
from offboard.flight.preflight import other_sender, rare_telemetry
from offboard.flight.state import COMMANDS_KEPT, FlightState
from offboard.flight.timing import JUMP_S
from offboard.mavlink.events import MODE_KNOWN_S, EstimatorReport, ThrustReport

RECOVERY = 0.25  # s by which the held time decreases in each second without the condition
STEP_MAX_S = 0.2  # most by which one call of `judge` increases a held time, also after a gap
SINK_MPS = 0.3  # full thrust stops this sink within the delay, on a vehicle that can be flown
FULL_THRUST = 0.99  # normalised
# Share of the hover thrust at the start: an updraft never, and a lost payload hardly ever, reduces
# the thrust so far
LOW_THRUST = 0.5
STANDS_BELOW_M = 0.25  # below the reference, which is at least 0.3 m above the takeoff point
# At 3 Hz, with no gap that another row notices, the tilt of a PX4 reached 46 deg
LEAST_TELEMETRY_HZ = 3.5
THRUST_REPORT_S = 1.0  # greatest age of a ThrustReport that counts
ESTIMATOR_REPORT_S = 0.7  # the same for an EstimatorReport; one alone must not hold for a second


# ---------------------------------------------------------------------- conditions of the failsafe


def another_may_control(flight: FlightState) -> str:
    """Age of the newest report of the mode."""
    unknown = mode_unknown(flight)
    return f"{unknown}: another may control the vehicle" if unknown else ""


def telemetry_old(flight: FlightState) -> str:
    """Age of the newest telemetry beyond the least delay of the last 5 s."""
    age_s = flight.age_s
    return f"telemetry is {age_s:.2f} s old" if age_s > flight.limits.setpoint_age_s else ""


def rare(flight: FlightState) -> str:
    """Rate of the rarer of position and attitude, over 2 s."""
    return rare_telemetry(flight, LEAST_TELEMETRY_HZ)


def late_link(flight: FlightState) -> str:
    """Growth of the link delay since takeoff (TIMESYNC)."""
    growth_s = flight.clock.delay_growth_s
    exceeds = growth_s > flight.limits.link_growth_s
    return f"the delay of the link has grown by {growth_s:.2f} s" if exceeds else ""


def replies_overdue(flight: FlightState) -> str:
    """Number of TIMESYNC requests in a row whose reply is overdue, times their period."""
    requests = flight.clock.overdue(flight.host_s)
    if requests * flight.period_s <= flight.limits.silence_s:
        return ""
    return (
        f"{requests} TIMESYNC requests in a row were not answered: does the vehicle receive "
        "setpoints?"
    )


def decision_missed(flight: FlightState) -> str:
    """A decision failed, came too late, or was refused by the last check of the setpoint."""
    return flight.failure if flight.missed_decisions else ""


def decisions_missed(flight: FlightState) -> str:
    """Number of decisions missed in a row."""
    return flight.failure if flight.missed_decisions >= flight.limits.missed_decisions else ""


def tilted(flight: FlightState) -> str:
    """Tilt of the vehicle: the angle between the thrust axis and the vertical."""
    if flight.vehicle.attitude is None:
        return ""
    tilt_rad = math.acos(min(1.0, max(-1.0, float(flight.vehicle.thrust_direction_ned[2]))))
    return f"tilt {math.degrees(tilt_rad):.0f} deg" if tilt_rad > flight.limits.tilt_rad else ""


def away_from_commands(flight: FlightState) -> str:
    """Angle between the thrust direction of the vehicle and the nearest of those of the newest 7
    setpoints, if all 7 are attitude setpoints."""
    vehicle, commands = flight.vehicle, flight.commands
    if vehicle.attitude is None or len(commands) < COMMANDS_KEPT:
        return ""
    flown = vehicle.thrust_direction_ned
    nearest = max(float(flown @ np.array(each.thrust_direction_ned)) for each in commands)
    error_rad = math.acos(min(1.0, max(-1.0, nearest)))
    if not error_rad > flight.limits.tilt_error_rad:
        return ""
    return (
        f"the attitude is {math.degrees(error_rad):.0f} deg away from every "
        f"recent command{_other_companion(flight)}"
    )


def away_from_reference(flight: FlightState) -> str:
    """Distance from the reference."""
    error_m = flight.position_error_m
    if not error_m > flight.limits.position_error_m:
        return ""
    wrong = wrong_thrust(flight) if flight.phase in {Phase.CLIMB, Phase.EXCITE} else ""
    return f"{error_m:.1f} m from the reference{_other_companion(flight)}{wrong}"


def away_from_prediction(flight: FlightState) -> str:
    """Distance from the position that a decision has predicted for this time."""
    position = flight.vehicle.position
    if position is None:
        return ""
    for predicted in reversed(flight.predictions):
        passed_s = position.time_s - predicted.time_s
        if passed_s >= 0.0:
            then = predicted.position_ned_m + passed_s * predicted.velocity_ned_mps
            error_m = float(np.linalg.norm(np.array(position.position_ned_m) - then))
            exceeds = error_m > flight.limits.prediction_error_m
            return f"{error_m:.1f} m from the predicted position" if exceeds else ""
    return ""


def estimate_contradicts(flight: FlightState) -> str:
    """Sum of the position jumps of the last 10 s, or difference between position and integrated
    velocity over one second."""
    jumped_m, drift_m = flight.jumps.recent_m(flight.time_s), flight.jumps.drift_m
    if jumped_m > flight.limits.position_jump_m:
        return f"the estimated position jumped by {jumped_m:.1f} m"
    if drift_m > flight.limits.position_jump_m:
        return f"reported position and velocity differ by {drift_m:.1f} m in a second"
    return ""


def positioning_lost(flight: FlightState) -> str:
    """Time without the GPS fix or external vision that the estimator had at takeoff."""
    return flight.positioning.lost(flight.vehicle, flight.limits)


def estimate_invalid(flight: FlightState) -> str:
    """Loss, since takeoff, of a valid position estimate or of its reports."""
    return flight.positioning.invalid(flight.vehicle)


def estimate_inaccurate(flight: FlightState) -> str:
    """Accuracy of the position by its estimator, if it is twice as bad as at takeoff."""
    return flight.positioning.inaccurate(flight.vehicle, flight.limits)


def measurements_rejected(flight: FlightState) -> str:
    """Innovation ratio of position, velocity or height, of an estimator without GPS.

    Autopilots fly through a glitch of GPS; in a room there is no space for that."""
    report = flight.vehicle.estimator
    recent = flight.vehicle.age_s(EstimatorReport) < ESTIMATOR_REPORT_S
    if report is None or not (recent and flight.positioning.without_gps):
        return ""
    return report.rejects_motion


def outside_volume(flight: FlightState) -> str:
    """Height above the takeoff point, and horizontal distance from it."""
    return flight.outside_volume if flight.plan.reference else ""


def battery_empty(flight: FlightState) -> str:
    """Remaining charge of the battery."""
    charge = flight.vehicle.battery
    return f"the battery holds {100.0 * charge:.0f} %" if charge < flight.limits.battery else ""


def no_thrust_reserve(flight: FlightState) -> str:
    """Present hover thrust (normalised), estimated by the observer."""
    thrust = flight.observer.hover_thrust_estimate
    if flight.phase not in TRACKING or not thrust > flight.limits.hover_thrust:
        return ""
    return f"the vehicle hovers with {100.0 * thrust:.0f} % of its thrust"


def sinks_with_full_thrust(flight: FlightState) -> str:
    """Downward speed while the newest setpoint demands full thrust."""
    position, thrusts = flight.vehicle.position, flight.thrusts
    if flight.phase not in TRACKING or position is None or not thrusts:
        return ""
    sink_mps = position.velocity_ned_mps[2]
    sinks = thrusts[-1] >= FULL_THRUST and sink_mps > SINK_MPS
    return f"the vehicle sinks at {sink_mps:.1f} m/s with full thrust" if sinks else ""


def stands_on_ground(flight: FlightState) -> str:
    """Height of the reference above a vehicle that has stood at its takeoff height for 1 s.

    Does not apply in the climb, because a weak vehicle may be slow to leave the ground."""
    position, flies = flight.vehicle.position, flight.phase in TRACKING - {Phase.CLIMB}
    if position is None or not (flies and flight.contact.stood_for(STOOD_S)):
        return ""
    sample = flight.plan.sample(position.time_s)
    above_m = position.position_ned_m[2] - sample.position_ned_m[2] if sample else 0.0
    if not above_m > STANDS_BELOW_M:
        return ""
    return f"the vehicle stands on the ground, {above_m:.1f} m below the reference"


def low_thrust(flight: FlightState) -> str:
    """Present hover thrust, divided by the hover thrust at the start of the reference.

    It is low if the vehicle stands on something although its estimated height says that it flies.
    """
    thrust, before = flight.observer.hover_thrust_estimate, flight.start_hover_thrust
    begun = flight.phase in TRACKING - {Phase.CLIMB, Phase.EXCITE}
    if not begun or not thrust < LOW_THRUST * before:
        return ""
    return (
        f"the vehicle needs {100.0 * thrust:.0f} % of its thrust instead of {100.0 * before:.0f} %:"
        " it stands on something, or has lost half of its mass"
    )


def follows_others(flight: FlightState) -> str:
    """Difference between the thrust that PX4 follows (ATTITUDE_TARGET) and the nearest of those of
    our newest 40 setpoints.

    A difference shows that the vehicle follows the setpoints of another program, in the mode that
    we requested."""
    reported = flight.vehicle.age_s(ThrustReport) < THRUST_REPORT_S
    followed = flight.follows_others and reported and flight.phase in TRACKING
    if not followed or not flight.in_engage_mode or flight.limits.begin_with_other_sender:
        return ""
    return f"the vehicle follows setpoints of another program{_other_companion(flight)}"


def _other_companion(flight: FlightState) -> str:
    """The end of the sentence: which other companion computer is on the link; empty for none."""
    other = flight.vehicle.other_companion
    if other is None:
        return ""
    return (
        f"; another companion computer, system {other.system_id} component {other.component_id}, "
        "may send setpoints, too"
    )


def clock_jumped(flight: FlightState) -> str:
    """Jump of the vehicle's clock."""
    jumped_s = flight.clock.jumped_s
    return f"the clock of the vehicle jumped by {jumped_s:.1f} s" if jumped_s > 0.0 else ""


def contradicted(flight: FlightState) -> str:
    """Identified constants that are out of bounds."""
    return flight.identification.contradiction if flight.identification else ""


# ---------------------------------------------------------------------- the table


@dataclass(frozen=True, slots=True)
class Row:
    """A row of the failsafe: `action` is taken once `condition` has held for `held_s`. `cause` has
    the meaning that it has in `conditions.Transition`. `limit` names the settings of the limit, or
    is its value as a text. The first sentence of the condition's docstring says in the README what
    is measured."""

    name: str
    condition: Condition
    limit: str
    action: Action
    held_s: float = 0.0
    cause: str = "limit"

    def settings(self, limits: Limits) -> str:
        """The end of the sentence: the names and values of the settings of the limit."""
        keys = re.findall(r"limits\.(\w+)", self.limit)
        named = ", ".join(f"limits.{key} is {getattr(limits, key):g}" for key in keys)
        return named and f" ({named})"


LEVEL, HOLD, LAND = Action.LEVEL, Action.HOLD, Action.LAND
MISSED = "{flight.failure_cause}"
UNIDENTIFIED = "BOUNDS of identification"
ROWS = (
    # after the row "authority" nothing is requested until the mode is known again
    Row("authority", another_may_control, f"{MODE_KNOWN_S:g} s", LAND, cause="link"),
    Row("silence", silent, "limits.silence_s", LAND, cause="link"),
    Row("blind", blind, f"{Limits.blind_s:g} s", LAND, cause="link"),
    Row("age", telemetry_old, "limits.setpoint_age_s", LEVEL, cause="link"),
    Row("late", telemetry_old, "limits.setpoint_age_s", HOLD, 0.5, "link"),
    Row("rate", rare, f"{LEAST_TELEMETRY_HZ:g} Hz", HOLD, 0.5, "link"),
    Row("link", late_link, "limits.link_growth_s", HOLD, 0.5, "link"),
    Row("uplink", replies_overdue, "limits.silence_s", HOLD, 0.5, "link"),
    Row("decision", decision_missed, "one", LEVEL, cause=MISSED),
    Row("decisions", decisions_missed, "limits.missed_decisions", LAND, cause=MISSED),
    Row("tilt", tilted, "limits.tilt_rad", LAND),
    Row("tilt error", away_from_commands, "limits.tilt_error_rad", LAND, 0.5),
    Row("position error", away_from_reference, "limits.position_error_m", LAND),
    Row("prediction", away_from_prediction, f"{Limits.prediction_error_m:g} m", HOLD, 0.3),
    Row("estimator", estimate_contradicts, "limits.position_jump_m", HOLD, cause=""),
    Row("positioning", positioning_lost, "limits.gps_s", LAND, 0.5, "positioning"),
    Row("validity", estimate_invalid, "any", LAND, 0.5, "positioning"),
    Row("accuracy", estimate_inaccurate, "limits.accuracy_m", LAND, 0.5, "positioning"),
    # vision that repeats a pose flew a real PX4 25 m away, at 7 m/s
    Row("innovations", measurements_rejected, "1", LAND, 1.0, "positioning"),
    Row("volume", outside_volume, "limits.ceiling_m, limits.radius_m", LAND),
    Row("battery", battery_empty, "limits.battery", LAND, 2.0),
    Row("thrust reserve", no_thrust_reserve, "limits.hover_thrust", LAND, 2.0),
    Row("full thrust", sinks_with_full_thrust, f"{SINK_MPS:g} m/s", LAND, 1.0),
    Row("ground", stands_on_ground, f"{STANDS_BELOW_M:g} m", LAND, cause="ground contact"),
    Row("low thrust", low_thrust, f"{LOW_THRUST:g}", LAND, 1.0, "ground contact"),
    Row("second sender", other_sender, "one message", HOLD, cause="second sender"),
    # within this time a pilot's change of the mode is reported, or the row "authority" acts
    Row("other setpoints", follows_others, "1e-5", HOLD, MODE_KNOWN_S, "second sender"),
    Row("clock", clock_jumped, f"{JUMP_S:g} s", LAND, cause=""),
    Row("contradiction", contradicted, UNIDENTIFIED, LAND, cause=""),
)


# ---------------------------------------------------------------------- its application


def judge(flight: FlightState, rows: Sequence[Row] = ROWS) -> None:
    """Update for how long each condition has held. Store in `flight.failsafe` the active row with
    the most severe action, the first one of several."""
    known = flight.failsafe
    step_s = min(max(flight.now_s - known.judged_s, 0.0), STEP_MAX_S)
    known.judged_s = flight.now_s
    known.action, known.row, known.reason, known.cause = Action.FLY, "", "", ""
    for row in rows:
        holds, held_s = row.condition(flight), known.held_s.get(row.name, 0.0)
        held_s = held_s + step_s if holds else max(held_s - RECOVERY * step_s, 0.0)
        known.held_s[row.name] = held_s
        if holds and held_s >= row.held_s and row.action > known.action:
            known.action, known.row = row.action, row.name
            known.reason = f"{holds}{row.settings(flight.limits)}"
            known.cause = row.cause.format(flight=flight)
