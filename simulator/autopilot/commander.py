"""The commander: mode, arming and failsafe, and the STATUSTEXTs about them.

A command, a lost setpoint stream, a landing and so on are events. The first row of the firmware's
state table whose event, mode and conditions fit decides the next mode, the actions, the
acknowledgement and the texts. Knows no firmware by name, no MAVLink frames, sockets or clock.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

from simulator.autopilot.firmware import AFTER_DELAY, ByParameter, Rule
from simulator.autopilot.guidance import Guidance
from simulator.autopilot.health import Health
from simulator.autopilot.position_controller import PositionController
from simulator.autopilot.state import VehicleState
from simulator.autopilot.values import (
    NAN3,
    Behaviour,
    Mode,
    MotionSetpoint,
    Result,
    StatusText,
    Triple,
)

_CRITICAL = 2  # battery level
# PX4: EKF2_GPS_V_GATE times EKF2_GPS_V_NOISE; ArduPilot: EK3_VEL_I_GATE times EK3_VELNE_M_NSE
_GATE_MPS = 5.0 * 0.3


@dataclass(frozen=True, slots=True)
class Request:
    """What an event requests: a mode by name, or a place to climb to (NED)."""

    mode: str = ""
    takeoff_ned_m: Triple = NAN3
    by_ground_station: bool = False  # whether its sender has the component id of a ground station


NO_REQUEST = Request()


class Commander:
    """Mode, arming and failsafe of one vehicle; only `handle` and `switch` change them.

    The instance sends and clears `texts`, and `announcements`: names of messages for every link.
    """

    def __init__(
        self,
        guidance: Guidance,
        controller: PositionController,
        state: VehicleState,
        health: Health,
    ) -> None:
        self._guidance, self._controller = guidance, controller
        self._firmware, self._parameters = guidance.firmware, guidance.parameters
        self._state, self._health = state, health
        firmware = self._firmware
        self._rows: dict[str, list[Rule]] = {}
        for rule in firmware.rules:
            self._rows.setdefault(rule.event, []).append(rule)
        self.mode: Mode = firmware.modes[firmware.boot_mode]
        self._intended = self._remembered = firmware.boot_mode
        self.armed = self.failsafe = False
        self.reboot_requested = False
        self.refused: dict[str, StatusText] = {}  # events (and "offboard") that a fault refuses
        self.texts = guidance.mission.texts
        self.announcements: list[str] = []
        self._event, self._request = "", NO_REQUEST  # being handled
        self._cause = ""  # event that caused the failsafe
        self._delayed: tuple[float, str] | None = None  # time and event of a delayed failsafe
        self.latched: frozenset[str] = frozenset()  # events that only a reboot clears

    # -- state -------------------------------------------------------------------------------

    @property
    def healthy(self) -> bool:
        """Whether the pre-arm checks pass in the intended mode."""
        level = self._firmware.battery_level(self._state.plant.battery, self._parameters)
        if self.rejects_velocity or level >= _CRITICAL:
            return False
        return self._health.passes(
            self.intended, self._state.time_s, latched=bool(self.latched), armed=self.armed
        )

    @property
    def has_fix(self) -> bool:
        """Whether the GPS has a fix: it had its first one, and no fault takes it away."""
        return "fix" in self._health.reached and self._state.plant.gps_healthy

    @property
    def velocity_ratio(self) -> float:
        """Innovation test ratio of the estimator's velocity."""
        return math.hypot(*self._state.plant.velocity_error_ned_mps) / _GATE_MPS

    @property
    def rejects_velocity(self) -> bool:
        """Whether the innovation test ratio of the velocity is too large to arm."""
        most = self._parameters.role("velocity_ratio_most")
        return most > 0.0 and self.velocity_ratio >= most

    @property
    def intended(self) -> Mode:
        """The mode that was chosen; in a failsafe the vehicle flies another one."""
        return self._firmware.modes[self._intended]

    # -- events ------------------------------------------------------------------------------

    def handle(self, event: str, request: Request = NO_REQUEST) -> Result:
        """Apply the row of the state table that decides about an event; return the
        acknowledgement, UNSUPPORTED if the table has no row of this event."""
        self._event, self._request = event, request
        offboard = event == "mode" and self._requested.behaviour is Behaviour.SETPOINT
        if self.refused and (text := self.refused.get("offboard" if offboard else event)):
            self.texts.append(text)
            return Result.TEMPORARILY_REJECTED
        found = self._row(event)
        if found is None:
            return Result.ACCEPTED if event in self._rows else Result.UNSUPPORTED
        self._apply(*found)
        return found[0].result

    def switch(self, mode: str, *, by_failsafe: bool = False) -> None:
        """Enter a mode, also one that no command may request, as a pilot's mode switch or a
        failsafe does. If the vehicle is in this mode already, begin it again."""
        self._event, self._request = "", NO_REQUEST
        self._enter(mode, by_failsafe=by_failsafe)
        self.failsafe = by_failsafe

    def due_events(self) -> Iterator[str]:
        """The event of a delayed failsafe, when its delay is over."""
        if self._delayed is not None and self._state.time_s >= self._delayed[0]:
            event, self._delayed = self._delayed[1], None
            yield event

    @property
    def _requested(self) -> Mode:
        """The requested mode; without one, the present mode."""
        return self._firmware.modes[self._request.mode] if self._request.mode else self.mode

    def _row(self, event: str) -> tuple[Rule, str] | None:
        """Return the first row that fits an event, and its next mode; None: no row fits."""
        for rule in self._rows.get(event, ()):
            in_mode = rule.mode == "*" or self.mode.name in rule.mode.split()
            if in_mode and all(map(self._holds, rule.when)):
                target = self._target(rule)
                if target is not None:
                    return rule, target
        return None

    def _target(self, rule: Rule) -> str | None:
        """Return the name of a row's next mode, "*" to keep the present one; None if the value of
        its parameter selects no mode."""
        if isinstance(rule.to, ByParameter):
            return rule.to.modes.get(int(self._parameters[rule.to.parameter]))
        chosen = {"requested": self._request.mode, "remembered": self._remembered}
        return chosen.get(rule.to, rule.to)

    def _holds(self, condition: str) -> bool:
        if condition.startswith("not "):
            return not self._holds(condition[4:])
        if condition.startswith("since "):
            return self.failsafe and self._cause == condition[6:]
        if condition.startswith("requests "):
            return self._requested.name == condition[9:]
        if condition.startswith("reached "):
            return condition[8:] in self._health.reached
        if condition.startswith("latched "):
            return condition[8:] in self.latched
        name, compares, value = condition.partition("=")
        if compares:
            return self._parameters[name] in map(float, value.split(","))
        name, masks, value = condition.partition("&")
        if masks:
            return bool(int(self._parameters[name]) & int(value))
        return CONDITIONS[condition](self)

    def _apply(self, rule: Rule, target: str) -> None:
        for action in rule.do:
            ACTIONS[action](self)
        if target != "*":
            self._enter(target, by_failsafe="failsafe" in rule.do)
        for text in rule.texts:
            values = {name: value(self) for name, value in TEXT_VALUES.items()}
            self.texts.append(StatusText(text.severity, text.text.format(**values)))
        self.announcements += rule.send

    def _enter(self, name: str, *, by_failsafe: bool) -> None:
        mode = self._firmware.modes[name]
        if not by_failsafe:
            self.failsafe, self._delayed = False, None
            self._intended = name
            if mode.remembered:
                self._remembered = name
        if mode is not self.mode and self._firmware.ardupilot_setpoints:
            self._guidance.newest = None
        # a request of the present mode does not begin it again
        if mode is not self.mode or self._event in ("takeoff", ""):
            self._controller.enter(mode.behaviour, self._request.takeoff_ned_m)
        self.mode = mode

    # -- actions -----------------------------------------------------------------------------

    def _arm(self) -> None:
        self.armed = True
        self._health.arm(self._state.time_s, self._controller.landed)
        self._controller.arm()

    def _disarm(self) -> None:
        self.armed, self._delayed = False, None
        if self._firmware.ardupilot_commands:
            self._guidance.mission.reset()
        self._controller.enter(self.mode.behaviour)  # begins again when the vehicle is armed again

    def _fail(self) -> None:
        self.failsafe = True
        self._cause = self._event.removesuffix(AFTER_DELAY)

    def _delay(self) -> None:
        """Delay the action of a failsafe, so that a pilot can take over (PX4 COM_FAIL_ACT_T). A
        second failsafe does not extend the delay."""
        at_s = self._state.time_s + self._parameters.role("failsafe_delay_s")
        if self._delayed is not None:
            at_s = self._delayed[0]
        self._delayed = (at_s, self._event + AFTER_DELAY)

    def _recover(self) -> None:
        self.failsafe = False

    def _take_off(self) -> None:
        self._guidance.newest = None
        self._controller.enter(Behaviour.TAKEOFF, self._request.takeoff_ned_m)

    def _hold(self) -> None:
        self._guidance.newest = None
        self._controller.enter(self.mode.behaviour)

    def _pause(self) -> None:
        place = MotionSetpoint(self._guidance.stopping_place_ned_m(self._state.estimate))
        self._guidance.paused = place if self._event == "pause" else None

    def _latch(self) -> None:
        self.latched |= {self._event}

    def _reboot(self) -> None:
        self.reboot_requested = True


