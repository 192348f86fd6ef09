"""The phase table of `fly`: transitions between the phases of a flight. The first row that holds is
taken. `programme` has the table of the service, which shares most of these rows.

Every row leads to a later phase. `actions` has what is done in a phase. The names in braces are
keys of `assessment.figures`.
"""

from __future__ import annotations

from dataclasses import dataclass

from offboard.flight import guards
from offboard.flight.guards import Guard, longer_than
from offboard.flight.phases import ExitCode, Phase, Rung
from offboard.flight.preflight import ARMED_ALREADY, OTHER_SENDER, SEVERAL

REFUSED, ABORTED = ExitCode.REFUSED, ExitCode.ABORTED


@dataclass(frozen=True, slots=True)
class Row:
    """A transition from `source`, when `guard` holds, to `target`.

    `exit_code` is set if this row decides the result; a later row can only make it more severe.
    """

    source: Phase
    guard: Guard
    target: Phase
    reason: str
    exit_code: int | None = None


_SILENT = "no telemetry for {silence_s:.1f} s"
_STOPPED = "{stop} before take-off"
_BLIND = "no {blind_to} for {blind_s:.1f} s"
_UNKNOWN = "no report of the mode for {authority_age_s:.1f} s"
_STARVED = "setpoints did not arrive, and the vehicle's own failsafe flies it, in {mode}"
_OUT_OF_REACH = "not heard for {unreached_s:.0f} s while landing; {last_known}"
_UNHEARD = "it stands on the ground, and no HEARTBEAT shows whether it is disarmed"
REBOOTED = "the vehicle restarted"
_DISARMED = "disarmed on the ground"
_NOT_FOUND = "no vehicle heard in {silence_s:.0f} s; {not_found}"
_NO_LIFT_OFF = "no lift-off in {in_phase_s:.0f} s; is hover_thrust in the vehicle file right?"
_NOT_ENGAGED = "the vehicle did not enter {mode_wanted} in {in_phase_s:.0f} s (it shows {mode})"


def _streaming_rows(source: Phase) -> tuple[Row, ...]:
    return (
        Row(source, guards.rebooted, Phase.FAILED, REBOOTED, REFUSED),
        Row(source, guards.armed_by_another, Phase.FAILED, ARMED_ALREADY, REFUSED),
        Row(source, guards.silent_on_ground, Phase.FAILED, _SILENT, REFUSED),
        Row(source, guards.stop_requested, Phase.FAILED, _STOPPED, REFUSED),
        Row(source, guards.other_sender, Phase.FAILED, OTHER_SENDER, REFUSED),
        Row(source, guards.other_vehicle, Phase.FAILED, SEVERAL, REFUSED),
        Row(source, guards.blind, Phase.FAILED, _BLIND, REFUSED),
        Row(source, guards.authority_unknown, Phase.FAILED, _UNKNOWN, REFUSED),
        Row(source, guards.lost, Phase.FAILED, "{lost}", REFUSED),
    )


def flying_rows(source: Phase, when: str = "in flight") -> tuple[Row, ...]:
    """What ends a phase in the air early."""
    return (
        Row(source, guards.rebooted, Phase.LAND, f"{REBOOTED} {when}", ABORTED),
        Row(source, guards.disarmed, Phase.FAILED, f"the vehicle disarmed {when}", ABORTED),
        Row(source, guards.lost, Phase.YIELDED, "{lost}", ABORTED),
        Row(source, guards.in_own_failsafe, Phase.LAND, _STARVED, ABORTED),
        Row(source, guards.at_rung(Rung.LAND), Phase.LAND, "{ladder}", ABORTED),
        Row(source, guards.stop_requested, Phase.LAND, "{stop}", ABORTED),
        Row(source, guards.at_rung(Rung.HOLD), Phase.HOLD, "{ladder}", ABORTED),
    )


def _too_long(source: Phase, limit: str, target: Phase, reason: str, exit_code: int) -> Row:
    return Row(source, longer_than(limit), target, reason, exit_code)


