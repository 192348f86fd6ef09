"""Compiles bytecode and machine code before the first test, so that no test waits for it."""

from __future__ import annotations

import compileall
import importlib
import os
import signal
import sys
from pathlib import Path

import pytest

from offboard.compiled import prepare

COMPILED = (
    "offboard.control.horizon",
    "offboard.control.law",
    "offboard.run.flight",
    "offboard.paper.closed_loop",
    "simulator.vehicle.dynamics",
)

# Restore the handlers of ignored signals. Processes inherit them: if pytest runs in the background
# or under nohup, the processes that tests start would ignore the Ctrl-C that the tests send
for _number, _handler in (
    (signal.SIGINT, signal.default_int_handler),
    (signal.SIGHUP, signal.SIG_DFL),
    (signal.SIGTERM, signal.SIG_DFL),
):
    if signal.getsignal(_number) is signal.SIG_IGN:
        signal.signal(_number, _handler)

# Tests of processes first, because they wait long; the many short ones at the end keep all workers
# busy until the end
ORDER = ("tests", "process", "clients", "wire", "flight", "replay", "export", "physics", "unit")

PACKAGES = (Path(__file__).parent.parent / name for name in ("offboard", "simulator"))

# All bytecode is written before the first test, that of the test modules while they are collected.
# Tests that limit the size of files would write truncated bytecode, with which later imports fail
sys.dont_write_bytecode = False
os.environ["PYTHONDONTWRITEBYTECODE"] = "1"
os.environ["OFFBOARD_REPORT"] = "0"  # flights of tests write no report


def pytest_xdist_auto_num_workers() -> int:
    """Return the number of workers for `-n auto`: one more than there are processors, because many
    tests wait for a vehicle in real time."""
    return (os.cpu_count() or 1) + 1


def pytest_sessionstart(session: pytest.Session) -> None:
    if not hasattr(session.config, "workerinput") and not session.config.option.collectonly:
        for package in PACKAGES:
            compileall.compile_dir(package, quiet=2)
        for name in COMPILED:
            importlib.import_module(name)
        prepare()


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    folders = {name: place for place, name in enumerate(ORDER)}
    items.sort(key=lambda item: folders.get(item.path.parent.name, len(ORDER)))


def pytest_collection_finish() -> None:
    """Stop writing bytecode; that of the test modules was written when they were imported."""
    sys.dont_write_bytecode = True
