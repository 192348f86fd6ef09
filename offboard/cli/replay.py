"""`offboard replay`: the recorded telemetry once more through the whole companion."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from offboard.cli.shared import FLIGHT, complain, err, say
from offboard.documents.errors import UserError

EXIT_CODES = (
    "Exit codes: 0 all identical, or rounded differently by another computer; 1 a setpoint or a "
    "command differs; 2 the log cannot be replayed, or there is nothing to compare."
)


def replay(flight: Annotated[Path, FLIGHT]) -> None:
    """Replay a flight from its .tlog and compare every setpoint.

    Gives the controller what it received, turn by turn, and compares what it sends now with what
    it sent then, byte by byte; rounding of another processor is named, and is no difference.
    Prints the first difference, and the messages before it. Flights of `offboard daemon` cannot be
    replayed: their logs do not hold what was received in standby.
    """
    from offboard.replay.difference import explained, verdict
    from offboard.replay.recording import read
    from offboard.replay.replaying import Replay

    recording = read(flight)
    if recording.log.damage:
        complain(recording.log.damage)
    replayed = Replay(recording)
    with err.status("replaying") as status:
        comparison = verdict(replayed, status.update)
    if replayed.incomplete:
        complain(replayed.incomplete)
    sentence = comparison.sentence()
    if not comparison.significant:
        say(f"{sentence} ({replayed.count} turns, up to {replayed.ended_s:.1f} s of vehicle time)")
        return
    say("the first difference:")
    for line in explained(recording, comparison.significant[0]):
        say(f"  {line}", indent=6)
    raise UserError(sentence, 1)
