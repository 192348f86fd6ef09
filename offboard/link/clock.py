"""The only module that reads a clock. All other modules have the time as an argument."""

from __future__ import annotations

import time


def monotonic_s() -> float:
    """Seconds of a clock that never jumps, from an arbitrary zero."""
    return time.monotonic()


def thread_s() -> float:
    """Seconds for which this thread has had a processor."""
    return time.thread_time()


def monotonic_less_unix_s() -> float:
    """What converts Unix seconds to `monotonic_s`. A pause between the two readings makes it too
    small: a stamp converted with it is then too old, never too new."""
    return time.monotonic() - time.time()


def unix_us() -> int:
    """Microseconds since 1970-01-01 UTC, for time stamps in logs only."""
    return time.time_ns() // 1000


def utc() -> str:
    """Date and time, UTC, as 2026-11-21T09:30:00.123Z."""
    seconds, rest_ms = divmod(time.time_ns() // 1_000_000, 1000)
    return f"{time.strftime('%Y-%m-%dT%H:%M:%S', time.gmtime(seconds))}.{rest_ms:03d}Z"


def local_stamp() -> str:
    """Local date and time for names of files, as 20261121-093000."""
    return time.strftime("%Y%m%d-%H%M%S")
