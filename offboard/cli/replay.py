"""`offboard replay`: the recorded telemetry once more through the whole companion."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from offboard.cli.shared import FILE, FLIGHT, CommandError, complain, option, out, say

if TYPE_CHECKING:
    from offboard.replay.recording import Recording

EXIT_CODES = (
    "Exit codes: 0 all identical, or rounded differently by another computer; 1 a setpoint or a "
    "command differs; 2 the log cannot be replayed, or there is nothing to compare."
)


def replay(
    flight: Annotated[Path, FLIGHT],
    at: Annotated[
        float | None,
        option("SECONDS", "Stop at this vehicle time and print the state of the tick.", "--at"),
    ] = None,
    controller: Annotated[
        str | None, option(FILE, "Let another controller decide beside the flight's own.")
    ] = None,
) -> None:
    """Replay a flight from its .tlog and compare every setpoint.

    Gives the controller what it received, turn by turn, and compares what it sends now with what
    it sent then, byte by byte; rounding of another processor is named, and is no difference.
    Prints the first difference, and the messages before it. With --controller, the other one is
    asked in every situation of the flight, and what it would have commanded is compared with the
    flight's commands; that is no test. Flights of `offboard daemon` cannot be replayed: their logs
    do not hold what was received in standby.
    """
    if at is not None and controller is not None:
        raise CommandError("--at and --controller are two questions: use one of them")
    from offboard.compiled import loading

    with loading():
        from offboard.replay.recording import read
    recording = read(flight)
    if recording.log.damage:
        complain(recording.log.damage)
    if at is not None:
        _show_moment(recording, at)
    elif controller is not None:
        _show_other(recording, controller)
    else:
        _show_verdict(recording)


def _show_verdict(recording: Recording) -> None:
    from offboard.replay.verdict import explained, verdict

    result = verdict(recording)
    if result.incomplete:
        complain(result.incomplete)
    sentence = result.comparison.sentence()
    if not result.comparison.significant:
        say(f"{sentence} ({result.turns} turns, up to {result.ended_s:.1f} s of vehicle time)")
        return
    say("the first difference:")
    for line in explained(recording, result.comparison.significant[0]):
        say(f"  {line}", indent=6)
    raise CommandError(sentence, 1)


def _show_moment(recording: Recording, time_s: float) -> None:
    from offboard.replay.moment import moment_at
    from offboard.replay.replaying import Replay

    for title, rows in moment_at(Replay(recording), time_s).items():
        out.print(f"[bold]{title}[/bold]")
        width = max(len(name) for name, _ in rows) if rows else 0
        for name, value in rows:
            say(f"  {name:<{width}}  {value}".rstrip(), indent=width + 4)


def _show_other(recording: Recording, controller: str) -> None:
    from offboard.replay.other_law import other_law

    lines, incomplete = other_law(recording, controller)
    if incomplete:
        complain(incomplete)
    for line in lines:
        say(line, indent=2)
