"""Background writer: a thread does slow writing, so that the loop waits for no terminal or disk."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from typing import Generic, TypeVar

Item = TypeVar("Item")
PERIOD_S = 0.02  # at most this long an item waits for a thread that is free


class BackgroundWriter(Generic[Item]):
    """Gives queued items to `write`, in order and in batches, from a thread of its own.

    At most `size` items wait; what does not fit is dropped, unless `waits`: then `put` waits for
    room. After an exception of `write`, which is kept in `error`, all items are dropped. `dropped`
    counts them.
    """

    def __init__(
        self, write: Callable[[list[Item]], object], size: int, *, waits: bool = False
    ) -> None:
        self._write = write
        self._size = size
        self._waits = waits
        self._queue: deque[Item] = deque()
        self._writing = 0
        self._closing = threading.Event()
        self.error: BaseException | None = None
        self.dropped = 0
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def put(self, item: Item) -> None:
        """Queue `item`. Call it from one thread only."""
        while self._waits and len(self._queue) >= self._size and self.error is None:
            self._closing.wait(PERIOD_S)
        if self.error is not None or len(self._queue) >= self._size:
            self.dropped += 1
        else:
            self._queue.append(item)

    def close(self, timeout_s: float) -> None:
        """Write what is queued, for at most `timeout_s`; what is left then counts as dropped."""
        self._closing.set()
        self._thread.join(timeout_s)
        self.dropped += self._writing + len(self._queue)
        self._queue.clear()

    def is_free(self) -> bool:
        """Whether the thread has ended, after `close`."""
        return not self._thread.is_alive()

    def _run(self) -> None:
        while not self._closing.wait(PERIOD_S) or self._queue:
            batch = [self._queue.popleft() for _ in range(len(self._queue))]
            self._writing = len(batch)
            try:
                if batch and self.error is None:
                    self._write(batch)
                    self._writing = 0
            except (Exception, SystemExit) as error:  # rich ends the program on a closed pipe
                self.error = error
            self.dropped += self._writing
            self._writing = 0