TRANSITIONS: tuple[Row, ...] = (
    Row(Phase.CONNECT, guards.stop_requested, Phase.FAILED, "{stop}", REFUSED),
    Row(Phase.CONNECT, guards.vehicle_found, Phase.HEALTH, "vehicle found"),
    Row(Phase.CONNECT, guards.silent_on_ground, Phase.FAILED, _NOT_FOUND, REFUSED),
    Row(Phase.HEALTH, guards.silent_on_ground, Phase.FAILED, _SILENT, REFUSED),
    Row(Phase.HEALTH, guards.stop_requested, Phase.FAILED, _STOPPED, REFUSED),
    Row(Phase.HEALTH, guards.refused, Phase.FAILED, "{refusals}", REFUSED),
    Row(Phase.HEALTH, guards.ready, Phase.STREAM, "telemetry flows and the vehicle can arm"),
    _too_long(Phase.HEALTH, "health_s", Phase.FAILED, "not ready: {not_ready}", REFUSED),
    *_streaming_rows(Phase.STREAM),
    Row(Phase.STREAM, guards.needs_no_stream, Phase.ENGAGE, "the autopilot takes off by itself"),
    Row(Phase.STREAM, guards.streamed, Phase.ENGAGE, "setpoints stream"),
    # first: from then on it is ours, and whatever ends the flight must ask for hold or land
    Row(Phase.ENGAGE, guards.engaged_in_the_air, Phase.CLIMB, "{mode} in the air"),
    *_streaming_rows(Phase.ENGAGE),
    Row(Phase.ENGAGE, guards.engaged, Phase.ARM, "the vehicle shows {mode}"),
    _too_long(Phase.ENGAGE, "engage_s", Phase.FAILED, _NOT_ENGAGED, REFUSED),
    Row(Phase.ARM, guards.rebooted, Phase.FAILED, REBOOTED, REFUSED),
    Row(Phase.ARM, guards.lost_armed, Phase.YIELDED, "{lost} as it armed", ABORTED),
    Row(Phase.ARM, guards.lost_disarmed, Phase.FAILED, "{lost}", REFUSED),
    Row(Phase.ARM, guards.silent, Phase.STAND_DOWN, _SILENT, REFUSED),
    Row(Phase.ARM, guards.blind, Phase.STAND_DOWN, _BLIND, REFUSED),
    Row(Phase.ARM, guards.stop_requested, Phase.STAND_DOWN, "{stop}", REFUSED),
    Row(Phase.ARM, guards.armed, Phase.TAKEOFF, "armed"),
    Row(
        Phase.ARM,
        guards.disarmed_again,
        Phase.FAILED,
        "the vehicle was disarmed just after it had armed",
        REFUSED,
    ),
    _too_long(
        Phase.ARM,
        "arm_s",
        Phase.STAND_DOWN,
        "the vehicle did not arm in {in_phase_s:.0f} s",
        REFUSED,
    ),
    *flying_rows(Phase.TAKEOFF, "before lift-off"),
    Row(Phase.TAKEOFF, guards.lifted_off, Phase.CLIMB, "lifted off"),
    _too_long(Phase.TAKEOFF, "lift_off_s", Phase.LAND, _NO_LIFT_OFF, ABORTED),
    *flying_rows(Phase.CLIMB),
    Row(Phase.CLIMB, guards.at_start_to_excite, Phase.EXCITE, "identification steps"),
    Row(Phase.CLIMB, guards.at_start, Phase.JOIN, "hovers at the start of the reference"),
    Row(
        Phase.CLIMB,
        guards.too_late_at_start,
        Phase.LAND,
        "the start of the reference was not reached: {position_error_m:.1f} m away, "
        "{late_s:.0f} s late; is hover_thrust in the vehicle file right, and is the vehicle fast "
        "enough for controller.bandwidth_radps?",
        ABORTED,
    ),
    *flying_rows(Phase.EXCITE),
    Row(Phase.EXCITE, guards.identified, Phase.JOIN, "hovers at the start of the reference"),
    _too_long(
        Phase.EXCITE,
        "excite_s",
        Phase.LAND,
        "identification did not converge in {in_phase_s:.0f} s",
        ABORTED,
    ),
    *flying_rows(Phase.JOIN),
    Row(Phase.JOIN, guards.at_full_speed, Phase.TRACK, "on the reference at full speed"),
    *flying_rows(Phase.TRACK),
    Row(Phase.TRACK, guards.track_over, Phase.HOVER, "the reference was flown"),
    *flying_rows(Phase.HOVER),
    Row(Phase.HOVER, guards.at_rest, Phase.LAND, "at rest"),
    *(row for row in flying_rows(Phase.HOLD) if row.target is not Phase.HOLD),
    _too_long(
        Phase.HOLD, "hold_s", Phase.LAND, "the autopilot held for {in_phase_s:.0f} s", ABORTED
    ),
    Row(Phase.LAND, guards.landed, Phase.DISARMED, _DISARMED),
    Row(Phase.LAND, guards.rebooted_disarmed, Phase.FAILED, f"{REBOOTED} and is disarmed", ABORTED),
    Row(
        Phase.LAND,
        guards.disarmed_elsewhere,
        Phase.FAILED,
        "disarmed, landing not confirmed: {not_landed}",
        ABORTED,
    ),
    Row(Phase.LAND, guards.lost_armed, Phase.YIELDED, "{lost}", ABORTED),
    Row(Phase.LAND, guards.unheard_on_ground, Phase.FAILED, _UNHEARD, ABORTED),
    Row(Phase.LAND, guards.out_of_reach, Phase.FAILED, _OUT_OF_REACH, ABORTED),
    _too_long(
        Phase.LAND,
        "land_s",
        Phase.FAILED,
        "not landed and disarmed after {in_phase_s:.0f} s{still_armed}",
        ABORTED,
    ),
    Row(Phase.STAND_DOWN, guards.rebooted, Phase.FAILED, REBOOTED, REFUSED),
    Row(Phase.STAND_DOWN, guards.silent_for_long, Phase.FAILED, _SILENT, REFUSED),
    Row(Phase.STAND_DOWN, guards.disarmed_for_good, Phase.FAILED, _DISARMED),
    _too_long(
        Phase.STAND_DOWN,
        "disarm_s",
        Phase.FAILED,
        "still armed after {in_phase_s:.0f} s",
        ABORTED,
    ),
)
