"""Background writer: a thread writes to terminal or disk, so that the loop need not wait."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from typing import Generic, TypeVar

Item = TypeVar("Item")
PERIOD_S = 0.02  # the thread looks for new items this often


class BackgroundWriter(Generic[Item]):
    """Passes queued items to `write` in order and in batches, from its own thread.

    At most `size` items are queued. If the queue is full, `put` drops the item, or with `waits`
    waits for room. If `write` raises, `error` has the exception, and all items are dropped from
    then on. `dropped` is the number of dropped items.
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
        """Wait at most `timeout_s` until the queue is written; the rest counts as dropped."""
        self._closing.set()
        self._thread.join(timeout_s)
        self.dropped += self._writing + len(self._queue)
        self._queue.clear()

    def is_free(self) -> bool:
        """Whether the thread has ended; call it after `close`."""
        return not self._thread.is_alive()

    def _run(self) -> None:
        while not self._closing.wait(PERIOD_S) or self._queue:
            batch = [self._queue.popleft() for _ in range(len(self._queue))]
            self._writing = len(batch)
            try:
                if batch and self.error is None:
                    self._write(batch)
                    self._writing = 0
            except (Exception, SystemExit) as error:  # rich raises SystemExit on a closed pipe
                self.error = error
            self.dropped += self._writing
            self._writing = 0
