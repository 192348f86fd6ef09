"""`python -m offboard` is the `offboard` command. This module only loads it.

Ctrl-C during the imports, which take some tenths of a second, is answered with a sentence.
"""

from __future__ import annotations

import os
import signal
from types import FrameType


def main() -> None:
    """Run the command in `sys.argv`."""
    signal.signal(signal.SIGINT, _interrupted)
    from offboard.cli import main as run

    run()


def _interrupted(number: int, frame: FrameType | None) -> None:
    """Exit at once: an exception would end in whatever module is being imported."""
    os.write(2, b"interrupted before anything was sent\n")
    os._exit(2)


if __name__ == "__main__":
    main()