CONDITIONS: dict[str, Callable[[Commander], bool]] = {
    "armed": lambda c: c.armed,
    "landed": lambda c: c._controller.landed,
    "action delayed": lambda c: c._delayed is not None,
    "ready": lambda c: c.healthy and c.mode.arms,
    "mode can run": lambda c: c._health.can_run(c._requested, c._state.time_s),
    "requested by ground station": lambda c: c._request.by_ground_station,
    "mode needs position": lambda c: c.mode.needs_position,
    "mode arms": lambda c: c.mode.arms,
    "mode needs sticks": lambda c: c.mode.needs_sticks,
    "throttle raised": lambda c: c._guidance.sticks.throttle_raised(c._state.time_s),
    "position missing": lambda c: (
        c._requested.needs_position
        and ("position" not in c._health.reached or c._health.position_lost)
    ),
    "fix missing": lambda c: not c.has_fix,
    "velocity rejected": lambda c: c.rejects_velocity,
    "mission missing": lambda c: not c._guidance.mission.flyable,
    "takeoff item missing": lambda c: not c._guidance.mission.takes_off,
    "climb requested": lambda c: c._request.takeoff_ned_m[2] <= c._guidance.home_ned_m[2],
    "attitude setpoint": lambda c: c._guidance.follows_attitude,
    "motion setpoint": lambda c: isinstance(c._guidance.setpoint, MotionSetpoint),
    "velocity setpoint": lambda c: c._guidance.follows_velocity,
}

ACTIONS: dict[str, Callable[[Commander], None]] = {
    "arm": Commander._arm,
    "disarm": Commander._disarm,
    "failsafe": Commander._fail,
    "delay": Commander._delay,
    "recover": Commander._recover,
    "take off": Commander._take_off,
    "return": lambda c: c._controller.enter(Behaviour.RETURN),
    "hold": Commander._hold,
    "level": lambda c: c._controller.level_off(),
    "pause": Commander._pause,
    "latch": Commander._latch,
    "reboot": Commander._reboot,
}

TEXT_VALUES: dict[str, Callable[[Commander], float | str]] = {
    "mode": lambda c: c._requested.title,
    "battery_v": lambda c: c._state.plant.battery.voltage_v,
    "used_mah": lambda c: c._state.plant.battery.used_mah,
    "delay_s": lambda c: c._parameters.role("failsafe_delay_s"),
}
