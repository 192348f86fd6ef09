"""Stop requests: a signal from a terminal or a service manager sets a flag.

A KeyboardInterrupt during a compilation can be lost in a callback of the compiler, and the flight
would begin. Therefore the first signal only sets a flag, which is checked at known places.
"""

from __future__ import annotations

import signal
from collections.abc import Callable
from types import FrameType

from offboard.link import clock

AGAIN_S = 1.0  # signals within this time are one request: `timeout` signals child and group


def interrupt() -> None:
    raise KeyboardInterrupt


class StopRequests:
    """Context manager that handles SIGINT, SIGTERM and, unless it is ignored (nohup), SIGHUP.

    The first signal is a stop request. A second one, a second or more later, ends the program at
    once: before the flight by calling `at_once`, in flight by `repeated`, which the loop checks. A
    third one raises KeyboardInterrupt in a loop that hangs. SIGHUP counts only as the first,
    because a closing terminal may send it twice.
    """

    def __init__(self, at_once: Callable[[], None] = interrupt) -> None:
        self._at_once = at_once
        self._first_s: float | None = None
        self.repeated = False
        self.in_flight = False
        self.interruptible = False  # whether the loop runs, which can handle a KeyboardInterrupt

    @property
    def requested(self) -> bool:
        return self._first_s is not None

    def check(self) -> None:
        """Raise KeyboardInterrupt if a stop was requested."""
        if self.requested:
            raise KeyboardInterrupt

    def __enter__(self) -> StopRequests:
        kinds = [signal.SIGINT, signal.SIGTERM]
        if signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN:
            kinds.append(signal.SIGHUP)
        self._before = {kind: signal.signal(kind, self._store) for kind in kinds}
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def _store(self, number: int, frame: FrameType | None) -> None:
        now_s = clock.monotonic_s()
        if self._first_s is None:
            self._first_s = now_s
        elif number != signal.SIGHUP and now_s - self._first_s >= AGAIN_S:
            if self.repeated and self.interruptible:
                interrupt()
            self.repeated = True
        if self.repeated and not self.in_flight:
            self._at_once()
