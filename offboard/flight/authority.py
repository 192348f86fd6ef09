"""Authority: whether the vehicle is ours to command, according to the modes that it reports.

The vehicle is ours from the moment when it reports the mode that we requested until it reports
another mode that we did not request. This loss is final: a mode that a pilot, a ground station or a
failsafe has chosen is never changed. No setpoint or command is sent without a recent report.
The exception, the autopilot's own failsafe for missing setpoints, is in README.md.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from enum import Enum

from offboard.mavlink.dialects.base import NEVER, SetpointLoss
from offboard.mavlink.events import MODE_KNOWN_S

# Age of a report that still counts after a short pause (`Authority.doubt`): PX4 sends CURRENT_MODE
# twice a second, and at once when the mode changes
JUST_S = 0.6


class Standing(Enum):
    """Whether the vehicle is ours, according to the sequence of the modes that it has reported."""

    FREE = "not asked for yet"
    ASKED = "asked for, or about to be"
    OURS = "follows our setpoints"
    FAILSAFE = "in the failsafe for setpoints that did not arrive"
    HANDED = "in a mode that we asked for as the end of the flight"
    LOST = "taken by another"


@dataclass(slots=True)
class Authority:
    """Whether one vehicle is ours. `engage_mode` is the mode in which it follows our setpoints; it
    is empty until the vehicle has reported a mode. Times are link time, except `arrived_s`.

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

    engage_mode: str = ""
    standing: Standing = Standing.FREE
    mode: str = "unknown"
    engaged_from: str = ""  # the mode reported before the newest switch to `engage_mode`
    report_s: float = -math.inf  # time of the newest report
    counted_report_s: float = -math.inf  # time of the newest report that counts
    lost_reason: str = ""
    lost_s: float = math.inf  # time of the loss; -inf if a HEARTBEAT reported it
    setpoint_loss: SetpointLoss = NEVER  # what the autopilot does without setpoints
    arrived_s: float = -math.inf  # host time of the arrival of the newest report
    _asked_in: str = ""  # the mode reported when `ask` was called
    # modes that we requested to end the flight, oldest first; when the vehicle shows one of them,
    # those requested before it are dropped
    _requested: list[str] = field(default_factory=list)
    _failsafe_shown: bool = False  # whether a HEARTBEAT has confirmed `Standing.FAILSAFE`
    _counts_from_s: float = -math.inf  # host time: reports that arrived earlier do not count

    def on_mode(
        self,
        mode: str,
        now_s: float,
        *,
        arrived_s: float = math.inf,
        failsafe: bool = False,
        heartbeat: bool = True,
        setpoints_missing: bool = False,
        sticks: bool | None = False,
    ) -> None:
        """Update the standing with a report of the mode. A failsafe may interrupt a landing that we
        requested.

        `failsafe`: whether the newest HEARTBEAT shows a failsafe; `heartbeat`: whether this report
        is a HEARTBEAT; `setpoints_missing`: whether the vehicle may have been without setpoints for
        so long that its failsafe acts; `sticks`: whether it receives a pilot's sticks, with which
        the pilot may fly it in that failsafe (None: not known).
        """
        before, self.mode = self.mode, mode
        if mode == self.engage_mode != before:
            self.engaged_from = before
        self.report_s, self.arrived_s = now_s, arrived_s
        if arrived_s >= self._counts_from_s:
            self.counted_report_s = now_s
        if self.standing is Standing.ASKED:
            if mode == self.engage_mode:
                self.standing = Standing.OURS
            elif mode != self._asked_in:
                self.lose(f"{mode} was selected before {self.engage_mode}", now_s, heartbeat)
        elif self.standing in (Standing.OURS, Standing.FAILSAFE):
            if mode == self.engage_mode:  # PX4 returns to it when setpoints arrive again
                self.standing = Standing.OURS
            elif mode in self._requested:
                self._hand_over(mode)
            elif mode in self.setpoint_loss.modes and (
                setpoints_missing or self.standing is Standing.FAILSAFE
            ):
                self._on_failsafe(before, now_s, failsafe, heartbeat=heartbeat, sticks=sticks)
            else:
                self.lose(f"the vehicle left {before} for {mode}", now_s, heartbeat)
        elif self.standing is Standing.HANDED:
            if mode in self._requested:
                self._hand_over(mode)
            elif not failsafe:
                kept = f"a pilot keeps it in {mode}"
                left = f"the vehicle left {before} for {mode}"
                self.lose(kept if mode == before else left, now_s, heartbeat)

    def _on_failsafe(
        self, before: str, now_s: float, failsafe: bool, *, heartbeat: bool, sticks: bool | None
    ) -> None:
        """The vehicle has left the mode `before` for a mode that its failsafe for missing setpoints
        may have chosen. Only HEARTBEAT (MAV_STATE) distinguishes that from a pilot's choice."""
        left = f"the vehicle left {self.engage_mode} for {self.mode}"
        if heartbeat and not failsafe:
            self.lose(left, now_s, heartbeat)
        elif sticks:
            flown = f"{left} as setpoints were missing, and receives a pilot's sticks"
            self.lose(flown, now_s, heartbeat)
        else:
            stays = self.standing is Standing.FAILSAFE and self.mode == before
            shown = stays and self._failsafe_shown
            self.standing = Standing.FAILSAFE
            counts = self.arrived_s >= self._counts_from_s
            self._failsafe_shown = shown or (heartbeat and counts and sticks is not None)

    def _hand_over(self, mode: str) -> None:
        """Note that the vehicle shows `mode`, which we requested; earlier requests do not count any
        more."""
        self.standing = Standing.HANDED
        del self._requested[: self._requested.index(mode)]

    def renewed(self) -> Authority:
        """Return the authority for the next flight of this vehicle: it has the same reports of the
        mode, and nothing was requested."""
        return replace(
            self,
            standing=Standing.FREE,
            lost_reason="",
            lost_s=math.inf,
            _asked_in="",
            _requested=[],
        )

    def ask(self) -> None:
        """Note that we request, now or after a stream of setpoints, the mode that follows them."""
        if self.standing is Standing.FREE:
            self._asked_in = self.mode
            already = self.mode == self.engage_mode
            self.standing = Standing.OURS if already else Standing.ASKED

    def request(self, mode: str) -> None:
        """Note that we request `mode` to end the flight."""
        self._requested.append(mode)

    def doubt(self, host_s: float, paused_s: float) -> None:
        """Distrust the reports of the mode after this process has paused for `paused_s` until host
        time `host_s`: only later reports count. If the pause was too short for the vehicle's
        failsafe to have acted, reports that arrived within the last JUST_S count as well."""
        self._counts_from_s = host_s - (JUST_S if paused_s < self.setpoint_loss.after_s else 0.0)
        self._failsafe_shown = False
        if self.arrived_s < self._counts_from_s:
            self.counted_report_s = -math.inf

    def forget(self, now_s: float) -> None:
        """Forget the reports of the mode, because the vehicle was rebooted. Only the next report
        shows whether a vehicle that was ours has changed its mode."""
        self.report_s, self.counted_report_s = now_s, -math.inf
        if self.is_ours:
            self.standing = Standing.OURS

    def lose(self, reason: str, now_s: float, heartbeat: bool) -> None:
        """Note that the vehicle is no longer ours, which is final. `heartbeat`: whether a HEARTBEAT
        shows it."""
        if self.standing is not Standing.LOST:
            self.standing, self.lost_reason = Standing.LOST, reason
            self.lost_s = -math.inf if heartbeat else now_s

    def _known(self, now_s: float) -> bool:
        """Whether the newest report that counts is recent enough to act on."""
        return now_s - self.counted_report_s <= MODE_KNOWN_S

    def unheard_s(self, now_s: float) -> float:
        """Time since the newest report of the mode, even if it does not count, if that is longer
        than MODE_KNOWN_S; else 0."""
        since_s = now_s - self.report_s
        return since_s if since_s > MODE_KNOWN_S else 0.0

    def permits_setpoint(self, now_s: float) -> bool:
        """Whether a setpoint may be sent: to a vehicle that follows it, or for the stream that PX4
        needs before it accepts the mode."""
        beginning = self.standing in (Standing.FREE, Standing.ASKED)
        return self._known(now_s) and (beginning or self.standing is Standing.OURS)

    def permits_command(self, now_s: float) -> bool:
        """Whether a command may be sent."""
        handed = self.standing is Standing.HANDED and self.mode in self._requested
        fallen = self.standing is Standing.FAILSAFE and self._failsafe_shown
        return self.permits_setpoint(now_s) or (self._known(now_s) and (handed or fallen))

    @property
    def is_ours(self) -> bool:
        """Whether nobody else has changed the mode since the vehicle followed us, however old the
        newest report is."""
        return self.standing in (Standing.OURS, Standing.FAILSAFE, Standing.HANDED)


