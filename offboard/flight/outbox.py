"""Outbox: the queue of all messages of a flight, requests of modes, and texts.

`flush` encodes what is to be sent, `log` what is only logged, after that. Decides nothing; owns no
socket or file.
"""

from __future__ import annotations

import math

from offboard.flight.state import FlightState
from offboard.flight.vehicle_state import GOOD_RESULTS
from offboard.mavlink import event_record
from offboard.mavlink.event_record import EventRecord
from offboard.mavlink.outgoing import CommandLong, Outgoing, Record
from offboard.mavlink.texts import chunks

WARNING, INFO = 4, 6  # MAV_SEVERITY
TEXT_ID_MAX = 65535  # STATUSTEXT.id; 0 is for texts of one chunk
REPEAT_S = 1.0  # after this a request that was refused, or not answered, is sent again


def request(flight: FlightState, request: CommandLong) -> bool:
    """Send a command if the vehicle is ours; returns whether it was sent.

    In one phase it is sent once. Only one that was refused, or that nothing has answered, is
    sent again, after a second and a new report of the mode: a pilot may have changed it.
    """
    key = flight.phase, request
    result = flight.vehicle.results.get(request.command)
    requested_s = flight.requested_s.get(key, -math.inf)
    waits = flight.now_s - requested_s < REPEAT_S - 1e-6 or flight.authority.heard_s < requested_s
    done = math.isfinite(requested_s) and result in GOOD_RESULTS
    if waits or done or not flight.authority.permits_command(flight.now_s):
        return False
    flight.requested_s[key] = flight.now_s
    flight.vehicle.results.pop(request.command, None)
    send(flight, request)
    return True


def announce(flight: FlightState, sentence: str, *, once: bool = False) -> None:
    """Report to the user, the ground station and the log; `once`: unless it has been."""
    if not (once and sentence in flight.announced):
        flight.announced.append(sentence)
        _say(flight, INFO, EventRecord(sentence))


def announce_phase(flight: FlightState, reason: str, cause: str) -> None:
    """Report that the phase begins; `cause` is a word for the log, empty without one."""
    sentence = f"{flight.phase.value}: {reason}"
    flight.announced.append(sentence)
    _say(flight, INFO, EventRecord(sentence, flight.phase.code, cause), title="offboard: ")


def warn(flight: FlightState, sentence: str) -> None:
    """Report to the ground station and the log."""
    _say(flight, WARNING, EventRecord(sentence))


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
    queue, flight.queue = flight.queue, []  # empty, should one of them not be encodable
    return tuple(map(flight.session.encode, queue))


def log(flight: FlightState) -> list[bytes]:
    """Encode what is only logged."""
    records, flight.records = flight.records, []
    return [flight.session.encode(record) for record in records]
