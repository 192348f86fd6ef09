"""The state tables in simulator/README.md are those of the code, and name only what exists.

`python tests/test_simulator_readme.py` writes the tables.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path
from string import Formatter
from typing import get_args

import pytest

from simulator import config
from simulator.autopilot.commander import ACTIONS, CONDITIONS, TEXT_VALUES
from simulator.autopilot.firmware import AFTER_DELAY, ByParameter, Firmware, Rule
from simulator.autopilot.values import Behaviour, Result
from simulator.faults import Fault
from simulator.faults.fault import Timed
from simulator.firmware import FIRMWARES

ROOT = Path(__file__).parents[1]
README = ROOT / "simulator" / "README.md"
# Strings in the code outside the tables, among them the events that it raises
NAMED = frozenset(
    node.value
    for path in (ROOT / "simulator").rglob("*.py")
    if not path.name.endswith("_tables.py")
    for node in ast.walk(ast.parse(path.read_text()))
    if isinstance(node, ast.Constant) and isinstance(node.value, str)
)
HEAD = ("event", "in mode", "if", "next mode", "answer and texts")


def table(firmware: Firmware) -> str:
    """Return the state table of one firmware as Markdown."""
    rows = [HEAD, ("---",) * len(HEAD)]
    for rule in firmware.rules:
        mode, to = ("any" if rule.mode == "*" else rule.mode), target(rule)
        answer = () if rule.result is Result.ACCEPTED else (rule.result.name,)
        texts = (f'"{text.text}"' for text in rule.texts)
        rows.append((rule.event, mode, " and ".join(rule.when), to, " ".join((*answer, *texts))))
    return "\n".join("| " + " | ".join(row) + " |" for row in rows)


def target(rule: Rule) -> str:
    """Return the next mode of a row as text for the table."""
    if isinstance(rule.to, ByParameter):
        modes = ", ".join(f"{value} {mode}" for value, mode in sorted(rule.to.modes.items()))
        return f"by {rule.to.parameter}: {modes}"
    return rule.to.replace("*", "")


def with_tables(text: str) -> str:
    """Return the README with the tables replaced between their markers."""
    for name, firmware in FIRMWARES.items():
        begin, end = f"<!-- {name}:begin -->\n", f"<!-- {name}:end -->"
        before, _, rest = text.partition(begin)
        _, _, after = rest.partition(end)
        text = f"{before}{begin}{table(firmware)}\n{end}{after}"
    return text


@pytest.mark.parametrize("firmware", FIRMWARES.values(), ids=FIRMWARES)
def test_state_tables_match_the_code(firmware: Firmware) -> None:
    assert table(firmware) in README.read_text(), "run: python tests/test_simulator_readme.py"


def test_fault_table_lists_every_fault_with_keys_and_scenarios() -> None:
    faults = get_args(get_args(Fault)[0])
    named = {get_args(fault.model_fields["fault"].annotation)[0]: fault for fault in faults}
    section = README.read_text().partition("## Faults")[2].partition("## Behaviours")[0]
    keys: dict[str, set[str]] = {}
    for row in (line for line in section.splitlines() if line.startswith("| `")):
        cells = [set(re.findall(r"`(\w+)`", cell)) for cell in row.split(" | ")]
        for name in cells[0]:
            keys.setdefault(name, set()).update(cells[1])
        for name in cells[-1]:
            assert {fault.fault for fault in config.scenario(name).faults} & cells[0], row
    assert keys.keys() == named.keys()
    for name, fault in named.items():
        assert fault.model_fields.keys() - Timed.model_fields - {"fault"} <= keys[name], name


def unknown(firmware: Firmware, rule: Rule) -> Iterator[str]:
    """The names in a row that do not exist."""
    known = NAMED.union((event + AFTER_DELAY for event in NAMED), firmware.boot_events_s)
    yield from {rule.event} - known
    yield from set(rule.mode.split()) - {*firmware.modes, "*"}
    if isinstance(rule.to, ByParameter):
        yield from set(rule.to.modes.values()) - firmware.modes.keys()
        yield from {rule.to.parameter} - {spec.name for spec in firmware.parameters}
    else:
        yield from {rule.to} - {*firmware.modes, "*", "requested", "remembered"}
    yield from set(rule.do) - ACTIONS.keys()
    yield from (name for name in rule.when if not exists(firmware, name.removeprefix("not ")))
    fields = (name for text in rule.texts for _, name, _, _ in Formatter().parse(text.text))
    yield from {name for name in fields if name is not None} - TEXT_VALUES.keys()


def exists(firmware: Firmware, condition: str) -> bool:
    name, compares, value = condition.replace("&", "=").partition("=")
    if compares:
        known = any(name == spec.name for spec in firmware.parameters)
        return known and all(map(str.isdecimal, value.split(",")))
    kind, _, event = condition.partition(" ")
    if kind in ("since", "latched"):
        return event in NAMED
    if kind == "requests":
        return event in firmware.modes
    return event in firmware.boot_events_s if kind == "reached" else condition in CONDITIONS


@pytest.mark.parametrize("firmware", FIRMWARES.values(), ids=FIRMWARES)
def test_rules_name_only_existing_events_modes_and_parameters(firmware: Firmware) -> None:
    assert [(rule, name) for rule in firmware.rules for name in unknown(firmware, rule)] == []
    assert len(firmware.rules) > 50
    wrong = Rule("arm", when=("not amred", "COM_X=1"), to="LND")
    assert list(unknown(firmware, wrong)) == ["LND", "not amred", "COM_X=1"]
    wrong = Rule("arm", f"{firmware.boot_mode} LND", to=ByParameter("COM_X", {1: "DRFT"}))
    assert list(unknown(firmware, wrong)) == ["LND", "DRFT", "COM_X"]
    known = firmware.system_parameter
    assert [exists(firmware, f"{known}={values}") for values in ("1,2", "1,,2")] == [True, False]


def test_example_of_a_behaviour_is_a_new_member() -> None:
    """A text that another member has would make it an alias of that member."""
    recipe = README.read_text().partition("To add a behaviour")[2]
    example = re.search(r'`(\w+) = "(.+?)"`', recipe)
    assert example
    assert not {each.value for each in Behaviour} & {example[2]}


def test_both_firmwares_have_the_same_parameter_roles() -> None:
    px4, ardupilot = (firmware.parameter_roles.keys() for firmware in FIRMWARES.values())
    assert px4 == ardupilot


if __name__ == "__main__":
    README.write_text(with_tables(README.read_text()))
