"""Everything that is sent: setpoints with their last check, requests, texts, and their queue.

PX4 flies any setpoint it receives. Every setpoint passes `admit`, which is independent of the
control laws and of their limits. It is then given to the observer and the identification, which
predict with the commands that were sent. `flush` encodes the messages to send; later, `log` encodes
the records, which are only logged. This module makes no decision and has no socket or file.
"""

from __future__ import annotations

import math
from contextlib import suppress
from itertools import chain
from numbers import Real
from typing import Any

from offboard.flight.phases import ENDING, TRACKING, ExitCode, Phase
from offboard.flight.record import Refusal
from offboard.flight.state import LEVEL_DIRECTION, FlightState
from offboard.flight.timing import LOSSY
from offboard.mavlink import event_record
from offboard.mavlink.event_record import EventRecord
from offboard.mavlink.events import GOOD_RESULTS, WARNING
from offboard.mavlink.outgoing import (
    FLOAT32_MAX,
    AttitudeTarget,
    CommandLong,
    Outgoing,
    PositionTarget,
    Record,
)
from offboard.mavlink.texts import chunks
from offboard.model.command import Command, PositionCommand
from offboard.model.vehicle import Vehicle

INFO = 6  # MAV_SEVERITY
TEXT_ID_MAX = 65535  # STATUSTEXT.id; 0 is for texts of one chunk
ANNOUNCED_KEPT = 200
NEVER = -math.inf, -math.inf  # link time and host time
ANSWERS_S = 10.0  # after this time without a reply to TIMESYNC requests, no reply is awaited
REPEAT_S = 1.0  # after this time a request that was refused, or not answered, is sent again
EFFECT_S = 3.0  # after this time an accepted request that ends the flight is sent again
LOSES = f"more than {LOSSY:.0%} of TIMESYNC requests have no reply: each setpoint is sent twice"
_LENGTH_TOLERANCE = 0.01


class Refused(Exception):
    """A setpoint must not be sent. The message is the reason, `why` its number in the log."""

    def __init__(self, why: Refusal, reason: str) -> None:
        super().__init__(reason)
        self.why = why


def admit(
    command: Command | PositionCommand,
    vehicle: Vehicle,
    *,
    ours: bool,
    on_ground: bool,
    age_s: float,
    age_limit_s: float,
    late_s: float,
) -> Command | PositionCommand:
    """Return the setpoint that may be sent: `command` within the limits of `vehicle`.

    Args:
        ours: whether a setpoint may be sent to the vehicle (`Authority.permits_setpoint`).
        on_ground: whether it certainly stands on the ground (`GroundContact.on_ground`).
        age_s: age of the telemetry that the setpoint was computed from, beyond the least delay of
            the last 5 s; 0 for a setpoint that needs none.
        age_limit_s: the greatest age of telemetry that is allowed.
        late_s: time by which the setpoint is ready later than one control period after the arrival
            of its telemetry; not positive if it is ready in time.

    Raises Refused if the vehicle is not ours, the telemetry was too old, the decision too late, or
    a value cannot be sent.
    """
    if not ours:
        raise Refused(Refusal.NOT_OURS, "the vehicle is not ours")
    if not age_s <= age_limit_s:
        raise Refused(Refusal.STALE, f"decided on telemetry that is {age_s:.2f} s old")
    if not late_s <= 0.0:
        raise Refused(Refusal.LATE, f"decided {1e3 * late_s:.1f} ms too late")
    if not usable(command):
        raise Refused(Refusal.UNUSABLE, f"unusable {command}")
    if isinstance(command, PositionCommand):
        return command
    return clamp(command, vehicle, on_ground=on_ground)


def usable(command: Command | PositionCommand) -> bool:
    """Whether all values are numbers that float32 can hold, and the thrust direction is a unit
    vector. Vectors must be tuples, because commands are compared with ==."""
    if isinstance(command, PositionCommand):
        vectors = [command.position_ned_m, command.velocity_ned_mps, command.acceleration_ned_mps2]
        scalars = [command.heading_rad, command.heading_rate_radps]
    else:
        vectors = [command.thrust_direction_ned]
        scalars = [command.thrust_mps2, command.heading_rad]
    if not all(isinstance(each, tuple) and len(each) == 3 for each in vectors):
        return False
    numbers: list[Any] = [*scalars, *chain(*vectors)]
    if not all(isinstance(each, Real) for each in numbers):
        return False
    if not all(abs(each) <= FLOAT32_MAX for each in numbers):
        return False
    is_unit = abs(math.hypot(*vectors[0]) - 1.0) <= _LENGTH_TOLERANCE
    return is_unit or isinstance(command, PositionCommand)


