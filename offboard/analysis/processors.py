"""How many processes may compute at once."""

from __future__ import annotations

import os


def processors() -> int:
    """Those that this process may use, where the system tells (Linux); else all."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
