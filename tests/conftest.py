"""Before any test: everything is compiled, so that no test waits for it."""

from __future__ import annotations

import importlib
import os
import signal
import sys

import pytest

from offboard.compiled import prepare

COMPILED = (
    "offboard.control.laws.horizon",
    "offboard.control.laws.pso",
    "offboard.flight.request",
    "offboard.paper.plant",
    "simulator.vehicle.dynamics",
)

# Ignored signals are inherited: started in the background or under nohup, the processes of the
# tests would not hear the Ctrl-C that they are sent
for _number, _handler in (
    (signal.SIGINT, signal.default_int_handler),
    (signal.SIGHUP, signal.SIG_DFL),
    (signal.SIGTERM, signal.SIG_DFL),
):
    if signal.getsignal(_number) is signal.SIG_IGN:
        signal.signal(_number, _handler)

# Tests that limit the size of files would leave truncated bytecode, on which later imports fail
sys.dont_write_bytecode = True
os.environ["PYTHONDONTWRITEBYTECODE"] = "1"


def pytest_sessionstart(session: pytest.Session) -> None:
    if not hasattr(session.config, "workerinput") and not session.config.option.collectonly:
        for name in COMPILED:
            importlib.import_module(name)
        prepare()
