"""The rows of a state table.

What a row does is `simulator.autopilot.commander`'s; which there are, the firmware's.
"""

from __future__ import annotations

from dataclasses import dataclass

from simulator.firmware.vocabulary import Result, Say

AT_LAST = ", at last"  # ends the event of a failsafe that was put off


@dataclass(frozen=True, slots=True)
class Rule:
    """One row of the state table: the first row that fits an event decides.

    event: name of what happened. mode: name of the mode it happened in, or "*".
    when: names of guards that must all hold; "NAME=2" compares a parameter, "not X" negates,
        "since X" is a failsafe because of event X.
    to: next mode, "*" none, "requested" the mode asked for, "remembered" the last one chosen.
    do: actions ("arm", "disarm", "failsafe", "await", "recover", "take off", "return", "hold",
        "level", "latch", "restart").
    result: what a command is answered with. say, also: texts. send: messages to every link.
    """

    event: str
    mode: str = "*"
    when: tuple[str, ...] = ()
    to: str = "*"
    do: tuple[str, ...] = ()
    result: Result = Result.ACCEPTED
    say: Say | None = None
    also: tuple[Say, ...] = ()
    send: tuple[str, ...] = ()
