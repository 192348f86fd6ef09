"""The only module that reads a clock. All other modules call it or get the time as an argument."""

from __future__ import annotations

import time


def monotonic_s() -> float:
    """Host time: seconds of a clock that never jumps, since an arbitrary moment."""
    return time.monotonic()


def thread_s() -> float:
    """CPU time of this thread in seconds."""
    return time.thread_time()


def monotonic_less_unix_s() -> float:
    """The offset in seconds that converts Unix time to `monotonic_s`. If this process pauses
    between the two readings, the offset is too small: a converted stamp is too old, never too new.
    """
    return time.monotonic() - time.time()


def unix_us() -> int:
    """Unix time in microseconds, for stamps of logs and signatures and for the age of files."""
    return time.time_ns() // 1000


def utc() -> str:
    """Date and time in UTC, for example 2026-11-21T09:30:00.123Z."""
    seconds, rest_ms = divmod(time.time_ns() // 1_000_000, 1000)
    return f"{time.strftime('%Y-%m-%dT%H:%M:%S', time.gmtime(seconds))}.{rest_ms:03d}Z"


def local_stamp() -> str:
    """Local date and time for file names, for example 20261121-093000."""
    return time.strftime("%Y%m%d-%H%M%S")
