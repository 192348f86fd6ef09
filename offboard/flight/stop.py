"""Who asks us to end: the signals of a terminal or a service manager, noted and never raised.

A KeyboardInterrupt that comes while machine code is compiled may die in a callback of the compiler,
and the flight would begin. Hence a note, and moments at which it is heeded. Knows no flight.
"""

from __future__ import annotations

import signal
from collections.abc import Callable
from types import FrameType, TracebackType


def interrupt() -> None:
    """End at once."""
    raise KeyboardInterrupt


class StopRequests:
    """Notes SIGINT, SIGTERM and, unless it is ignored (nohup), SIGHUP while entered.

    `at_once` is called by a second one before the flight; in flight that is the loop's matter.
    """

    def __init__(self, at_once: Callable[[], None] = interrupt) -> None:
        self._at_once = at_once
        self.asked = False
        self.insisted = False  # SIGHUP does not insist: a closing terminal may send it twice
        self.in_flight = False

    def heed(self) -> None:
        """Raise KeyboardInterrupt, here where nothing swallows it, if asked to end."""
        if self.asked:
            raise KeyboardInterrupt

    def __enter__(self) -> StopRequests:
        kinds = [signal.SIGINT, signal.SIGTERM]
        if signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN:
            kinds.append(signal.SIGHUP)
        self._before = {kind: signal.signal(kind, self._note) for kind in kinds}
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        value: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def _note(self, number: int, frame: FrameType | None) -> None:
        self.insisted |= self.asked and number != signal.SIGHUP
        self.asked = True
        if self.insisted and not self.in_flight:
            self._at_once()
