"""Runs vehicles one after the other, each in a fork of a process that has loaded all modules.

A line of standard input, the options of the `simulator` command as a JSON list, starts a vehicle.
An empty line, or the end of the input, ends it. Its exit code is then printed, negative if a signal
ended it. A fork takes milliseconds, a new process a second; the vehicle sends the same bytes.
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

from offboard.compiled import prepare
from offboard.documents.command_line import run


def serve(requests: FileIO) -> None:
    """Run a vehicle for each line of `requests`: an unbuffered file, as `select` waits for it."""
    _load()
    gc.freeze()  # the garbage collector then leaves the memory alone that the forks share
    for line in requests:
        if line.strip():
            print(_exit_code(json.loads(line), requests), flush=True)


def _exit_code(options: list[str], requests: FileIO) -> int:
    """Run a vehicle until it ends or the next line arrives; return its exit code."""
    ended, open_end = os.pipe()  # `ended` is readable once the vehicle's process has ended
    vehicle = os.fork()
    if vehicle == 0:
        _run(options)
    os.close(open_end)
    ready, _, _ = select.select([requests.fileno(), ended], [], [])
    if ended not in ready:
        os.kill(vehicle, signal.SIGKILL)
    os.close(ended)
    _, status = os.waitpid(vehicle, 0)
    return os.waitstatus_to_exitcode(status)


def _run(options: list[str]) -> NoReturn:
    """Run the `simulator` command in this process, without standard input and output."""
    null = os.open(os.devnull, os.O_RDWR)
    os.dup2(null, 0)
    os.dup2(null, 1)
    code = 1
    try:
        run("simulator.command", options)
    except SystemExit as ended:
        code = int(ended.code or 0)
    except BaseException:
        traceback.print_exc()
    sys.stderr.flush()
    os._exit(code)  # without the exit handlers of the parent process


def _load() -> None:
    """Import all modules of the simulator and load its compiled functions."""
    from simulator import command, config, launch
    from simulator.firmware import FIRMWARES
    from simulator.instance import Instance
    from simulator.vehicle.conditions import Conditions

    assert command
    assert launch
    prepare()
    for firmware in FIRMWARES.values():
        vehicle = config.vehicle(firmware.vehicle)
        Instance(firmware, vehicle, Conditions(), 1, lockstep=True).advance_to_barrier()


if __name__ == "__main__":
    with FileIO(0, closefd=False) as standard_input:
        serve(standard_input)
