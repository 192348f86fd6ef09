"""The commander: which mode, whether armed, which failsafe; and what is said about it.

What happens (a command, a stream that stops, a landing) is an event; a row of the firmware's table
(`simulator.autopilot.state_table`) decides the next mode, the actions, the answer and the text.
Nothing here depends on which firmware it is. Knows no MAVLink frames, sockets or clock.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from simulator.autopilot.airtime import Airtime
from simulator.autopilot.behaviours import BEHAVIOURS
from simulator.autopilot.health import Health
from simulator.autopilot.nav import Senses
from simulator.autopilot.navigator import Navigator
from simulator.autopilot.parameters import ParameterTable
from simulator.autopilot.pilot import Pilot
from simulator.autopilot.state_table import StateTable, fields_of
from simulator.firmware.base import AFTER_DELAY, Firmware, Rule
from simulator.firmware.values import NAN3, Behaviour, Condition, Mode, Result, StatusText, Triple


@dataclass(frozen=True, slots=True)
class Wish:
    """What an event asks for: a mode by name, a place (NED, m) to climb to; and who asks."""

    mode: str = ""
    takeoff_ned_m: Triple = NAN3
    by_planner: bool = False  # the component of a ground station


NOTHING = Wish()


class Commander:
    """Modes, arming and failsafes of one vehicle, changed by `happen` alone.

    Texts pile up in `texts`, messages for every link in `announcements`.
    """

    def __init__(
        self,
        firmware: Firmware,
        parameters: ParameterTable,
        navigator: Navigator,
        pilot: Pilot,
        senses: Senses,
        health: Health,
    ) -> None:
        self._firmware, self._parameters = firmware, parameters
        self._navigator, self._pilot = navigator, pilot
        self._guidance = navigator.guidance
        self._senses, self._health = senses, health
        self._table = StateTable(firmware, CONDITIONS, ACTIONS, TEXT_VALUES)
        self.mode: Mode = firmware.modes[firmware.boot_mode]
        self._intended = self._remembered = firmware.boot_mode
        self.armed = self.failsafe = False
        self.airtime = Airtime(parameters)
        self._latched: frozenset[str] = frozenset()  # events that a reboot alone undoes
        self.refused: dict[str, StatusText] = {}  # by a fault: events, and "offboard"
        self.restarts = False  # a reboot was asked for and granted
        self.texts: list[StatusText] = []
        self.announcements: list[str] = []
        self._event, self._wish = "", NOTHING  # what happens now
        self._cause = ""  # of the failsafe
        self._awaited: tuple[float, str] | None = None  # when a failsafe is carried out

    # -- what others see ---------------------------------------------------------------------

    @property
    def healthy(self) -> bool:
        """The pre-arm checks pass, for the mode that was chosen."""
        mode = self._firmware.modes[self._intended]
        return self._health.passes(mode, self._senses.time_s, latched=bool(self._latched))

    @property
    def heartbeat(self) -> tuple[int, int]:
        """MAV_MODE_FLAG bits, and MAV_STATE."""
        condition = Condition(
            mode=self.mode,
            reached=self._health.reached,
            armed=self.armed,
            landed=self._pilot.landed,
            healthy=self.healthy,
            failsafe=self.failsafe,
            faulty=bool(self._latched),
            setpoint=self._guidance.setpoint,
        )
        base_mode, state = self._firmware.heartbeat(condition)
        return base_mode | (128 if self.armed else 0), state

    def knows(self, event: str) -> bool:
        """Whether the firmware has rules for an event."""
        return self._table.knows(event)

    # -- events ------------------------------------------------------------------------------

    def happen(self, event: str, wish: Wish = NOTHING) -> Result:
        """Do what the table says about an event."""
        self._event, self._wish = event, wish
        if self.refused and (said := self.refused.get(self._refusable)) is not None:
            self.texts.append(said)
            return Result.TEMPORARILY_REJECTED
        rule = self._table.row(event, self.mode.name, self._holds)
        if rule is None:
            return Result.ACCEPTED
        self._apply(rule)
        return rule.result

    def carry_out(self) -> None:
        """What was put off, once its time has come."""
        if self._awaited is not None and self._senses.time_s >= self._awaited[0]:
            event, self._awaited = self._awaited[1], None
            self.happen(event)

    @property
    def _asked(self) -> Mode:
        """The mode asked for, else the present one."""
        return self._firmware.modes[self._wish.mode] if self._wish.mode else self.mode

    @property
    def _refusable(self) -> str:
        by_setpoint = self._event == "mode" and self._asked.behaviour is Behaviour.SETPOINT
        return "offboard" if by_setpoint else self._event

    def _holds(self, guard: str) -> bool:
        if guard.startswith("not "):
            return not self._holds(guard[4:])
        if guard.startswith("since "):
            return self.failsafe and self._cause == guard[6:]
        if guard.startswith("reached "):
            return guard[8:] in self._health.reached
        if guard.startswith("latched "):
            return guard[8:] in self._latched
        name, compares, value = guard.partition("=")
        if compares:
            return self._parameters[name] == float(value)
        return CONDITIONS[guard](self)

    def _apply(self, rule: Rule) -> None:
        for action in rule.do:
            ACTIONS[action](self)
        target = {"requested": self._wish.mode, "remembered": self._remembered}
        if rule.to != "*":
            self._enter(target.get(rule.to, rule.to), by_failsafe="failsafe" in rule.do)
        for text in rule.texts:
            values = {name: TEXT_VALUES[name](self) for name in fields_of(text.text)}
            self.texts.append(StatusText(text.severity, text.text.format(**values)))
        self.announcements += rule.send

    def _enter(self, name: str, *, by_failsafe: bool) -> None:
        mode = self._firmware.modes[name]
        if not by_failsafe:
            self.failsafe = False
            self._awaited = None
            self._intended = name
            if mode.remembered:
                self._remembered = name
        if mode is not self.mode and not self._firmware.setpoints.outlive_modes:
            self._guidance.setpoint = None
        if mode is not self.mode or not BEHAVIOURS[mode.behaviour].goes_on:
            self._pilot.enter(mode.behaviour, self._senses.look(), self._wish.takeoff_ned_m)
        self.mode = mode

    # -- actions -----------------------------------------------------------------------------

    def _arm(self) -> None:
        self.armed = True
        self.airtime.arm(self._senses.time_s, landed=self._pilot.landed)
        self._pilot.arm(self._senses.look())

    def _disarm(self) -> None:
        self.armed = False
        self.airtime.disarm()
        self._awaited = None

    def _fail(self) -> None:
        self.failsafe = True
        self._cause = self._event.removesuffix(AFTER_DELAY)

    def _await(self) -> None:
        """Carry the failsafe out later, so that a pilot can take over before; no later than one
        that waits already."""
        at_s = self._senses.time_s + self._parameters.role("failsafe_delay_s")
        if self._awaited is not None:
            at_s = self._awaited[0]
        self._awaited = (at_s, self._event + AFTER_DELAY)

    def _recover(self) -> None:
        self.failsafe = False

    def _take_off(self) -> None:
        self._guidance.setpoint = None
        self._pilot.enter(Behaviour.TAKEOFF, self._senses.look(), self._wish.takeoff_ned_m)

    def _return(self) -> None:
        self._pilot.enter(Behaviour.RETURN, self._senses.look())

    def _hold(self) -> None:
        self._guidance.setpoint = None
        self._pilot.enter(self.mode.behaviour, self._senses.look())

    def _level(self) -> None:
        self._pilot.level_off(self._senses.look())

    def _latch(self) -> None:
        self._latched |= {self._event}

    def _restart(self) -> None:
        self.restarts = True

    # -- conditions and values of texts --------------------------------------------------------

    def _target_amsl_m(self) -> float:
        home_amsl_m = self._firmware.origin[2] - self._guidance.home_ned_m[2]
        return home_amsl_m + self._navigator.target_height_m

    def _climb_asked(self) -> bool:
        return self._wish.takeoff_ned_m[2] <= self._guidance.home_ned_m[2]

    def _mode_can_run(self) -> bool:
        return self._health.can_run(self._asked, self._senses.time_s)


CONDITIONS: dict[str, Callable[[Commander], bool]] = {
    "armed": lambda own: own.armed,
    "landed": lambda own: own._pilot.landed,
    "waiting": lambda own: own._awaited is not None,
    "ready": lambda own: own.healthy and own.mode.arms,
    "mode can run": Commander._mode_can_run,
    "requested by ground station": lambda own: own._wish.by_planner,
    "mode needs position": lambda own: own.mode.needs_position,
    "mode arms": lambda own: own.mode.arms,
    "position missing": lambda own: own._health.position_missing(own._asked),
    "mission missing": lambda own: not own._guidance.mission.flyable,
    "climb requested": Commander._climb_asked,
    "climbing": lambda own: own._navigator.behaviour is Behaviour.TAKEOFF,
    "obeys attitude": lambda own: own._navigator.follows_attitude,
    "obeys motion": lambda own: own._navigator.follows_motion,
    "obeys velocity": lambda own: own._navigator.follows_velocity,
}

ACTIONS: dict[str, Callable[[Commander], None]] = {
    "arm": Commander._arm,
    "disarm": Commander._disarm,
    "failsafe": Commander._fail,
    "await": Commander._await,
    "recover": Commander._recover,
    "take off": Commander._take_off,
    "return": Commander._return,
    "hold": Commander._hold,
    "level": Commander._level,
    "latch": Commander._latch,
    "restart": Commander._restart,
}

TEXT_VALUES: dict[str, Callable[[Commander], float | str]] = {
    "mode": lambda own: own._asked.title,
    "takeoff_m": lambda own: own._parameters.role("takeoff_height_m"),
    "climb_m": lambda own: own._guidance.mission.climb_m,
    "target_m": lambda own: own._navigator.target_height_m,
    "target_amsl_m": Commander._target_amsl_m,
    "battery_v": lambda own: own._senses.truth.battery.voltage_v,
    "used_mah": lambda own: own._senses.truth.battery.used_mah,
    "delay_s": lambda own: own._parameters.role("failsafe_delay_s"),
}
