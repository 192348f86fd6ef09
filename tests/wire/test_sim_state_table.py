"""State tables of both firmwares name only what exists."""

from __future__ import annotations

from collections.abc import Iterator
from string import Formatter

import pytest

from simulator.autopilot.commander import ACTIONS, CONDITIONS, TEXT_VALUES
from simulator.firmware.base import AFTER_DELAY, EVENTS, Firmware, Rule
from simulator.firmware.catalogue import FIRMWARES

pytestmark = pytest.mark.parametrize("firmware", FIRMWARES.values(), ids=FIRMWARES)


def unknown(firmware: Firmware, rule: Rule) -> Iterator[str]:
    """What a row names that does not exist."""
    known = EVENTS.union((event + AFTER_DELAY for event in EVENTS), firmware.boot_events_s)
    yield from {rule.event} - known
    yield from {rule.mode} - {*firmware.modes, "*"}
    yield from {rule.to} - {*firmware.modes, "*", "requested", "remembered"}
    yield from set(rule.do) - ACTIONS.keys()
    yield from (name for name in rule.when if not exists(firmware, name.removeprefix("not ")))
    fields = (name for text in rule.texts for _, name, _, _ in Formatter().parse(text.text))
    yield from {name for name in fields if name is not None} - TEXT_VALUES.keys()


def exists(firmware: Firmware, condition: str) -> bool:
    name, compares, value = condition.partition("=")
    if compares:
        known = any(name == spec.name for spec in firmware.parameters)
        return known and value.lstrip("-").isdecimal()
    kind, _, event = condition.partition(" ")
    if kind in ("since", "latched"):
        return event in EVENTS
    return event in firmware.boot_events_s if kind == "reached" else condition in CONDITIONS


def test_rows_name_only_what_exists(firmware: Firmware) -> None:
    assert [(rule, name) for rule in firmware.rules for name in unknown(firmware, rule)] == []
    assert len(firmware.rules) > 50
    wrong = Rule("arm", when=("not amred", "COM_X=1"), to="LND")
    assert list(unknown(firmware, wrong)) == ["LND", "not amred", "COM_X=1"]
