"""The only module that reads the clock. Everything else is handed the time as an argument."""

from __future__ import annotations

import time


def monotonic_s() -> float:
    """Seconds on a clock that never jumps; its zero is arbitrary."""
    return time.monotonic()


def unix_us() -> int:
    """Microseconds since 1970-01-01 UTC, for log stamps only."""
    return time.time_ns() // 1000


def local_stamp() -> str:
    """Local date and time for the names of things, as 20261121-093000."""
    return time.strftime("%Y%m%d-%H%M%S")