def clamp(command: Command, vehicle: Vehicle, *, on_ground: bool) -> Command:
    """Return `command` limited to the vehicle's thrust and tilt.

    A direction tilted by more than `tilt_max_rad` is turned back to that tilt in its own vertical
    plane. In the air, thrust is at least a third of hover.
    """
    least_mps2 = 0.0 if on_ground else vehicle.thrust_min_mps2
    thrust = min(max(command.thrust_mps2, least_mps2), vehicle.thrust_max_mps2)
    north, east, down = command.thrust_direction_ned
    lateral = math.hypot(north, east)
    if math.atan2(lateral, down) > vehicle.tilt_max_rad:
        # the direction of an exactly inverted vehicle is turned to the north (atan2 of zeros)
        towards_rad, scale = math.atan2(east, north), math.sin(vehicle.tilt_max_rad)
        north, east = scale * math.cos(towards_rad), scale * math.sin(towards_rad)
        down = math.cos(vehicle.tilt_max_rad)
    return Command(thrust, (north, east, down), command.heading_rad)


# ---------------------------------------------------------------------- setpoints


def send_setpoint(
    flight: FlightState,
    time_s: float,
    command: Command | PositionCommand,
    body_z_down: float | None = None,
    *,
    age_s: float = 0.0,
    late_s: float = 0.0,
) -> Command | PositionCommand:
    """Send a setpoint and return it as it was sent.

    `age_s` and `late_s` are those of the decision (see `admit`), `body_z_down` is
    described in `AttitudeTarget`. Raises Refused; then nothing is sent.
    """
    admitted = admit(
        command,
        flight.model,
        ours=flight.authority.permits_setpoint(flight.now_s),
        on_ground=flight.contact.on_ground,
        age_s=age_s,
        age_limit_s=flight.limits.setpoint_age_s,
        late_s=late_s,
    )
    if isinstance(admitted, Command):
        _send_attitude(flight, time_s, admitted, body_z_down)
    else:
        _send_position(flight, time_s, admitted)
    flight.setpoint_s = flight.host_s
    return admitted


def send_level(flight: FlightState, time_s: float, command: Command) -> None:
    """Send a setpoint that needs no decision, if the vehicle is ours."""
    with suppress(Refused):
        send_setpoint(flight, time_s, command)


def repeat_setpoint(flight: FlightState) -> None:
    """If the link loses messages, send the newest setpoint once more, half a period after it: a
    lost setpoint leaves the one before in force for a whole period."""
    newest = flight.newest_setpoint
    if newest is None or flight.time_s < newest.time_s + 0.5 * flight.period_s - 1e-6:
        return
    flight.newest_setpoint = None
    ours = flight.phase in TRACKING and flight.authority.permits_setpoint(flight.now_s)
    if ours and flight.clock.loses(flight.host_s):
        announce(flight, LOSES, once=True)
        send(flight, newest)


def set_command(flight: FlightState, time_s: float, command: Command) -> None:
    """Note the command in force without sending it, for example the autopilot's own."""
    flight.command = command
    flight.observer.on_command(flight.delays_begin_s(time_s), command)


def _send_attitude(
    flight: FlightState, time_s: float, command: Command, body_z_down: float | None
) -> None:
    model = flight.model
    set_command(flight, time_s, command)
    flight.commands.append(command)
    thrust = command.thrust_mps2 / model.thrust_max_mps2
    flight.thrusts.append(min(thrust, 1.0))
    if flight.identification:
        flight.identification.on_command(flight.delays_begin_s(time_s), command, thrust)
    flight.newest_setpoint = AttitudeTarget(
        time_s, command, model.hover_thrust, model.gravity_mps2, body_z_down
    )
    send(flight, flight.newest_setpoint)


def _send_position(flight: FlightState, time_s: float, command: PositionCommand) -> None:
    """Send a position setpoint. The attitude that the autopilot's position loop commands is not
    known, so the observer stops predicting with commands."""
    flight.observer.freeze(True)
    flight.commands.clear()  # the autopilot chooses attitude and thrust
    flight.thrusts.clear()
    flight.command = Command(flight.model.gravity_mps2, LEVEL_DIRECTION, command.heading_rad)
    flight.newest_setpoint = PositionTarget(time_s, command)
    send(flight, flight.newest_setpoint)


