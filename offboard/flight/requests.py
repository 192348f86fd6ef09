"""Requests over MAVLink: what a ground station may ask our component for, and the answer.

MAV_CMD_MISSION_START (300) starts the reference, MAV_CMD_DO_PAUSE_CONTINUE (193) pauses and
continues it, MAV_CMD_DO_SET_MODE (176), with any parameters, hands the vehicle back.
"""

from __future__ import annotations

from enum import IntEnum

from offboard.flight import outbox
from offboard.flight.phases import MOVING, TRACKING, Phase, Request
from offboard.flight.starting import can_take_over, usable
from offboard.flight.state import FlightState
from offboard.mavlink.events import CommandRequest
from offboard.mavlink.outgoing import CommandResult

START, PAUSE_CONTINUE, SET_MODE = 300, 193, 176  # MAV_CMD
BEGINNING = (Phase.STREAM, Phase.ENGAGE, Phase.ARM, Phase.TAKEOFF)
ENDING = (Phase.HAND_BACK, Phase.HOLD)


class Result(IntEnum):
    """MAV_RESULT."""

    ACCEPTED = 0
    TEMPORARILY_REJECTED = 1
    DENIED = 2
    UNSUPPORTED = 3


def answer(flight: FlightState, asked: CommandRequest) -> None:
    """Acknowledge a command to us; the next tick does what it asks for."""
    result = Result.UNSUPPORTED
    if flight.service:
        result, request = _judged(flight, asked.command, asked.parameters)
        if request is not Request.NONE:
            flight.request = request
            sender = f"system {asked.system_id} component {asked.component_id}"
            outbox.announce(flight, f"{request.value} requested by {sender}")
    outbox.send(flight, CommandResult(asked.command, result, asked.system_id, asked.component_id))


Answer = tuple[Result, Request]
NOTHING_TO_DO: Answer = (Result.ACCEPTED, Request.NONE)
NOT_NOW: Answer = (Result.TEMPORARILY_REJECTED, Request.NONE)
DENIED: Answer = (Result.DENIED, Request.NONE)


def _judged(flight: FlightState, command: int, parameters: tuple[float, ...]) -> Answer:
    """The result to acknowledge `command` with, and what is to be done."""
    if command == START:
        return _start(flight)
    if command == PAUSE_CONTINUE:
        return _pause_or_continue(flight.phase, parameters[0])
    if command == SET_MODE:
        if flight.phase in TRACKING or flight.phase in BEGINNING:
            return Result.ACCEPTED, Request.HAND_BACK
        return NOTHING_TO_DO if flight.phase in ENDING else DENIED
    return Result.UNSUPPORTED, Request.NONE


def _start(flight: FlightState) -> Answer:
    if flight.phase in TRACKING:
        return Result.ACCEPTED, Request.START
    if flight.phase in BEGINNING:
        return NOTHING_TO_DO
    if flight.phase is not Phase.STANDBY:
        return NOT_NOW
    armed = flight.vehicle.armed
    if not armed and not (flight.service and flight.service.arms):
        return DENIED
    fit = usable(flight) and (not armed or can_take_over(flight))
    return (Result.ACCEPTED, Request.START) if fit else NOT_NOW


def _pause_or_continue(phase: Phase, parameter: float) -> Answer:
    wanted = {0.0: Request.PAUSE, 1.0: Request.CONTINUE}.get(parameter)
    if wanted is None:
        return DENIED
    if phase in MOVING:
        return (Result.ACCEPTED, wanted) if wanted is Request.PAUSE else NOTHING_TO_DO
    if phase is Phase.PAUSE:
        return (Result.ACCEPTED, wanted) if wanted is Request.CONTINUE else NOTHING_TO_DO
    return NOTHING_TO_DO if phase is Phase.HOVER else NOT_NOW
