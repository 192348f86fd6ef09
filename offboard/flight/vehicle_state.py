"""Vehicle state: the newest telemetry of each kind, the time of its arrival, and derived values.

Nothing is decided here. Ages are in seconds of link time, which is given as `now_s`.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from offboard.estimation.observer import LATEST_S
from offboard.flight.phases import CONTROLLING
from offboard.mavlink.events import (
    CRITICAL,
    GOOD_RESULTS,
    NOTICE,
    Attitude,
    CommandAck,
    EstimatorReport,
    Event,
    FirmwareVersion,
    GpsFix,
    Heartbeat,
    Landed,
    LocalPosition,
    ModeReport,
    OtherCompanion,
    OtherSender,
    Parameter,
    Rebooted,
    StatusText,
    SystemHealth,
    VehicleIdentity,
)
from offboard.mavlink.session import COMPONENT_ID
from offboard.model.frames import heading_from_quaternion, thrust_direction_from_quaternion

HEALTH_S = 1.5  # age up to which SYS_STATUS counts; it is requested at 2 Hz
DISARMED_S = 1.5  # longer than the period of HEARTBEAT, in which arming may have been in progress
ARMED_KNOWN_S = 3.0  # age up to which a HEARTBEAT counts; only it shows whether PX4 is armed
REPEATED_S = 0.05  # PX4 and ArduCopter repeat a component of the position for 0.03 s at most
OUTAGE_S = 0.3  # a longer gap of all telemetry is an outage of the link
# Nobody arms and disarms so often: HEARTBEATs of two vehicles alternate
ARMINGS, ARMINGS_S = 4, 10.0
OTHER_SENDER_S = 5.0  # a second sender counts as present for this time after its newest frame
MESSAGES_MAX = 12  # texts and refusals kept for the sentence that explains a failure
# MAV_CMD SET_MESSAGE_INTERVAL, REQUEST_MESSAGE: their refusal explains no failure
MESSAGE_COMMANDS = frozenset({511, 512})


@dataclass(slots=True)
class VehicleState:
    """The newest telemetry of the vehicle; None until the first message of that kind."""

    heartbeat: Heartbeat | None = None
    health: SystemHealth | None = None
    estimator: EstimatorReport | None = None
    version: FirmwareVersion | None = None
    landed: str = "unknown"
    position: LocalPosition | None = None
    attitude: Attitude | None = None
    uid: int | None = None  # unique number of the hardware; 0: it has none
    parameters: dict[str, float] = field(default_factory=dict)
    texts: deque[str] = field(default_factory=lambda: deque(maxlen=MESSAGES_MAX))
    refusals: deque[str] = field(default_factory=lambda: deque(maxlen=MESSAGES_MAX))
    results: dict[int, str] = field(default_factory=dict)  # newest MAV_RESULT, by MAV_CMD number
    answered_s: dict[int, float] = field(default_factory=dict)  # link time of that, by MAV_CMD
    mode: str = "unknown"
    other_sender: OtherSender | None = None
    other_companion: OtherCompanion | None = None
    # link times at which arming was seen to change, the newest last; -inf before the first
    armings_s: deque[float] = field(
        default_factory=lambda: deque([-math.inf] * ARMINGS, maxlen=ARMINGS)
    )
    resumed_s: float = -math.inf  # vehicle time of the first telemetry after an outage
    # when an EstimatorReport last showed other horizontal ratios, and how often one did
    measured_s: float = -math.inf
    measurements: int = 0
    now_s: float = 0.0
    heard_s: dict[type, float] = field(default_factory=dict)  # link time, by type of event
    # components of position and velocity, each with the stamp since which it has not changed
    _same_since: tuple[tuple[float, float], ...] = ((math.nan, math.inf),) * 6

    @property
    def time_s(self) -> float:
        """Vehicle time of the newest position or attitude; 0 before the first."""
        stamps = [event.time_s for event in (self.position, self.attitude) if event is not None]
        return max(stamps, default=0.0)

    @property
    def position_age_s(self) -> float:
        """Vehicle time since the newest position, or since telemetry resumed after an outage of
        the link; NaN before the first position."""
        return self._age_s(self.position)

    @property
    def attitude_age_s(self) -> float:
        """The same as `position_age_s`, for the attitude."""
        return self._age_s(self.attitude)

    @property
    def unmeasured_s(self) -> float:
        """For how long the horizontal innovation ratios have been exactly the same: the estimator
        uses neither GPS nor external vision. Optical flow does not change them. Infinite if
        no two reports differed."""
        return self.heard_s.get(EstimatorReport, -math.inf) - self.measured_s

    @property
    def without_gps(self) -> bool:
        """Whether the estimator works without GPS. PX4 reports that since 1.16; of others it is
        concluded if no fix was ever heard."""
        report = self.estimator
        return report is not None and not (report.by_gps and GpsFix in self.heard_s)

    @property
    def disarmed_s(self) -> float:
        """Time since the vehicle was first reported disarmed; 0 while it is armed, infinite if it
        was never seen armed."""
        return 0.0 if self.armed else self.now_s - self.armings_s[-1]

    def age_s(self, kind: type) -> float:
        """Time since the newest event of this type; infinite if none was heard."""
        return self.now_s - self.heard_s.get(kind, -math.inf)

    @property
    def armed(self) -> bool:
        return self.heartbeat is not None and self.heartbeat.armed

    @property
    def arming_alternates(self) -> bool:
        """Whether HEARTBEATs show the vehicle armed and disarmed in turn."""
        return self.now_s - self.armings_s[0] < ARMINGS_S

    @property
    def disarmed_lately(self) -> bool:
        """Whether it was disarmed within ARMINGS_S: it may fly, and another vehicle be disarmed."""
        return self.now_s - self.armings_s[-2 if self.armed else -1] < ARMINGS_S

    @property
    def disarmed(self) -> bool:
        """Whether a recent HEARTBEAT shows the vehicle disarmed."""
        return not self.armed and self.age_s(Heartbeat) < ARMED_KNOWN_S

    @property
    def in_failsafe(self) -> bool:
        """Whether the newest HEARTBEAT shows MAV_STATE critical or emergency."""
        return self.heartbeat is not None and self.heartbeat.system_status >= CRITICAL

    @property
    def sticks(self) -> bool | None:
        """Whether the vehicle receives a pilot's sticks; None while that is not known."""
        return self.health.radio_ok if self.health and self.age_s(SystemHealth) < HEALTH_S else None

    @property
    def other_sender_named(self) -> str:
        """A sentence that names another program that controls the vehicle; empty if none was heard
        in the last OTHER_SENDER_S."""
        other = self.other_sender
        if other is None or self.age_s(OtherSender) >= OTHER_SENDER_S:
            return ""
        return (
            "another program controls the vehicle on this link, too: system "
            f"{other.system_id} component {other.component_id} "
            "(limits.begin_with_other_sender=true flies all the same)"
        )

    @property
    def battery(self) -> float:
        """Remaining charge, 0 .. 1; 1 while it is not known."""
        charge = self.health.battery_remaining if self.health else None
        return 1.0 if charge is None else charge

    @property
    def has_state(self) -> bool:
        """Whether position and attitude have been received."""
        return self.position is not None and self.attitude is not None

    @property
    def heading_rad(self) -> float:
        """Heading of the nose in the newest attitude, which must have been received."""
        assert self.attitude is not None
        return float(heading_from_quaternion(self.attitude.attitude))

    @property
    def thrust_direction_ned(self) -> NDArray[np.float64]:
        """Thrust direction (3,) in the newest attitude, which must have been received."""
        assert self.attitude is not None
        return thrust_direction_from_quaternion(np.array(self.attitude.attitude))

    @property
    def prearm_ok(self) -> bool:
        """Whether SYS_STATUS reports that the vehicle's pre-arm checks pass."""
        return self.health is not None and self.health.prearm_ok

    def update(self, event: Event, now_s: float) -> bool:
        """Store what one event reports. Returns False if it is no measurement: it repeats an event
        of its kind, or is too old for the observer."""
        self.now_s = now_s
        late = isinstance(event, LocalPosition | Attitude) and event.time_s < self.time_s - LATEST_S
        if late or (self._repeats(event) and math.isfinite(self.armings_s[-1])):
            return False
        self.heard_s[type(event)] = now_s
        if isinstance(event, (LocalPosition, Attitude)):
            self._detect_outage(event.time_s)
        match event:
            case Heartbeat(mode, armed):
                if armed != self.armed:
                    self.armings_s.append(now_s)
                self.heartbeat, self.mode = event, mode
            case ModeReport(mode):
                self.mode = mode
            case OtherSender():
                self.other_sender = event
            case OtherCompanion(system, component, phase):
                self.other_companion = event
                if component == COMPONENT_ID and phase in CONTROLLING:
                    self.other_sender = OtherSender(system, component)
                    self.heard_s[OtherSender] = now_s
            case LocalPosition():
                self.position = event
            case Attitude():
                self.attitude = event
            case SystemHealth():
                self.health = event
            case EstimatorReport():
                ratios = event.horizontal_ratios  # empty: the estimator uses no measurement
                if self.estimator and ratios not in ([], self.estimator.horizontal_ratios):
                    self.measured_s, self.measurements = now_s, self.measurements + 1
                self.estimator = event
            case Landed(state):
                self.landed = state
            case VehicleIdentity(uid, version):
                self.uid, self.version = uid, version
            case Parameter(name, value):
                self.parameters[name] = value
            case StatusText(severity, text) if severity <= NOTICE:  # e.g. a fence breach
                self.texts.append(text)
            case CommandAck(command, result) if command not in MESSAGE_COMMANDS:
                self.results[command], self.answered_s[command] = result, now_s
                if result not in GOOD_RESULTS:
                    self.refusals.append(f"command {command} {result}")
            case Rebooted():
                self._reset()
        return True

    def _repeats(self, event: Event) -> bool:
        """Whether the event only repeats earlier values, whatever its stamp: an attitude and its
        rates, position and velocity on one axis, or one of these components for REPEATED_S. Once
        motors have run no estimator repeats itself, not even on the ground."""
        match event:
            case LocalPosition(time_s, position, velocity):
                since_s = [
                    at_s if before == value and at_s <= time_s else time_s
                    for value, (before, at_s) in zip(
                        (*position, *velocity), self._same_since, strict=True
                    )
                ]
                self._same_since = tuple(zip((*position, *velocity), since_s, strict=True))
                axes = zip(since_s[:3], since_s[3:], strict=True)
                repeated = any(max(axis) < time_s for axis in axes)
                return repeated or time_s - min(since_s) > REPEATED_S
            case Attitude(_, attitude, rates):
                before = self.attitude
                return before is not None and (attitude, rates) == (
                    before.attitude,
                    before.rates_frd_radps,
                )
        return False

    def _detect_outage(self, time_s: float) -> None:
        """Set `resumed_s` after an outage of all telemetry. The next outage counts only once both
        streams have resumed, because a slow stream must not hide that the other has stopped."""
        stamps_s = [newest.time_s for newest in (self.position, self.attitude) if newest]
        if time_s > self.time_s + OUTAGE_S and all(each >= self.resumed_s for each in stamps_s):
            self.resumed_s = time_s

    def _age_s(self, newest: LocalPosition | Attitude | None) -> float:
        return self.time_s - max(newest.time_s, self.resumed_s) if newest else math.nan

    def _reset(self) -> None:
        """Forget the telemetry after a reboot, except whether the vehicle was armed, until the next
        HEARTBEAT."""
        self.health = self.estimator = self.position = self.attitude = None
        self.landed = self.mode = "unknown"
        self.heard_s.clear()
        self.results.clear()
        self.resumed_s = -math.inf
        self.parameters.clear()

    def explanation(self, unsaid: str) -> str:
        """The end of a sentence: the newest texts of the vehicle, or if there are none its refusals
        and what SYS_STATUS reports; may be empty. `unsaid` says where the reason of a refusal can
        be found."""
        messages = list(dict.fromkeys(self.texts or self.refusals))[-3:]
        said = "; the vehicle said: " + " | ".join(messages) if messages else ""
        refused = messages and not self.texts
        return f"{said}{self.unhealthy()} ({unsaid})" if refused else said

    def unhealthy(self) -> str:
        """The end of a sentence: what SYS_STATUS reports as not healthy; may be empty."""
        names = self.health.unhealthy if self.health else ()
        return f"; unhealthy by SYS_STATUS: {', '.join(names)}" if names else ""

    def clear_messages(self) -> None:
        """Forget texts and refusals, because they do not explain what happens later."""
        self.texts.clear()
        self.refusals.clear()
