"""State tables: rows that name something unknown are refused, for both firmwares."""

from __future__ import annotations

import re
from dataclasses import replace

import pytest
from sim_bench import Bench

from simulator.autopilot.commander import ACTIONS, CONDITIONS, TEXT_VALUES
from simulator.autopilot.state_table import StateTable
from simulator.firmware.base import Firmware, Rule
from simulator.firmware.catalogue import FIRMWARES
from simulator.firmware.values import critical

FIRMWARE = pytest.mark.parametrize("firmware", FIRMWARES.values(), ids=FIRMWARES)


def table(firmware: Firmware, *rules: Rule) -> StateTable:
    return StateTable(replace(firmware, rules=rules), CONDITIONS, ACTIONS, TEXT_VALUES)


@FIRMWARE
@pytest.mark.parametrize(
    ("rule", "error"),
    [
        (Rule("stream lst"), "unknown event 'stream lst'"),
        (Rule("arm", "OFBOARD"), "unknown mode 'OFBOARD'"),
        (Rule("arm", to="LND"), "unknown next mode 'LND'"),
        (Rule("arm", when=("amred",)), "unknown condition 'amred'"),
        (Rule("arm", when=("not amred",)), "unknown condition 'not amred'"),
        (Rule("arm", when=("COM_OBL_ACT=1",)), "unknown condition 'COM_OBL_ACT=1'"),
        (Rule("arm", when=("since never",)), "unknown condition 'since never'"),
        (Rule("arm", when=("reached never",)), "unknown condition 'reached never'"),
        (Rule("arm", do=("failsave",)), "unknown action 'failsave'"),
        (Rule("arm", texts=(critical("at {height_ft} ft"),)), "unknown value 'height_ft'"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_a_row_that_names_something_unknown_is_refused(
    firmware: Firmware, rule: Rule, error: str
) -> None:
    sentence = f"{firmware.name} rule 1 ({rule.event!r}): {error}"
    with pytest.raises(ValueError, match=f"^{re.escape(sentence)}$"):
        table(firmware, Rule("arm"), rule)


@FIRMWARE
def test_all_rows_of_the_firmware_are_accepted(firmware: Firmware) -> None:
    table(firmware, *firmware.rules)
    assert len(firmware.rules) > 50


@FIRMWARE
def test_the_first_row_that_fits_decides(firmware: Firmware) -> None:
    first, second, last = (
        Rule("arm", when=("armed", "not landed")),
        Rule("arm", when=("armed",)),
        Rule("arm"),
    )
    rows = table(firmware, first, second, last)
    mode = firmware.boot_mode
    assert rows.row("arm", mode, {"armed": True, "not landed": True}.__getitem__) is first
    assert rows.row("arm", mode, {"armed": True, "not landed": False}.__getitem__) is second
    assert rows.row("arm", mode, lambda _: False) is last
    assert rows.row("disarm", mode, lambda _: True) is None


@FIRMWARE
def test_an_event_that_no_firmware_knows_is_an_error(firmware: Firmware) -> None:
    bench = Bench(firmware=firmware)
    with pytest.raises(KeyError):
        bench.instance.autopilot.handle("stream lst")
