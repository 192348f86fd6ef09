"""A pause of the controller on a link that is a stream: the flight continues."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from pair import hover, in_phase

from offboard.flight.flight import Flight, Output
from offboard.flight.phases import Phase
from offboard.link.interface import Chunk

PAUSE_S = 0.45


class Paused:
    """The companion, which from `begin` on takes no turn for a pause, with a link that is a
    stream: what arrives meanwhile may have arrived at any time since the turn before."""

    def __init__(self, companion: Flight) -> None:
        session = companion.session
        session.settings = replace(session.settings, stream=True)
        self._companion = companion
        self._waiting: list[Chunk] = []
        self._turned_s = self._until_s = 0.0

    def begin(self) -> None:
        self._until_s = self._turned_s + PAUSE_S

    def turn(self, chunks: Sequence[Chunk], now_s: float) -> Output:
        self._waiting += [replace(chunk, arrived_s=self._turned_s) for chunk in chunks]
        if now_s < self._until_s:
            return Output()
        waiting, self._waiting, self._turned_s = self._waiting, [], now_s
        return self._companion.turn(waiting, now_s)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._companion, name)


def test_after_a_pause_telemetry_of_a_stream_is_not_late() -> None:
    pair = hover()
    paused = Paused(pair.companion)
    pair.companion = paused  # type: ignore[assignment]
    pair.at.append((in_phase(Phase.TRACK, 0.5), lambda _: paused.begin()))
    outcome = pair.fly()
    assert outcome.exit_code == 0, outcome.sentence
    assert any("paused for 0.4" in line for line in pair.companion.announced)
