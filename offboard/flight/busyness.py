"""Whether this computer keeps up: pauses of this process, and the control ticks skipped in them."""

from __future__ import annotations

SHARE = 0.05  # of the ticks skipped, from which a computer is too busy
PAUSE_S = 0.3  # or one pause; after it, what was known before is not known any more


def too_busy(skipped: float, ticks: float, pause_s: float) -> str:
    """A sentence if this computer was too busy to fly; else empty.

    `skipped` of `ticks` control ticks fell into pauses of this process; `pause_s` is the longest.
    """
    if not (pause_s > PAUSE_S or skipped > SHARE * ticks):
        return ""
    return (
        f"this computer was too busy: {skipped:.0f} of {ticks:.0f} ticks were skipped, pauses up "
        f"to {pause_s:.2f} s"
    )


class Busyness:
    """Counts in the air. `period_s`: of control; a shorter gap between two turns skips no tick."""

    def __init__(self, period_s: float) -> None:
        self._period_s = period_s
        self._gap_s = 0.0  # longest between two turns, since the previous tick
        self.skipped = self.ticks = 0
        self.pause_s = 0.0

    def on_turn(self, gap_s: float) -> None:
        """A turn begins `gap_s` after the one before it, host time."""
        self._gap_s = max(self._gap_s, gap_s)

    def on_tick(self, missed: int, *, flying: bool) -> float:
        """A tick, `missed` ticks after the previous one. Returns the pause that it came after, 0
        without one."""
        pause_s, self._gap_s = self._gap_s, 0.0
        if pause_s <= self._period_s:
            pause_s = 0.0
        if flying:
            self.ticks += 1 + missed
            self.skipped += missed if pause_s else 0
            self.pause_s = max(self.pause_s, pause_s)
        return pause_s

    @property
    def sentence(self) -> str:
        return too_busy(self.skipped, self.ticks, self.pause_s)
