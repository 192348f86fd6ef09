"""The configuration of the service's next flight: read again while it waits, and made ready.

A thread resolves the configuration every `EVERY_S` while no vehicle follows us. One that has
changed is built and called once, so that nothing is compiled in flight; one that cannot be used is
refused with a sentence, and the one before stays in use.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable

from offboard.run.configuration import FlightConfig, dump
from offboard.run.flight import Prepared, build, rehearse

EVERY_S = 2.0


class Preparation:
    """A `flights.Source` of what `load` returns. The thread works only while it is `allowed`: not
    while the vehicle is armed. Raises DocumentError if the first configuration cannot be used."""

    def __init__(self, load: Callable[[], FlightConfig], every_s: float = EVERY_S) -> None:
        self._load = load
        self._every_s = every_s
        self._newest = self._ready(load())
        self._seen = self._newest.text  # the newest text or error
        self._news: deque[str] = deque()
        self.allowed = True
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True, name="configuration")

    def start(self) -> None:
        """Begin to watch."""
        self._thread.start()

    def close(self) -> None:
        self._ended.set()

    def newest(self) -> Prepared:
        return self._newest

    def news(self) -> list[str]:
        """Sentences about configurations since the last call."""
        return [self._news.popleft() for _ in range(len(self._news))]

    def _run(self) -> None:
        while not self._ended.wait(self._every_s):
            if self.allowed:
                self.look()

    def look(self) -> None:
        """Read the configuration again, and use it if it has changed."""
        try:
            config = self._load()
            text = dump(config)
            if text in (self._seen, self._newest.text):
                self._seen = text
                return
            self._seen = text
            self._newest = self._ready(config)
            self._news.append("the configuration has changed: used from the next flight on")
        except Exception as error:  # whatever a controller raises, the old configuration is kept
            sentence = "; ".join(str(error).splitlines())
            if sentence != self._seen:
                self._seen = sentence
                self._news.append(f"the configuration is refused, the old one is kept: {sentence}")

    def _ready(self, config: FlightConfig) -> Prepared:
        prepared = build(config)
        rehearse(prepared, keeps_deadline=True)
        return prepared
