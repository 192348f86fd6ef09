"""Console entry point of the `simulator` command, which is in `command`."""

from __future__ import annotations

import os
import signal
import threading
from typing import NoReturn

from offboard.documents.command_line import run


def main() -> NoReturn:
    """Run the command in `sys.argv` and exit. A UserError is printed as a sentence."""
    run("simulator.command")


def main_until_input_ends() -> NoReturn:
    """Run the command as `main`, and end it as SIGTERM does when its standard input ends. That is a
    pipe of the process that started it, so that the simulator does not outlive that process."""
    threading.Thread(target=_follow_input, daemon=True).start()
    main()


def _follow_input() -> None:
    os.read(0, 1)
    os.kill(os.getpid(), signal.SIGTERM)
