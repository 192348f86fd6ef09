"""Stop requests: signals of a terminal or a service manager are stored and never raised.

A KeyboardInterrupt during a compilation can be lost in a callback of the compiler, and the flight
would begin. Therefore a signal sets a flag, which is checked at known places.
"""

from __future__ import annotations

import signal
from collections.abc import Callable
from types import FrameType

from offboard.link import clock

AGAIN_S = 1.0  # `timeout` signals its child and the group: within this time it is one request


def interrupt() -> None:
    """End at once."""
    raise KeyboardInterrupt


class StopRequests:
    """Context manager that stores SIGINT, SIGTERM and, unless it is ignored (nohup), SIGHUP.

    A second request, a second or more after the first, exits immediately: before the flight it
    calls `at_once`, in flight the loop sees `repeated`. A third one interrupts a loop that hangs.
    SIGHUP counts only as the first: a closing terminal may send it twice.
    """

    def __init__(self, at_once: Callable[[], None] = interrupt) -> None:
        self._at_once = at_once
        self._first_s: float | None = None
        self.repeated = False
        self.in_flight = False
        self.interruptible = False  # the loop runs, and ends in order if it is interrupted

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
