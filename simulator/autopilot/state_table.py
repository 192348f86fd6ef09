"""State table of a firmware: which row decides about an event; checks of its rows; a listing.

The first row of an event whose mode and conditions fit decides. Whether a condition holds and what
the row then changes is `simulator.autopilot.commander`'s.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator
from string import Formatter

from simulator.firmware.base import AFTER_DELAY, EVENTS, Firmware, Rule
from simulator.firmware.values import Result

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
        self._rows: dict[str, list[Rule]] = {event: [] for event in _events(firmware)}
        faults = [
            f"{firmware.name} rule {number} ({rule.event!r}): unknown {fault}"
            for number, rule in enumerate(firmware.rules)
            for fault in _unknown(rule, firmware, conditions, actions, text_values)
        ]
        if faults:
            raise ValueError("\n".join(faults))
        for rule in firmware.rules:
            self._rows[rule.event].append(rule)

    def knows(self, event: str) -> bool:
        """Whether there are rows for an event."""
        return bool(self._rows[event])

    def row(self, event: str, mode: str, holds: Callable[[str], bool]) -> Rule | None:
        """The row that decides about an event in the mode of this name; None: nothing happens."""
        for rule in self._rows[event]:
            if rule.mode in ("*", mode) and all(map(holds, rule.when)):
                return rule
        return None


def fields_of(text: str) -> list[str]:
    """Names of the values that a text has places for."""
    return [name for _, name, _, _ in Formatter().parse(text) if name is not None]


def _events(firmware: Firmware) -> frozenset[str]:
    delayed = (event + AFTER_DELAY for event in EVENTS)
    return EVENTS.union(delayed, firmware.health.boot)


def _unknown(
    rule: Rule,
    firmware: Firmware,
    conditions: Collection[str],
    actions: Collection[str],
    text_values: Collection[str],
) -> Iterator[str]:
    """What a row names that does not exist."""
    if rule.event not in _events(firmware):
        yield f"event {rule.event!r}"
    if rule.mode not in firmware.modes and rule.mode != "*":
        yield f"mode {rule.mode!r}"
    if rule.to not in firmware.modes and rule.to not in _NEXT_MODES:
        yield f"next mode {rule.to!r}"
    yield from (f"action {name!r}" for name in rule.do if name not in actions)
    yield from (f"condition {c!r}" for c in rule.when if not _exists(c, firmware, conditions))
    for text in rule.texts:
        yield from (f"value {name!r}" for name in fields_of(text.text) if name not in text_values)


def _exists(condition: str, firmware: Firmware, conditions: Collection[str]) -> bool:
    condition = condition.removeprefix("not ")
    name, compares, value = condition.partition("=")
    if compares:
        known = any(name == spec.name for spec in firmware.parameters)
        return known and value.lstrip("-").isdecimal()
    for prefix, events in (
        ("since ", EVENTS),
        ("latched ", EVENTS),
        ("reached ", firmware.health.boot),
    ):
        if condition.startswith(prefix):
            return condition.removeprefix(prefix) in events
    return condition in conditions


def describe(firmware: Firmware) -> list[tuple[str, str, str, str, str]]:
    """The rows as text: event, mode, conditions, next mode, answer and texts."""
    return [
        (
            rule.event,
            "any" if rule.mode == "*" else rule.mode,
            " and ".join(rule.when),
            "" if rule.to == "*" else rule.to,
            " ".join(
                (
                    *((rule.result.name,) if rule.result is not Result.ACCEPTED else ()),
                    *(f'"{text.text}"' for text in rule.texts),
                )
            ),
        )
        for rule in firmware.rules
    ]
