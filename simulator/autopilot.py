"""The autopilot's state: armed, mode, health, failsafe; and the engine that runs its rule table.

What happens (a command, a stream that stops, a landing) is an event; the first row of the
firmware's table whose mode and guards fit decides the next mode, the actions, the answer and the
text. Nothing here depends on which firmware it is. Knows no MAVLink frames, sockets or clock: the
vehicle's time is the plant's.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

from simulator.firmware.base import (
    AT_LAST,
    AttitudeSetpoint,
    Behaviour,
    Condition,
    Firmware,
    Mode,
    MotionSetpoint,
    Result,
    Rule,
    Say,
    Triple,
)
from simulator.geodesy import to_metres
from simulator.mission import RELATIVE_FRAMES, TERRAIN_FRAMES, Mission
from simulator.nav import Nav
from simulator.parameters import ParameterTable
from simulator.pilot import Pilot
from simulator.plant import STEP_S, Plant, Truth
from simulator.watch import EVERY_STEPS, Watch

_RESTS_STEPS = 250  # at most, so that what is changed behind its back is seen soon
_GO_ON = frozenset({Behaviour.SETPOINT, Behaviour.MISSION})  # when asked for again
_POSITION_IGNORED, _LOCAL_NED = 0b111, 1  # type_mask; MAV_FRAME
_GLOBAL_TARGET = "SET_POSITION_TARGET_GLOBAL_INT"


class Autopilot:
    """One autopilot on one plant. `step` moves both by STEP_S; texts pile up in `texts`."""

    def __init__(
        self,
        firmware: Firmware,
        plant: Plant,
        parameters: ParameterTable | None = None,
        mission: Mission | None = None,
        *,
        boot_scale: float = 1.0,
    ) -> None:
        self.firmware = firmware
        self.plant = plant
        self.parameters = parameters or ParameterTable(firmware)
        self.mission = mission or Mission(firmware.origin, firmware.mission_first)
        self.pilot = Pilot(firmware, self.parameters, self.mission)
        self.mode: Mode = firmware.modes[firmware.boot_mode]
        self.intended = self.remembered = firmware.boot_mode
        self.armed = self.failsafe = False
        self.latched: frozenset[str] = frozenset()  # events that a reboot alone undoes
        self.texts: list[Say] = []
        self.announcements: list[str] = []  # messages for every link
        self.reached: frozenset[str] = frozenset()  # boot events
        self.boot_scale = boot_scale
        self._boot = sorted((at_s * boot_scale, name) for name, at_s in firmware.boot.items())
        healthy_s = (firmware.healthy_after_s, firmware.healthy_without_position_after_s)
        grows_s = (*firmware.boot.values(), *healthy_s, firmware.sensors.first_fix_s)
        self._growth_s = [at_s * boot_scale for at_s in grows_s]
        self._grown_up_s = max(self._growth_s)
        self._rules: dict[str, list[Rule]] = {}
        for rule in firmware.rules:
            self._rules.setdefault(rule.event, []).append(rule)
        self.refused: dict[str, Say] = {}  # events, and "offboard", that are refused by a fault
        self.restarts = False  # a reboot was asked for and granted
        self.steps = 0
        self._truth: Truth | None = None
        self._nav: Nav | None = None
        self._armed_s = self._landed_s = -math.inf
        self._flown = False
        self._setpoint_s = -math.inf
        self._requested = self._event = ""
        self.asked_by_planner = False  # the last event, by the component of a ground station
        self._takeoff_z_m = math.nan
        self.gps_healthy = True
        self._watch = Watch(firmware, self.parameters)
        self._cause = ""  # of the failsafe
        self.resting = False  # compiled code flies
        self.calm_until = self._rests_since = 0
        self._awaited: tuple[float, str] | None = None  # when a failsafe is carried out

    # -- what others see ---------------------------------------------------------------------

    @property
    def time_s(self) -> float:
        """Vehicle time since boot."""
        return self.steps * STEP_S

    @property
    def stream_alive(self) -> bool:
        """Not lost: the firmware notices a little later than its time-out."""
        age_s = self.time_s - self._setpoint_s - self.firmware.stream_reaction_s
        return age_s <= self.parameters.role("stream_timeout_s")

    @property
    def landed(self) -> bool:
        return self.pilot.landed

    @property
    def healthy(self) -> bool:
        """The pre-arm checks pass, for the mode that was chosen."""
        firmware, mode = self.firmware, self.firmware.modes[self.intended]
        after_s = firmware.healthy_without_position_after_s
        if mode.needs_position:
            after_s = firmware.healthy_after_s
        waits = firmware.setpoint_mode_needs_stream and mode.behaviour is Behaviour.SETPOINT
        booted = self.time_s >= after_s * self.boot_scale and not self.latched
        if self.firmware.unhealthy_where_unarmable and not mode.arms:
            return False
        if self._watch.ground_station_lost and self.parameters.role("ground_station_needed") > 0:
            return False
        if mode.behaviour is Behaviour.MISSION:
            return booted and self.mission.flyable
        return booted and (self.stream_alive or not waits)

    @property
    def has_fix(self) -> bool:
        """GPS reports a position."""
        return self.time_s >= self.firmware.sensors.first_fix_s * self.boot_scale

    @property
    def _condition(self) -> Condition:
        return Condition(
            mode=self.mode,
            reached=self.reached,
            armed=self.armed,
            landed=self.landed,
            healthy=self.healthy,
            failsafe=self.failsafe,
            faulty=bool(self.latched),
            setpoint=self.pilot.setpoint,
        )

    @property
    def system_status(self) -> int:
        """MAV_STATE."""
        return self.firmware.heartbeat(self._condition)[1]

    @property
    def base_mode(self) -> int:
        """MAV_MODE_FLAG bits."""
        return self.firmware.heartbeat(self._condition)[0] | (128 if self.armed else 0)

    @property
    def landed_state(self) -> int:
        """MAV_LANDED_STATE: 1 on ground, 2 in air, 3 taking off, 4 landing."""
        if self.landed:
            return 1
        if self.pilot.landing:
            return 4
        return 3 if self.pilot.climbing else 2

    # -- what comes in -----------------------------------------------------------------------

    def happen(
        self,
        event: str,
        *,
        mode: str = "",
        takeoff_z_m: float = math.nan,
        by_planner: bool = False,
    ) -> Result:
        """Run the rule table for an event; `mode` is the one asked for, if the event asks."""
        self.wake()
        self._requested, self._takeoff_z_m, self._event = mode, takeoff_z_m, event
        self.asked_by_planner = by_planner
        if self.refused and (said := self.refused.get(self._wish(event, mode))) is not None:
            self.texts.append(said)
            return Result.TEMPORARILY_REJECTED
        for rule in self._rules.get(event, ()):
            if self._fits(rule):
                self._apply(rule, takeoff_z_m)
                return rule.result
        return Result.ACCEPTED

    def knows(self, event: str) -> bool:
        """Whether the firmware has rules for an event."""
        return event in self._rules

    def _wish(self, event: str, mode: str) -> str:
        by_setpoint = event == "mode" and self.firmware.modes[mode].behaviour is Behaviour.SETPOINT
        return "offboard" if by_setpoint else event

    def obey_attitude(self, values: Mapping[str, Any]) -> None:
        """Fields of SET_ATTITUDE_TARGET."""
        if self._obeys_setpoints:
            self._obey(self.firmware.attitude_setpoint(values, self.parameters.__getitem__))

    def obey_motion(self, values: Mapping[str, Any]) -> None:
        """Fields of SET_POSITION_TARGET_LOCAL_NED."""
        if self._obeys_setpoints and (
            self.mode.needs_position or self.firmware.setpoints_outlive_modes
        ):
            nav = self.look()
            local = self.firmware.in_local_frame(values, nav.position_ned_m, nav.attitude)
            self._obey_motion("SET_POSITION_TARGET_LOCAL_NED", local)

    def set_home(self, place_ned_m: Triple) -> None:
        """Home is there until the next arming."""
        self.pilot.home_ned_m = place_ned_m

    def reposition(
        self, latitude: float, longitude: float, height_m: float, frame: int, yaw_rad: float
    ) -> Result:
        """MAV_CMD_DO_REPOSITION: degrees; height above home or sea level, as the frame has it.

        What is not finite stays as it is.
        """
        result = self.happen("mode", mode=self.firmware.reposition_mode)
        if result is Result.ACCEPTED and self.armed:
            here = self.look().position_ned_m
            north, east = to_metres(self.firmware.origin, latitude, longitude)
            relative = frame in RELATIVE_FRAMES
            down = (self.pilot.home_ned_m[2] if relative else self.firmware.origin[2]) - height_m
            known = math.isfinite(north + east)
            down = down if math.isfinite(down) else here[2]
            place = (*((north, east) if known else here[:2]), down)
            self.pilot.go_to(place, yaw_rad if math.isfinite(yaw_rad) else math.nan)
        return result

    def obey_global_motion(self, values: Mapping[str, Any]) -> None:
        """Fields of SET_POSITION_TARGET_GLOBAL_INT."""
        if not self._obeys_setpoints:
            return
        frame, mask = values["coordinate_frame"], values["type_mask"]
        x, y = to_metres(self.firmware.origin, values["lat_int"] * 1e-7, values["lon_int"] * 1e-7)
        z = self.firmware.origin[2] - values["alt"]
        if mask & _POSITION_IGNORED:
            mask |= _POSITION_IGNORED
        elif frame not in self.firmware.global_frames:
            self._complain(_GLOBAL_TARGET, frame)
            return
        elif frame in RELATIVE_FRAMES:
            z = self.pilot.home_ned_m[2] - values["alt"]
        elif frame in TERRAIN_FRAMES:
            z = -values["alt"]
        place = {"coordinate_frame": _LOCAL_NED, "x": x, "y": y, "z": z, "type_mask": mask}
        self._obey_motion(_GLOBAL_TARGET, {**values, **place})

    def _obey_motion(self, message: str, values: Mapping[str, Any]) -> None:
        setpoint = self.firmware.motion_setpoint(values)
        if setpoint is None:
            frame = values["coordinate_frame"]
            self._complain(message, None if frame == _LOCAL_NED else frame)
        self._obey(setpoint)

    def _complain(self, message: str, frame: int | None) -> None:
        complaint = self.firmware.motion_complaint(message, frame)
        self.texts += () if complaint is None else (complaint,)

    @property
    def _obeys_setpoints(self) -> bool:
        in_mode = self.mode.behaviour is Behaviour.SETPOINT
        return in_mode or self.firmware.setpoints_outlive_modes

    def _obey(self, setpoint: AttitudeSetpoint | MotionSetpoint | None) -> None:
        if setpoint is None:
            return
        self._setpoint_s = self.time_s
        self.pilot.setpoint = setpoint
        if self.pilot.behaviour is not self.mode.behaviour:  # a takeoff within the mode ends
            self.pilot.enter(self.mode.behaviour, self.look())
        if isinstance(setpoint, AttitudeSetpoint) and setpoint.event:
            self.happen(setpoint.event)

    # -- time --------------------------------------------------------------------------------

    def step(self) -> None:
        """Fly STEP_S, then see what happened."""
        self.wake()
        was_landed = self.landed
        demand = self.pilot.fly(self.time_s, self.armed, self.look)
        self.plant.advance(STEP_S, demand)
        self.steps += 1
        self._truth = self._nav = None
        while self._boot and self.time_s >= self._boot[0][0]:
            _, event = self._boot.pop(0)
            self.reached |= {event}
            self.happen(event)
        if self.failsafe or self.mode.behaviour is Behaviour.SETPOINT:
            self._watch_stream()
        if self.armed:
            self._watch_flight(was_landed)
        if self.steps % EVERY_STEPS == 0:
            self._watch_surroundings()

    def rest(self) -> bool:
        """Leave the flight to compiled code until `wake` or `calm_until`, the step before which
        nothing can happen unless somebody speaks or the ground is touched or left.

        A step too early rather than one too late; False when that is now.
        """
        if self.failsafe or self.restarts:
            return False
        if not self.pilot.flies_itself(self.steps, self.armed, self.plant.on_ground):
            return False
        watched_s = self._watch.calm_until_s(self.time_s, self.gps_healthy)
        until_s = min(self._steady_until_s, watched_s)
        if self.armed:
            if not self._watch.calm_with(self.plant.battery_at_worst(_RESTS_STEPS * STEP_S)):
                return False
            if not self._flown:
                until_s = min(until_s, self._armed_s + self.parameters.role("disarm_idle_s"))
        self.calm_until = int(min(until_s / STEP_S, self.steps + _RESTS_STEPS)) - 1
        self.resting = self.calm_until > self.steps
        self._rests_since = self.steps
        return self.resting

    def wake(self) -> None:
        """Something is to happen: catch up with what compiled code flew."""
        if self.resting:
            self.resting = False
            self.pilot.flown(self._rests_since, self.steps - self._rests_since)
            watched = self.steps // EVERY_STEPS * EVERY_STEPS
            if watched > self._rests_since:
                self._watch.passed(watched * STEP_S, self.gps_healthy)

    @property
    def _steady_until_s(self) -> float:
        """When boot, the health of the sensors or the stream of setpoints changes by itself."""
        now_s, until_s = self.time_s, math.inf
        if now_s <= self._grown_up_s:
            until_s = min(at_s for at_s in self._growth_s if at_s >= now_s)
        lost_s = self._setpoint_s + self.firmware.stream_reaction_s
        lost_s += self.parameters.role("stream_timeout_s")
        watched = self.armed and self.mode.behaviour is Behaviour.SETPOINT
        return max(now_s, min(until_s, lost_s)) if watched or lost_s >= now_s else until_s

    def flown(self, count: int) -> None:
        """The plant is so many steps further, in which nothing happened."""
        self.steps += count
        self._truth = self._nav = None

    @property
    def truth(self) -> Truth:
        """Where the vehicle really is now."""
        if self._truth is None:
            self._truth = self.plant.truth
        return self._truth

    def look(self) -> Nav:
        """The estimate now, and whether the feet touch the ground."""
        if self._nav is None:
            plant = self.plant
            (north, east, down, v_north, v_east, v_down, w, x, y, z, p, q, r) = (
                plant.report().tolist()
            )
            self._nav = Nav(
                (north, east, down),
                (v_north, v_east, v_down),
                (w, x, y, z),
                (p, q, r),
                plant.on_ground,
                plant.reset_counter,
                plant.height_m,
            )
        return self._nav

    @property
    def position_lost(self) -> bool:
        """Without a fix for so long that the estimate is given up."""
        return self._watch.position_lost

    def hear_ground_station(self) -> None:
        """A heartbeat of one, on any link."""
        self._watch.hear_ground_station(self.time_s)

    def _watch_surroundings(self) -> None:
        battery = self.truth.battery
        for event in self._watch.step(self.time_s, self.armed, battery, self.gps_healthy):
            self.happen(event)
        if self._awaited is not None and self.time_s >= self._awaited[0]:
            event, self._awaited = self._awaited[1], None
            self.happen(event)

    def _watch_stream(self) -> None:
        if self.failsafe and self.stream_alive:
            self.happen("stream found")
        elif self.armed and self.mode.behaviour is Behaviour.SETPOINT and not self.stream_alive:
            self.happen("stream lost")

    def _watch_flight(self, was_landed: bool) -> None:
        if was_landed and not self.landed:
            self._flown = True
            self.happen("took off")
        elif self.landed and not was_landed:
            self._landed_s = self.time_s
            self.happen("landed")
        if self.pilot.climbed:
            self.happen("climbed")
        if self.pilot.events:
            events, self.pilot.events[:] = tuple(self.pilot.events), ()
            for event in events:
                self.happen(event)
        if not self.armed:
            return
        if self.landed and self._flown:
            self._expire("settled", self._landed_s, "disarm_landed_s")
        elif not self._flown:
            self._expire("idle", self._armed_s, "disarm_idle_s")

    def _expire(self, event: str, since_s: float, role: str) -> None:
        limit_s = self.parameters.role(role)
        if limit_s > 0 and self.time_s - since_s >= limit_s - 1e-6:
            self.happen(event)

    # -- the engine --------------------------------------------------------------------------

    def _fits(self, rule: Rule) -> bool:
        return rule.mode in ("*", self.mode.name) and all(self._holds(g) for g in rule.when)

    def _holds(self, guard: str) -> bool:
        if guard.startswith("not "):
            return not self._holds(guard[4:])
        if guard.startswith("since "):
            return self.failsafe and self._cause == guard[6:]
        if guard.startswith("reached "):
            return guard[8:] in self.reached
        if guard.startswith("latched "):
            return guard[8:] in self.latched
        name, compares, value = guard.partition("=")
        if compares:
            return self.parameters[name] == float(value)
        return GUARDS[guard](self)

    def _apply(self, rule: Rule, takeoff_z_m: float) -> None:
        asked = self._requested
        for action in rule.do:
            ACTIONS[action](self)
        target = {
            "*": self.mode.name if rule.to == "*" else rule.to,
            "requested": asked,
            "remembered": self.remembered,
        }.get(rule.to, rule.to)
        if rule.to != "*":
            self._enter(target, by_failsafe="failsafe" in rule.do, takeoff_z_m=takeoff_z_m)
        title = self.firmware.modes[asked].title if asked else self.mode.title
        for say in (*((rule.say,) if rule.say else ()), *rule.also):
            self.texts.append(Say(say.severity, say.text.format(mode=title, **self._figures)))
        self.announcements += rule.send

    @property
    def _figures(self) -> dict[str, float]:
        """What texts may name."""
        above_home_m = self.pilot.target_height_m
        amsl_m = self.firmware.origin[2] - self.pilot.home_ned_m[2] + above_home_m
        return {
            "takeoff_m": self.parameters.role("takeoff_height_m"),
            "climb_m": self.mission.climb_m,
            "target_m": above_home_m,
            "target_amsl_m": amsl_m,
            "battery_v": self.truth.battery.voltage_v,
            "used_mah": self.plant.used_mah,
            "delay_s": self.parameters.role("failsafe_delay_s"),
        }

    def _enter(self, name: str, *, by_failsafe: bool, takeoff_z_m: float) -> None:
        mode = self.firmware.modes[name]
        if not by_failsafe:
            self.failsafe = False
            self._awaited = None
            self.intended = name
            if mode.remembered:
                self.remembered = name
        if mode is not self.mode and not self.firmware.setpoints_outlive_modes:
            self.pilot.setpoint = None
        if mode is not self.mode or mode.behaviour not in _GO_ON:
            self.pilot.enter(mode.behaviour, self.look(), takeoff_z_m)
        self.mode = mode

    def _position_missing(self) -> bool:
        mode = self.firmware.modes[self._requested] if self._requested else self.mode
        return mode.needs_position and "position" not in self.reached

    def _climb_asked(self) -> bool:
        return self._takeoff_z_m <= self.pilot.home_ned_m[2]

    def _take_off(self) -> None:
        self.pilot.setpoint = None
        self.pilot.enter(Behaviour.TAKEOFF, self.look(), self._takeoff_z_m)

    def _hold(self) -> None:
        self.pilot.setpoint = None
        self.pilot.enter(self.mode.behaviour, self.look())

    def _level(self) -> None:
        self.pilot.level(self.look())

    def _latch(self) -> None:
        self.latched |= {self._event}

    def _mode_can_run(self) -> bool:
        mode = self.firmware.modes[self._requested]
        if mode.behaviour is Behaviour.SETPOINT:
            return self.stream_alive
        if mode.behaviour is Behaviour.MISSION:
            return self.mission.flyable
        return not mode.needs_sticks

    def _arm(self) -> None:
        self.armed, self._flown, self._armed_s = True, not self.landed, self.time_s
        self.pilot.arm(self.look())

    def _disarm(self) -> None:
        self.armed = self._flown = False
        self._awaited = None

    def _fail(self) -> None:
        self.failsafe = True
        self._cause = self._event.removesuffix(AT_LAST)

    def _await(self) -> None:
        """Carry the failsafe out later, so that a pilot can take over before; no later than one
        that waits already."""
        at_s = self.time_s + self.parameters.role("failsafe_delay_s")
        if self._awaited is not None:
            at_s = self._awaited[0]
        self._awaited = (at_s, self._event + AT_LAST)

    @property
    def awaits(self) -> bool:
        """A failsafe is put off."""
        return self._awaited is not None

    def _recover(self) -> None:
        self.failsafe = False

    def _restart(self) -> None:
        self.restarts = True


GUARDS: dict[str, Callable[[Autopilot], bool]] = {
    "armed": lambda autopilot: autopilot.armed,
    "landed": lambda autopilot: autopilot.landed,
    "failsafe": lambda autopilot: autopilot.failsafe,
    "waiting": lambda autopilot: autopilot.awaits,
    "ready": lambda autopilot: autopilot.healthy and autopilot.mode.arms,
    "mode can run": Autopilot._mode_can_run,
    "planner asks": lambda autopilot: autopilot.asked_by_planner,
    "mode needs position": lambda autopilot: autopilot.mode.needs_position,
    "mode arms": lambda autopilot: autopilot.mode.arms,
    "position missing": Autopilot._position_missing,
    "mission missing": lambda autopilot: not autopilot.mission.flyable,
    "climb asked": Autopilot._climb_asked,
    "climbing": lambda autopilot: autopilot.pilot.behaviour is Behaviour.TAKEOFF,
    "obeys attitude": lambda autopilot: autopilot.pilot.obeys_attitude,
    "obeys motion": lambda autopilot: autopilot.pilot.obeys_motion,
    "obeys velocity": lambda autopilot: autopilot.pilot.obeys_velocity,
}

ACTIONS: dict[str, Callable[[Autopilot], None]] = {
    "arm": Autopilot._arm,
    "disarm": Autopilot._disarm,
    "failsafe": Autopilot._fail,
    "await": Autopilot._await,
    "recover": Autopilot._recover,
    "take off": Autopilot._take_off,
    "hold": Autopilot._hold,
    "level": Autopilot._level,
    "latch": Autopilot._latch,
    "restart": Autopilot._restart,
}


def describe(firmware: Firmware) -> list[tuple[str, str, str, str, str]]:
    """The rule table for people: event, in mode, when, then mode, answer and text."""
    return [
        (
            rule.event,
            "any" if rule.mode == "*" else rule.mode,
            " and ".join(rule.when),
            "" if rule.to == "*" else rule.to,
            " ".join(
                part
                for part in (
                    rule.result.name if rule.result is not Result.ACCEPTED else "",
                    " ".join(f'"{say.text}"' for say in (rule.say, *rule.also) if say),
                )
                if part
            ),
        )
        for rule in firmware.rules
    ]
