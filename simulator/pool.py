"""Vehicles one after the other, from a process that has loaded everything before it is asked.

A line of standard input, the options of the `simulator` command as a JSON list, starts a vehicle in
a fork of this process; an empty line, or the end of the input, ends it. Once it is gone its exit
code is printed, negative for a signal. A start takes a second, a fork milliseconds; what flies is
the same command with the same bytes.
"""

from __future__ import annotations

import gc
import json
import os
import select
import signal
import sys
import traceback
from io import FileIO
from typing import NoReturn

from simulator.cli import app


def serve(orders: FileIO) -> None:
    """Answer `orders` to their end. They must not be read ahead: select has to see what waits."""
    _load()
    for line in orders:
        if line.strip():
            print(_flown(json.loads(line), orders), flush=True)


def _flown(options: list[str], orders: FileIO) -> int:
    """The exit code of a vehicle that flew until it ended, or the next order came."""
    alive, lifeline = os.pipe()  # its end is seen when the last holder of `lifeline` is gone
    vehicle = os.fork()
    if vehicle == 0:
        _fly(options)
    os.close(lifeline)
    ready, _, _ = select.select([orders.fileno(), alive], [], [])
    if alive not in ready:
        os.kill(vehicle, signal.SIGKILL)
    os.close(alive)
    _, status = os.waitpid(vehicle, 0)
    return os.waitstatus_to_exitcode(status)


def _fly(options: list[str]) -> NoReturn:
    """The `simulator` command, in this process."""
    nowhere = os.open(os.devnull, os.O_RDWR)
    os.dup2(nowhere, 0)
    os.dup2(nowhere, 1)
    code = 1
    try:
        app(options)
    except SystemExit as ended:
        code = int(ended.code or 0)
    except BaseException:
        traceback.print_exc()
    sys.stderr.flush()
    os._exit(code)  # nothing of the process that it was forked from is its to end


def _load() -> None:
    """Import what a flight takes and have its compiled functions loaded."""
    from offboard.compiled import prepare
    from simulator import config, run
    from simulator.firmware.catalogue import FIRMWARES
    from simulator.instance import Instance
    from simulator.vehicle.conditions import Conditions

    assert run
    prepare()
    for firmware in FIRMWARES.values():
        vehicle = config.vehicle(firmware.vehicle)
        Instance(firmware, vehicle, Conditions(), 1, lockstep=True).advance_to_barrier()
    gc.collect()
    gc.freeze()  # what is never freed is not copied


if __name__ == "__main__":
    with FileIO(0, closefd=False) as standard_input:
        serve(standard_input)