def hover_mps2(flight: FlightState) -> float:
    """Thrust that holds the weight, by the observer's estimate of the hover thrust, m/s^2."""
    model = flight.model
    share = flight.observer.hover_thrust_estimate / model.hover_thrust
    return (share if math.isfinite(share) else 1.0) * model.gravity_mps2


# ---------------------------------------------------------------------- requests, texts, queue


def request(flight: FlightState, request: CommandLong) -> bool:
    """Send a command if `Authority.permits_command`, once in a phase, and again under the
    conditions of README.md ("A request is sent once"). Returns whether it was sent."""
    result = flight.vehicle.results.get(request.command)
    requested_s, host_s = flight.requested_s.get(request, NEVER)
    waits = flight.now_s - requested_s < REPEAT_S - 1e-6 or flight.authority.report_s < requested_s
    # A TIMESYNC request is sent at each tick, and without telemetry there are no ticks
    has_ticks = flight.vehicle.has_state and flight.silence_s < REPEAT_S
    is_answered = has_ticks and flight.clock.unanswered_s(flight.host_s) < ANSWERS_S
    waits = waits or (is_answered and flight.mode_after_s < host_s)
    passed_s = flight.now_s - flight.vehicle.answered_s.get(request.command, -math.inf)
    accepted = result in GOOD_RESULTS and not (flight.phase in ENDING and passed_s > EFFECT_S)
    done = math.isfinite(requested_s) and accepted
    if waits or done or not flight.authority.permits_command(flight.now_s):
        return False
    flight.vehicle.results.pop(request.command, None)
    send_request(flight, request)
    return True


def send_request(flight: FlightState, request: CommandLong) -> None:
    """Send a request, and note the link time and the host time."""
    flight.requested_s[request] = flight.now_s, flight.host_s
    send(flight, request)


def announce(flight: FlightState, sentence: str, *, once: bool = False) -> None:
    """Report a sentence to the user, the ground station and the log. `once`: whether to report it
    only once in this flight."""
    if once and sentence in flight.told:
        return
    if once:
        flight.told.add(sentence)
    _show(flight, sentence)
    _say(flight, INFO, EventRecord(sentence))


def announce_phase(flight: FlightState, reason: str, cause: str) -> None:
    """Report that the phase begins. `cause` is a word for the log; it may be empty."""
    flown = flight.outcome is not None and flight.outcome.exit_code == ExitCode.FLOWN
    name = "ended" if flight.phase is Phase.FAILED and flown else flight.phase.value
    sentence = f"{name}: {reason}"
    _show(flight, sentence)
    _say(flight, INFO, EventRecord(sentence, flight.phase.code, cause), title="offboard: ")


def warn(flight: FlightState, sentence: str) -> None:
    """Report a sentence to the ground station and the log, but not to the user."""
    _say(flight, WARNING, EventRecord(sentence))


def _show(flight: FlightState, sentence: str) -> None:
    """Report to the user. Only the newest sentences are kept: a vehicle may wait for weeks."""
    flight.announcements += 1
    flight.announced.append(sentence)
    del flight.announced[:-ANNOUNCED_KEPT]


def _say(flight: FlightState, severity: int, event: EventRecord, title: str = "") -> None:
    """Send the text, after `title`, as STATUSTEXT to the ground station; log it as a record."""
    flight.text_id = flight.text_id % TEXT_ID_MAX + 1
    send(flight, *chunks(severity, title + event.text, flight.text_id))
    send(flight, *event_record.pieces(event))


def send(flight: FlightState, *messages: Outgoing) -> None:
    """Queue messages to send and to log; records are only logged."""
    for message in messages:
        if isinstance(message, Record):
            flight.records.append(message)
        else:
            flight.queue.append(message)


def flush(flight: FlightState) -> tuple[bytes, ...]:
    """Encode what is to be sent."""
    queue, flight.queue = flight.queue, []  # emptied first: one of them may not be encodable
    return tuple(map(flight.session.encode, queue))


def log(flight: FlightState) -> list[bytes]:
    """Encode what is only logged."""
    records, flight.records = flight.records, []
    return [flight.session.encode(record) for record in records]
