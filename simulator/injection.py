"""Fault injection: begins and ends each fault of a scenario at its time, on one vehicle.

What a fault is, is in `simulator.faults`; link faults are in `simulator.link.impairment`. This
module knows the whole vehicle; no other module but `simulator.instance` knows it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from random import Random
from typing import Any, Protocol

from simulator import faults
from simulator.autopilot.autopilot import Autopilot
from simulator.autopilot.commander import Request
from simulator.faults import Direction, Fault, Moment, Refusable
from simulator.firmware.values import Behaviour, critical
from simulator.link.impairment import Channel, Path
from simulator.mavlink.view import Stuck, View
from simulator.steps import STEP_S

_REFUSED_EVENTS = {
    Refusable.ARM: ("arm", "force arm"),
    Refusable.OFFBOARD: ("offboard",),
    Refusable.TAKEOFF: ("takeoff",),
}
_REFUSED_TITLES = {
    Refusable.ARM: "Arming denied",
    Refusable.OFFBOARD: "Switching to Offboard denied",
    Refusable.TAKEOFF: "Takeoff denied",
}


class Vehicle(Protocol):
    """What faults act on."""

    autopilot: Autopilot
    view: View

    def reboot(self, silent_s: float) -> None: ...


@dataclass(slots=True)
class Running:
    """One fault of the scenario and its progress."""

    fault: Any
    channels: list[Channel]
    begins_s: float | None = None  # None: the moment it counts from has not come
    begun: bool = False
    over: bool = False
    memory: Any = None  # what its end has to undo


@dataclass(slots=True)
class Injection:
    """All faults of one flight. `down` and `up`: directions of the companion link."""

    down: Path
    up: Path
    _waiting: list[Running]
    _moments: dict[Moment, float] = field(default_factory=dict)
    _flown: bool = False

    def step(self, now_s: float, vehicle: Vehicle) -> None:
        """Begin and end the faults due at `now_s`, seconds since the start."""
        self._note_moments(now_s, vehicle.autopilot)
        for running in self._waiting:
            self._advance(running, now_s + 1e-6, vehicle)
        if any(running.over for running in self._waiting):
            self._waiting = [running for running in self._waiting if not running.over]

    def _note_moments(self, now_s: float, autopilot: Autopilot) -> None:
        self._flown = self._flown or not autopilot.pilot.landed
        by_setpoint = autopilot.commander.mode.behaviour is Behaviour.SETPOINT
        for moment, reached in (
            (Moment.BOOT, True),
            (Moment.ARMED, autopilot.commander.armed),
            (Moment.TOOK_OFF, not autopilot.pilot.landed),
            (Moment.ENGAGED, by_setpoint and autopilot.commander.armed),
            (Moment.LANDED, self._flown and autopilot.pilot.landed),
        ):
            if reached:
                self._moments.setdefault(moment, now_s)

    def _advance(self, running: Running, now_s: float, vehicle: Vehicle) -> None:
        fault = running.fault
        if running.begins_s is None:
            since_s = self._moments.get(fault.after)
            if since_s is None:
                return
            running.begins_s = since_s + fault.at_s
        if now_s < running.begins_s:
            return
        begin, during, end = EFFECTS[type(fault)]
        if not running.begun:
            running.begun = True
            begin(vehicle, running)
        if fault.for_s is not None and now_s >= running.begins_s + fault.for_s:
            end(vehicle, running)
            running.over = True
        elif during is not _nothing:
            during(vehicle, running)
        elif fault.for_s is None:
            running.over = True


def prepare(scenario: Sequence[Fault], seed: int) -> Injection | None:
    """Faults of one flight, none begun; None when the scenario has none."""
    if not scenario:
        return None
    paths: dict[Direction, list[Channel]] = {Direction.DOWN: [], Direction.UP: []}
    waiting: list[Running] = []
    for number, fault in enumerate(scenario):
        channels = []
        for direction, path in paths.items():
            if isinstance(fault, faults.LinkFault) and fault.direction in (direction, "both"):
                channels.append(Channel(fault, Random(f"{seed} {number} {direction}")))
                channels[-1].on = False
                path.append(channels[-1])
        waiting.append(Running(fault, channels))
    down, up = (Path(tuple(path)) for path in paths.values())
    return Injection(down, up, waiting)


def _nothing(vehicle: Vehicle, running: Running) -> None:
    pass


def _impair_link(vehicle: Vehicle, running: Running) -> None:
    for channel in running.channels:
        channel.on = True


def _restore_link(vehicle: Vehicle, running: Running) -> None:
    for channel in running.channels:
        channel.on = False


def _jump(vehicle: Vehicle, running: Running) -> None:
    vehicle.autopilot.plant.reset_estimate(running.fault.offset_ned_m)


def _lose_fix(vehicle: Vehicle, running: Running) -> None:
    vehicle.autopilot.state.gps_healthy = False
    running.memory = 0.0


def _drift(vehicle: Vehicle, running: Running) -> None:
    step_m = running.fault.drift_mps * STEP_S * 0.5**0.5
    running.memory += step_m
    vehicle.autopilot.plant.drift_estimate((step_m, step_m, 0.0))


def _restore_fix(vehicle: Vehicle, running: Running) -> None:
    vehicle.autopilot.state.gps_healthy = True
    if running.memory:
        vehicle.autopilot.plant.reset_estimate((-running.memory, -running.memory, 0.0))


def _stop_message(vehicle: Vehicle, running: Running) -> None:
    vehicle.view.silent.add(running.fault.message)


def _resume_message(vehicle: Vehicle, running: Running) -> None:
    vehicle.view.silent.discard(running.fault.message)


def _freeze_message(vehicle: Vehicle, running: Running) -> None:
    vehicle.view.stuck[running.fault.message] = Stuck(running.fault.stamp_runs)


def _unfreeze_message(vehicle: Vehicle, running: Running) -> None:
    vehicle.view.stuck.pop(running.fault.message, None)


def _weaken_motor(vehicle: Vehicle, running: Running) -> None:
    running.memory = (3.0 + running.fault.motor_scale) / 4.0
    vehicle.autopilot.plant.scale_thrust(running.memory)


def _change_thrust(vehicle: Vehicle, running: Running) -> None:
    running.memory = running.fault.thrust_scale
    vehicle.autopilot.plant.scale_thrust(running.memory)


def _restore_thrust(vehicle: Vehicle, running: Running) -> None:
    vehicle.autopilot.plant.scale_thrust(1.0 / running.memory)


def _change_mass(vehicle: Vehicle, running: Running) -> None:
    vehicle.autopilot.plant.scale_mass(running.fault.mass_scale)


def _restore_mass(vehicle: Vehicle, running: Running) -> None:
    vehicle.autopilot.plant.scale_mass(1.0 / running.fault.mass_scale)


def _drop_battery(vehicle: Vehicle, running: Running) -> None:
    vehicle.autopilot.plant.set_battery(running.fault.remaining)


def _reboot(vehicle: Vehicle, running: Running) -> None:
    vehicle.reboot(running.fault.for_s)


def _jump_clock(vehicle: Vehicle, running: Running) -> None:
    vehicle.view.clock_offset_us += round(running.fault.jump_s * 1e6)


def _jump_clock_back(vehicle: Vehicle, running: Running) -> None:
    vehicle.view.clock_offset_us -= round(running.fault.jump_s * 1e6)


def _refuse(vehicle: Vehicle, running: Running) -> None:
    of = running.fault.of
    text = critical(f"{_REFUSED_TITLES[of]}: {running.fault.text}")
    for event in _REFUSED_EVENTS[of]:
        vehicle.autopilot.commander.refused[event] = text


def _allow(vehicle: Vehicle, running: Running) -> None:
    for event in _REFUSED_EVENTS[running.fault.of]:
        vehicle.autopilot.commander.refused.pop(event, None)


def _switch_to_hold(vehicle: Vehicle, running: Running) -> None:
    modes = vehicle.autopilot.firmware.modes.values()
    hold = next(mode.name for mode in modes if mode.behaviour is Behaviour.HOLD)
    vehicle.autopilot.handle("mode", Request(hold))


Effect = Callable[[Vehicle, Running], None]

# By fault: what it does when it begins, at every step, and when it ends.
EFFECTS: dict[type, tuple[Effect, Effect, Effect]] = {
    faults.LinkFault: (_impair_link, _nothing, _restore_link),
    faults.EstimatorJump: (_jump, _nothing, _nothing),
    faults.GpsLoss: (_lose_fix, _drift, _restore_fix),
    faults.SilentMessage: (_stop_message, _nothing, _resume_message),
    faults.StuckMessage: (_freeze_message, _nothing, _unfreeze_message),
    faults.WeakMotor: (_weaken_motor, _nothing, _restore_thrust),
    faults.ThrustChange: (_change_thrust, _nothing, _restore_thrust),
    faults.MassChange: (_change_mass, _nothing, _restore_mass),
    faults.BatteryDrop: (_drop_battery, _nothing, _nothing),
    faults.Reboot: (_reboot, _nothing, _nothing),
    faults.ClockJump: (_jump_clock, _nothing, _jump_clock_back),
    faults.Refusal: (_refuse, _nothing, _allow),
    faults.PilotTakesOver: (_switch_to_hold, _nothing, _nothing),
}
