"""Authority: whether the vehicle is ours to command, from the modes that it reports.

It is ours from the moment when it shows the mode that we asked for until it shows another one that
we did not ask for; that is final. What a pilot, a ground station or a failsafe has chosen is never
changed. A report has an age: without a recent one nothing is sent.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from enum import Enum

JUST_S = 0.6  # PX4 sends CURRENT_MODE twice a second, and at once when the mode changes
KNOWN_S = 2.5  # longest age of a report; HEARTBEAT comes at 1 Hz


class Standing(Enum):
    """What the reported modes, in their order, say."""

    FREE = "not asked for yet"
    ASKED = "asked for"
    OURS = "follows our setpoints"
    HANDED = "in a mode that we asked for as the end of the flight"
    LOST = "taken by another"


@dataclass(slots=True)
class Authority:
    """The standing of one vehicle. Times are `Session.link_time_s`; `arrived_s` is host time.

    Example:
        >>> authority = Authority("OFFBOARD")
        >>> authority.on_mode("POSCTL", now_s=1.0)
        >>> authority.ask()
        >>> authority.on_mode("OFFBOARD", now_s=1.2)
        >>> authority.permits_setpoint(1.3)
        True
        >>> authority.on_mode("POSCTL", now_s=1.4)
        >>> authority.on_mode("OFFBOARD", now_s=1.5)
        >>> authority.permits_setpoint(1.5), authority.standing.value
        (False, 'taken by another')
    """

    engage_mode: str
    standing: Standing = Standing.FREE
    mode: str = "unknown"
    heard_s: float = -math.inf  # time of the newest report
    reported_s: float = -math.inf  # time of the newest report that counts
    lost_reason: str = ""
    lost_s: float = math.inf  # time of the loss
    _asked_in: str = ""  # the mode shown when we asked
    _requested: list[str] = field(default_factory=list)  # as the end; without those left behind
    _arrived_s: float = -math.inf  # host time of the arrival of the newest report
    _counts_from_s: float = -math.inf  # host time: what arrived before it is not evidence

    def on_mode(
        self, mode: str, now_s: float, *, arrived_s: float = math.inf, failsafe: bool = False
    ) -> None:
        """The vehicle reports `mode`. A failsafe may interrupt a landing that we asked for."""
        before, self.mode = self.mode, mode
        self.heard_s, self._arrived_s = now_s, arrived_s
        if arrived_s >= self._counts_from_s:
            self.reported_s = now_s
        if self.standing is Standing.ASKED:
            if mode == self.engage_mode:
                self.standing = Standing.OURS
            elif mode != self._asked_in:
                self.lose(f"it showed {mode} after {self.engage_mode} was asked for", now_s)
        elif self.standing is Standing.OURS and mode != self.engage_mode:
            if mode in self._requested:
                self._hand_over(mode)
            else:
                self.lose(f"the vehicle left {self.engage_mode} for {mode}", now_s)
        elif self.standing is Standing.HANDED:
            if mode in self._requested:
                self._hand_over(mode)
            elif not failsafe:
                self.lose(f"the vehicle left {before} for {mode}", now_s)

    def _hand_over(self, mode: str) -> None:
        """It shows a mode that we asked for: one that we asked for before would be a step back."""
        self.standing = Standing.HANDED
        del self._requested[: self._requested.index(mode)]

    def renewed(self) -> Authority:
        """For another flight of this vehicle: its reports of the mode, and nothing asked for."""
        return replace(
            self,
            standing=Standing.FREE,
            lost_reason="",
            lost_s=math.inf,
            _asked_in="",
            _requested=[],
        )

    def ask(self) -> None:
        """We ask for the mode in which the vehicle follows our setpoints."""
        if self.standing is Standing.FREE:
            self._asked_in = self.mode
            already = self.mode == self.engage_mode
            self.standing = Standing.OURS if already else Standing.ASKED

    def request(self, mode: str) -> None:
        """We ask for `mode` as the end of the flight."""
        self._requested.append(mode)

    def doubt(self, host_s: float) -> None:
        """After a gap of our own that ended at `host_s`: only reports that arrive later, or have
        arrived just before, count."""
        self._counts_from_s = host_s - JUST_S
        if self._arrived_s < self._counts_from_s:
            self.reported_s = -math.inf

    def forget(self) -> None:
        """The vehicle was rebooted: its standing is shown by the next report of the mode."""
        self.heard_s = self.reported_s = -math.inf
        if self.standing is Standing.HANDED:
            self.standing = Standing.OURS

    def lose(self, reason: str, now_s: float) -> None:
        """The vehicle is not ours any more, for good."""
        if self.standing is not Standing.LOST:
            self.standing, self.lost_reason, self.lost_s = Standing.LOST, reason, now_s

    def known(self, now_s: float) -> bool:
        """Whether the newest report that counts is recent enough to act on."""
        return now_s - self.reported_s <= KNOWN_S

    def heard(self, now_s: float) -> bool:
        """Whether reports arrive, even if none counts yet."""
        return now_s - self.heard_s <= KNOWN_S

    def permits_setpoint(self, now_s: float) -> bool:
        """Whether a setpoint may leave: to a vehicle that follows it, or as the stream that PX4
        needs before it accepts the mode."""
        beginning = self.standing in (Standing.FREE, Standing.ASKED)
        return self.known(now_s) and (beginning or self.standing is Standing.OURS)

    def permits_command(self, now_s: float) -> bool:
        """Whether a command may leave."""
        handed = self.standing is Standing.HANDED and self.mode in self._requested
        return self.permits_setpoint(now_s) or (self.known(now_s) and handed)
