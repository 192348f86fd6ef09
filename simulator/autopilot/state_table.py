"""The state table of a firmware: which row decides about what happened, and the table for people.

The first row of an event whose mode and guards fit. Whether a guard holds is told by whoever asks;
what the row then changes is theirs, too (`simulator.autopilot.commander`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

from simulator.firmware.base import Firmware
from simulator.firmware.rules import Rule
from simulator.firmware.vocabulary import Result


class StateTable:
    """Rows by the event that they are about, in their order."""

    def __init__(self, rules: Sequence[Rule]) -> None:
        self._rows: dict[str, list[Rule]] = {}
        for rule in rules:
            self._rows.setdefault(rule.event, []).append(rule)

    def knows(self, event: str) -> bool:
        """Whether there are rows for an event."""
        return event in self._rows

    def row(self, event: str, mode: str, holds: Callable[[str], bool]) -> Rule | None:
        """What decides about an event in the mode of this name; None: nothing happens."""
        for rule in self._rows.get(event, ()):
            if rule.mode in ("*", mode) and all(map(holds, rule.when)):
                return rule
        return None


def describe(firmware: Firmware) -> list[tuple[str, str, str, str, str]]:
    """The table for people: event, in mode, when, then mode, answer and text."""
    return [
        (
            rule.event,
            "any" if rule.mode == "*" else rule.mode,
            " and ".join(rule.when),
            "" if rule.to == "*" else rule.to,
            " ".join(
                part
                for part in (
                    rule.result.name if rule.result is not Result.ACCEPTED else "",
                    " ".join(f'"{say.text}"' for say in (rule.say, *rule.also) if say),
                )
                if part
            ),
        )
        for rule in firmware.rules
    ]