class PilotSwitch(Enum):
    """Whether the pilot has engaged the service, according to the modes that the vehicle reports;
    "it" in the texts is the mode of setpoints (OFFBOARD or GUIDED).

    While it waits, the service does not request this mode. The pilot engages it by a switch to this
    mode in the air, from a mode that a HEARTBEAT has shown without a failsafe: after a failsafe PX4
    returns to OFFBOARD by itself as soon as setpoints arrive.
    """

    FOUND = "in it, in the air, in every report since the service began or the vehicle rebooted"
    ELSEWHERE = "in another mode, which a failsafe may have chosen"
    READY = "in another mode, and a HEARTBEAT has shown it without a failsafe"
    ENGAGED = "switched to it in the air"
    TOO_SOON = "in it again, in the air, before a HEARTBEAT could show the other mode"
    IDLE = "in it without a switch in the air, or in a failsafe"

    def after(
        self, *, in_engage_mode: bool, in_the_air: bool, flies: bool, failsafe: bool | None
    ) -> PilotSwitch:
        """Return the state after a report of the mode. Only a vehicle that `flies` for certain
        (`GroundContact.flies`) is engaged. `failsafe`: whether the report, if it is a HEARTBEAT,
        shows a failsafe; None for any other report."""
        shown = PilotSwitch
        if self is shown.FOUND and in_engage_mode and in_the_air:
            return self
        if failsafe:
            return shown.IDLE
        if not in_engage_mode:
            return shown.ELSEWHERE if failsafe is None and self is not shown.READY else shown.READY
        if self is shown.READY:
            return shown.ENGAGED if flies else shown.IDLE
        if self is shown.ELSEWHERE:
            return shown.TOO_SOON if in_the_air else shown.IDLE
        return shown.IDLE if self is shown.FOUND else self
