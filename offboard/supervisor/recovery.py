"""Recovery: what the supervisor requests of a vehicle that has lost its controller. No I/O, no
clock.

It requests hold, and after some seconds land; if the controller was landing the vehicle, or the
vehicle refuses to hold, it requests land at once. README.md lists in which modes it does so, and
which modes are a pilot's choice. The autopilot's failsafe for missing setpoints may act, too,
because the controller has ended. It is recognised by its mode, its time and
HEARTBEAT.system_status, which a pilot's choice clears.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from offboard.mavlink.dialects.base import NEVER, Dialect, SetpointLoss
from offboard.mavlink.events import (
    CRITICAL,
    GOOD_RESULTS,
    MODE_KNOWN_S,
    CommandAck,
    Event,
    Heartbeat,
    LocalPosition,
    ModeReport,
    SystemHealth,
    VehicleFound,
)
from offboard.mavlink.outgoing import CommandLong

REPEAT_S = 0.3  # between two requests
UNHEARD_MAX = 3  # most requests to a vehicle of which nothing is heard
HOLD_S = 5.0  # from hold to land
ACKNOWLEDGED_S = 3.0  # from the first report of hold to its acknowledgement, at most
LONGEST_S = 300.0
EARLY_S = 0.3  # the newest setpoint may have been lost
SINK_MPS = 0.2  # a vehicle lands if it has had this downward speed within SINK_S
SINK_S = 3.0  # longer than COM_DISARM_LAND, 2 s, after which it is disarmed
# Without beats the supervisor acts EARLIER_S before the autopilot's own failsafe, so that only one
# of them acts, but not before SILENT_MIN_S, which a busy computer needs, nor after SILENT_MAX_S
EARLIER_S, SILENT_MIN_S, SILENT_MAX_S = 0.4, 0.4, 0.9


@dataclass(frozen=True, slots=True)
class Supervised:
    """What the controller reports, and the supervisor must know before it may act.

    `ours`: whether the vehicle shows the mode of our setpoints, or one that we requested, in a
    report that arrived at `reported_s` (`clock.monotonic_s`); the supervisor judges its age.
    `flying`: whether the vehicle is armed. `holding`: whether hold was requested, so that the mode
    hold is ours, too. `landing`: whether land was requested. `setpoint_loss`: what the autopilot
    does without setpoints. `sticks`: whether it receives a pilot's sticks. `setpoint_s`: when the
    newest setpoint was sent; -inf if they were missing already, or the failsafe for that acts."""

    vehicle: VehicleFound
    ours: bool
    flying: bool
    reported_s: float = -math.inf
    holding: bool = False
    landing: bool = False
    setpoint_loss: SetpointLoss = NEVER
    sticks: bool = False
    setpoint_s: float = -math.inf

    @property
    def silent_s(self) -> float:
        """Time without a beat after which the supervisor acts."""
        return min(max(self.setpoint_loss.after_s - EARLIER_S, SILENT_MIN_S), SILENT_MAX_S)


class Recovery:
    """One recovery, which begins at `began_s`. `known` is what the controller reported last. Times
    are those of `clock.monotonic_s`.

    `end_reason` says how the recovery ended, empty until then; `news` are sentences for the user.
    """

    def __init__(self, dialect: Dialect, known: Supervised, began_s: float) -> None:
        self._dialect, self._known = dialect, known
        self._hold_s = 0.0 if known.landing else HOLD_S
        self._began_s = began_s
        self._loses_s = known.setpoint_s + known.setpoint_loss.after_s - EARLY_S
        self._sticks = known.sticks
        self._mode: str | None = None
        self._before: str | None = None  # the mode before it
        self._reported_s = known.reported_s
        self._fallen_s = math.inf  # since when the vehicle's own failsafe flies it
        self._fallen_shown = False  # whether a HEARTBEAT shows that
        self._sank_s = -math.inf  # when the vehicle was last seen to sink
        self._armed = True
        self._begun = False  # whether all messages from before the recovery were processed
        self._first_s = math.inf  # time of the first request
        self._asked_s = -math.inf  # time of the newest request
        self._acknowledged = False
        self._landing = known.landing  # True also once the vehicle has shown the landing mode
        self._left_for = ""  # the mode that neither controller nor supervisor has requested
        self._left_s = -math.inf
        self._heartbeat_s = -math.inf
        self._requests = 0
        self._held_s = math.inf  # since when the vehicle holds
        self.news: list[str] = []
        self.end_reason = ""

    def see(self, event: Event, at_s: float) -> None:
        """Process an event of the vehicle. It arrived at `at_s` or earlier, which may be before
        `began_s`."""
        match event:
            case Heartbeat(mode, armed, status):
                self._armed, self._heartbeat_s = armed, at_s
                self._on_mode(mode, at_s, failsafe=status >= CRITICAL)
            case ModeReport(mode):
                self._on_mode(mode, at_s, failsafe=None)
            case SystemHealth(radio_ok=received):
                self._sticks = received
            case LocalPosition(velocity_ned_mps=(_, _, down_mps)) if down_mps > SINK_MPS:
                self._sank_s = at_s
            case CommandAck(command, result) if result not in GOOD_RESULTS:
                self.news.append(f"the vehicle answers {result}")
                if command == self._dialect.hold().command:  # PX4 without a global position
                    self._hold_s = 0.0
            case CommandAck(command) if command == self._dialect.hold().command:
                self._acknowledged |= at_s > self._first_s

    def _on_mode(self, mode: str, at_s: float, *, failsafe: bool | None) -> None:
        """Process a report of the mode. `failsafe`: whether it shows a failsafe; None if it does
        not say."""
        if mode != self._mode:
            self._before = self._mode
        self._mode, self._reported_s = mode, at_s
        ours = mode in (self._dialect.engage_mode, self._dialect.land_mode)
        if mode == self._dialect.hold_mode and not self._landing:
            ours = self._known.holding or at_s > self._first_s
        self._landing |= mode == self._dialect.land_mode
        if (
            failsafe is not False
            and self._explains(mode, at_s)
            and (failsafe or not ours or self._fallen_s < math.inf)
        ):
            self._fallen_s = min(self._fallen_s, at_s)
            if failsafe and not self._fallen_shown:
                self._fallen_shown = True
                self.news.append(f"its own failsafe flies it, in {mode}: watching that it lands")
            return
        self._fallen_s, self._fallen_shown = math.inf, False
        if not ours and not self._left_for:
            self._left_for, self._left_s = mode, at_s
        elif ours and not self._begun:  # the newest report from before the recovery decides
            self._left_for = ""

    def _explains(self, mode: str, at_s: float) -> bool:
        """Whether the autopilot may have chosen this mode because setpoints are missing."""
        fell = self._fallen_s < math.inf
        followed = fell or self._before in (None, self._dialect.engage_mode)
        missing = followed and not self._acknowledged and at_s >= self._loses_s
        if missing and mode in self._known.setpoint_loss.modes and self._sticks:
            self.news.append(f"{mode} for missing setpoints, and it receives a pilot's sticks")
        lands = mode == self._dialect.land_mode
        return (
            missing and mode in self._known.setpoint_loss.modes and not lands and not self._sticks
        )

    def due(self, now_s: float) -> CommandLong | None:
        """Return the request to send now, or None."""
        self._begun = True
        self._conclude(now_s)
        if self.end_reason or self._left_for or now_s - self._asked_s < REPEAT_S:
            return None
        request = self._wanted(now_s)
        if request:
            self._first_s, self._asked_s = min(self._first_s, now_s), now_s
            self._requests += 1
        return request

    def _conclude(self, now_s: float) -> None:
        """Note since when the vehicle holds, and whether the recovery has ended."""
        holds = self._mode == self._dialect.hold_mode and self._fallen_s == math.inf
        self._held_s = min(self._held_s, now_s) if holds else math.inf
        ours = self._known.holding or self._acknowledged
        # PX4 leaves its landing mode when it disarms; HEARTBEAT shows the disarming later
        shown = not self._landing or self._heartbeat_s >= self._left_s
        if not self._armed:
            self.end_reason = "the vehicle is disarmed"
        elif self._left_for and shown:
            self.end_reason = (
                f"the vehicle shows {self._left_for}: its pilot or its failsafe has it"
            )
        elif not ours and now_s - self._held_s > ACKNOWLEDGED_S:
            self.end_reason = (
                f"the vehicle shows {self._mode}, and has not acknowledged the request: its pilot "
                "or its failsafe has it"
            )
        elif now_s - self._began_s > LONGEST_S:
            self.end_reason = f"not landed after {LONGEST_S:.0f} s"

    def _wanted(self, now_s: float) -> CommandLong | None:
        hold, land = self._dialect.hold(), CommandLong.land()
        first = hold if now_s - self._began_s < self._hold_s else land
        known = now_s - self._reported_s <= MODE_KNOWN_S
        if self._mode is None:
            return first if known and self._requests < UNHEARD_MAX else None
        answered = self._reported_s > self._asked_s and known
        if self._fallen_s < math.inf:
            lands = self._mode == self._dialect.return_mode or now_s - self._sank_s < SINK_S
            due = self._fallen_shown and now_s - self._fallen_s >= HOLD_S
            return land if answered and due and not lands else None
        if not answered or self._mode == self._dialect.land_mode:
            return None
        if self._mode == self._dialect.engage_mode:
            return first
        if not (self._known.holding or self._acknowledged):
            return hold  # the vehicle holds, but its acknowledgement may have been lost
        return land if now_s - self._held_s >= HOLD_S else None
