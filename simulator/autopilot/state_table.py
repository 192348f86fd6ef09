"""State table of a firmware: which row decides about an event, and checks of its rows.

The first row of an event whose mode and conditions fit decides. `simulator.autopilot.commander`
evaluates the conditions and applies the row.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator
from string import Formatter

from simulator.firmware.base import AFTER_DELAY, EVENTS, Firmware, Rule

_NEXT_MODES = frozenset({"*", "requested", "remembered"})


class StateTable:
    """Rows by event, in their order.

    Args:
        firmware: whose rules.
        conditions, actions, text_values: names that rows may use.

    Raises:
        ValueError: a row names an event, mode, condition, action, parameter or text value that
            does not exist; the message lists all of them.
    """

    def __init__(
        self,
        firmware: Firmware,
        conditions: Collection[str],
        actions: Collection[str],
        text_values: Collection[str],
    ) -> None:
        self._firmware, self._conditions = firmware, conditions
        self._actions, self._text_values = actions, text_values
        delayed = (event + AFTER_DELAY for event in EVENTS)
        events = EVENTS.union(delayed, firmware.boot_events_s)
        self._rows: dict[str, list[Rule]] = {event: [] for event in events}
        faults = [
            f"{firmware.name} rule {number} ({rule.event!r}): unknown {fault}"
            for number, rule in enumerate(firmware.rules)
            for fault in self._unknown(rule)
        ]
        if faults:
            raise ValueError("\n".join(faults))
        for rule in firmware.rules:
            self._rows[rule.event].append(rule)

    def knows(self, event: str) -> bool:
        """There are rows for an event."""
        return bool(self._rows[event])

    def row(self, event: str, mode: str, holds: Callable[[str], bool]) -> Rule | None:
        """The row that decides about an event in the mode of this name; None: nothing happens."""
        for rule in self._rows[event]:
            if rule.mode in ("*", mode) and all(map(holds, rule.when)):
                return rule
        return None

    def _unknown(self, rule: Rule) -> Iterator[str]:
        """What a row names that does not exist."""
        modes = self._firmware.modes
        if rule.event not in self._rows:
            yield f"event {rule.event!r}"
        if rule.mode not in modes and rule.mode != "*":
            yield f"mode {rule.mode!r}"
        if rule.to not in modes and rule.to not in _NEXT_MODES:
            yield f"next mode {rule.to!r}"
        yield from (f"action {name!r}" for name in rule.do if name not in self._actions)
        yield from (f"condition {name!r}" for name in rule.when if not self._exists(name))
        values = (name for text in rule.texts for name in fields_of(text.text))
        yield from (f"value {name!r}" for name in values if name not in self._text_values)

    def _exists(self, condition: str) -> bool:
        condition = condition.removeprefix("not ")
        name, compares, value = condition.partition("=")
        if compares:
            known = any(name == spec.name for spec in self._firmware.parameters)
            return known and value.lstrip("-").isdecimal()
        kind, _, event = condition.partition(" ")
        if kind in ("since", "latched"):
            return event in EVENTS
        if kind == "reached":
            return event in self._firmware.boot_events_s
        return condition in self._conditions


def fields_of(text: str) -> list[str]:
    """Names of the values that a text has placeholders for."""
    return [name for _, name, _, _ in Formatter().parse(text) if name is not None]
