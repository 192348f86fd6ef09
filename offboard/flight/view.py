"""What is known of the vehicle from its telemetry so far. Events in, facts out; no decisions."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, field

from offboard.mavlink.events import (
    Attitude,
    CommandAck,
    Event,
    Heartbeat,
    Landed,
    LocalPosition,
    Parameter,
    Reset,
    StatusText,
    SystemHealth,
    VehicleFound,
)
from offboard.model.frames import course_from_quaternion

OUTAGE_S = 0.3  # a longer gap of all telemetry is the link's, not one message's
HEARD = 12  # texts and refusals kept for the sentence that explains a failure
SET_MESSAGE_INTERVAL = 511  # MAV_CMD: a rate that is refused explains no failure


@dataclass(slots=True)
class VehicleView:
    """The newest of everything. `None` means never heard."""

    found: VehicleFound | None = None
    heartbeat: Heartbeat | None = None
    health: SystemHealth | None = None
    landed: str = "unknown"
    position: LocalPosition | None = None
    attitude: Attitude | None = None
    parameters: dict[str, float] = field(default_factory=dict)
    said: deque[str] = field(default_factory=lambda: deque(maxlen=HEARD))
    refused: deque[str] = field(default_factory=lambda: deque(maxlen=HEARD))
    accepted: set[int] = field(default_factory=set)  # commands
    resumed_s: float = -math.inf  # vehicle time at which telemetry flowed again after an outage

    @property
    def time_s(self) -> float:
        """Vehicle time of the newest telemetry; 0 before any."""
        stamps = [event.time_s for event in (self.position, self.attitude) if event is not None]
        return max(stamps, default=0.0)

    @property
    def position_age_s(self) -> float:
        """Vehicle time since the newest position, an outage of the whole link aside; NaN before
        any."""
        return self._age_s(self.position)

    @property
    def attitude_age_s(self) -> float:
        """The same of the newest attitude."""
        return self._age_s(self.attitude)

    @property
    def in_the_air(self) -> bool:
        """The vehicle says that it flies; false while it says nothing."""
        return self.landed in ("in_air", "takeoff", "landing")

    @property
    def armed(self) -> bool:
        return self.heartbeat is not None and self.heartbeat.armed

    @property
    def mode(self) -> str:
        return self.heartbeat.mode if self.heartbeat else "unknown"

    @property
    def has_state(self) -> bool:
        return self.position is not None and self.attitude is not None

    @property
    def course_rad(self) -> float:
        """Of the nose, by the newest attitude; asked once that has come."""
        assert self.attitude is not None
        return float(course_from_quaternion(self.attitude.attitude))

    @property
    def prearm_ok(self) -> bool:
        """SYS_STATUS says that the vehicle's pre-arm checks pass."""
        return self.health is not None and self.health.prearm_ok

    def note(self, event: Event) -> None:
        """Take one event in."""
        if isinstance(event, (LocalPosition, Attitude)):
            self._note_outage(event.time_s)
        match event:
            case Heartbeat():
                self.heartbeat = event
            case LocalPosition():
                self.position = event
            case Attitude():
                self.attitude = event
            case SystemHealth():
                self.health = event
            case Landed(state):
                self.landed = state
            case VehicleFound():
                self.found = event
            case Parameter(name, value):
                self.parameters[name] = value
            case StatusText(severity, text) if severity <= 4:
                self.said.append(text)
            case CommandAck(command, "ACCEPTED"):
                self.accepted.add(command)
            case CommandAck(command, result) if (
                command != SET_MESSAGE_INTERVAL and result != "IN_PROGRESS"
            ):
                self.refused.append(f"command {command} {result}")
            case Reset():
                self._forget()

    def _note_outage(self, time_s: float) -> None:
        """Forgiven only after both streams were heard again: one that is slow hides no other."""
        heard_s = [newest.time_s for newest in (self.position, self.attitude) if newest]
        if time_s > self.time_s + OUTAGE_S and all(each >= self.resumed_s for each in heard_s):
            self.resumed_s = time_s

    def _age_s(self, newest: LocalPosition | Attitude | None) -> float:
        if newest is None:
            return math.nan
        return self.time_s - max(newest.time_s, self.resumed_s)

    def _forget(self) -> None:
        """A vehicle that restarted is in no state that was known before."""
        self.heartbeat = self.health = self.position = self.attitude = None
        self.landed = "unknown"
        self.resumed_s = -math.inf
        self.parameters.clear()

    def explanation(self) -> str:
        """The vehicle's own last words, for the end of a sentence; empty if it said nothing."""
        words = list(dict.fromkeys(self.said or self.refused))[-3:]
        return "; the vehicle said: " + " | ".join(words) if words else ""

    def forget_words(self) -> None:
        """What was said up to now explains nothing that happens from now on."""
        self.said.clear()
        self.refused.clear()
        self.accepted.clear()
