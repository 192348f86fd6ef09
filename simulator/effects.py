"""Effects of faults: what each does to the vehicle when it begins, at every step, and at its end.

What a fault is, is in `simulator.faults`; when it begins and ends, in `simulator.injection`. This
module knows the whole vehicle.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from random import Random
from typing import Any, Protocol

from simulator import faults
from simulator.autopilot.autopilot import Autopilot
from simulator.autopilot.commander import Request
from simulator.faults import Datagrams, LandedState, Refusable
from simulator.firmware.values import critical
from simulator.link.impairment import Channel
from simulator.mavlink.server import Server
from simulator.mavlink.view import Stuck, View
from simulator.sender import Sender
from simulator.steps import STEP_S

_REFUSED_EVENTS = {
    Refusable.ARM: ("arm", "force arm"),
    Refusable.OFFBOARD: ("offboard",),
    Refusable.TAKEOFF: ("takeoff",),
}
_NO_THRUST = 1e-9  # a factor that can be undone
_DATAGRAMS_MAX = 2000  # of a stranger, that wait
_HEARTBEAT_HZ = 1.0
_REFUSED_TITLES = {
    Refusable.ARM: "Arming denied",
    Refusable.OFFBOARD: "Switching to Offboard denied",
    Refusable.TAKEOFF: "Takeoff denied",
}


class Vehicle(Protocol):
    """What faults act on."""

    autopilot: Autopilot
    view: View
    companion: Server

    def reboot(self, silent_s: float) -> None: ...


@dataclass(slots=True)
class Running:
    """One fault of the scenario and its progress."""

    fault: Any
    channels: list[Channel]
    random: Random
    datagrams: list[bytes] = field(default_factory=list)  # of a stranger, to be sent
    begins_s: float | None = None  # None: the moment it counts from has not come
    begun: bool = False
    over: bool = False
    memory: Any = None  # what a later step or its end needs


def nothing(vehicle: Vehicle, running: Running) -> None:
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
    vehicle.view.silent[running.fault.message] = running.fault.every or 0


def _resume_message(vehicle: Vehicle, running: Running) -> None:
    vehicle.view.silent.pop(running.fault.message, None)


def _freeze_message(vehicle: Vehicle, running: Running) -> None:
    vehicle.view.stuck[running.fault.message] = Stuck(running.fault.stamp_runs)


def _unfreeze_message(vehicle: Vehicle, running: Running) -> None:
    vehicle.view.stuck.pop(running.fault.message, None)


def _offset_velocity(vehicle: Vehicle, running: Running) -> None:
    vehicle.autopilot.state.velocity_error_ned_mps = running.fault.offset_ned_mps


def _restore_velocity(vehicle: Vehicle, running: Running) -> None:
    vehicle.autopilot.state.velocity_error_ned_mps = (0.0, 0.0, 0.0)


def _report_wrongly(vehicle: Vehicle, running: Running) -> None:
    on_ground = running.fault.reports is LandedState.ON_GROUND
    vehicle.view.wrong_landed_state = 1 if on_ground else 2


def _report_rightly(vehicle: Vehicle, running: Running) -> None:
    vehicle.view.wrong_landed_state = None


def _detect_no_landing(vehicle: Vehicle, running: Running) -> None:
    vehicle.autopilot.pilot.detector.reset()


def _cut_motors(vehicle: Vehicle, running: Running) -> None:
    plant = vehicle.autopilot.plant
    if running.memory is None and plant.height_m <= running.fault.below_m:
        running.memory = _NO_THRUST
        plant.scale_thrust(_NO_THRUST)


def _restart_motors(vehicle: Vehicle, running: Running) -> None:
    if running.memory is not None:
        _restore_thrust(vehicle, running)


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


def _take_over(vehicle: Vehicle, running: Running) -> None:
    """Switch as by command, and where no command may, as to a mode that needs sticks."""
    autopilot = vehicle.autopilot
    mode = autopilot.firmware.mode_named(running.fault.mode or autopilot.firmware.hold_mode)
    assert mode is not None, "simulator.config checks it"
    running.memory = autopilot.commander.mode.name
    autopilot.handle("mode", Request(mode.name))
    if autopilot.commander.mode is not mode:
        autopilot.commander.switch(mode.name)


def _hand_back(vehicle: Vehicle, running: Running) -> None:
    vehicle.autopilot.handle("mode", Request(running.memory))


def _disarm(vehicle: Vehicle, running: Running) -> None:
    vehicle.autopilot.handle("force disarm")


def _add_sender(vehicle: Vehicle, running: Running) -> None:
    fault = running.fault
    running.memory = Sender(fault.system or vehicle.view.system, fault.component)


def _add_companion(vehicle: Vehicle, running: Running) -> None:
    _add_sender(vehicle, running)
    fault, target = running.fault, vehicle.view.system
    if fault.command is not None:
        command = running.memory.command(target, fault.command, fault.params)
        vehicle.companion.receive(command)


def _send_setpoints(vehicle: Vehicle, running: Running) -> None:
    fault, sender = running.fault, running.memory
    sender.step += 1
    for _ in sender.due(fault.setpoint_rate_hz):
        vehicle.companion.receive(sender.level_setpoint(vehicle.view.system, fault.thrust))
    for _ in sender.due(_HEARTBEAT_HZ):
        vehicle.companion.outbox.forward(sender.companion_heartbeat())


def _send_heartbeats(vehicle: Vehicle, running: Running) -> None:
    sender = running.memory
    sender.step += 1
    for _ in sender.due(running.fault.rate_hz):
        heartbeat = sender.autopilot_heartbeat(vehicle.autopilot.firmware)
        vehicle.companion.outbox.forward(heartbeat)


def _send_strange_datagrams(vehicle: Vehicle, running: Running) -> None:
    """Datagrams that nobody fetches are limited in number."""
    fault, sender = running.fault, running.memory
    sender.step += 1
    for _ in sender.due(fault.rate_hz):
        if fault.sends is Datagrams.NOISE:
            running.datagrams.append(running.random.randbytes(fault.size_bytes))
        else:
            running.datagrams.append(sender.autopilot_heartbeat(vehicle.autopilot.firmware))
    del running.datagrams[:-_DATAGRAMS_MAX]


Effect = Callable[[Vehicle, Running], None]

# By fault: what it does when it begins, at every step, and when it ends.
EFFECTS: dict[type, tuple[Effect, Effect, Effect]] = {
    faults.LinkFault: (_impair_link, nothing, _restore_link),
    faults.EstimatorJump: (_jump, nothing, nothing),
    faults.GpsLoss: (_lose_fix, _drift, _restore_fix),
    faults.SilentMessage: (_stop_message, nothing, _resume_message),
    faults.StuckMessage: (_freeze_message, nothing, _unfreeze_message),
    faults.VelocityError: (_offset_velocity, nothing, _restore_velocity),
    faults.WrongLandedState: (_report_wrongly, nothing, _report_rightly),
    faults.BlindLandDetector: (nothing, _detect_no_landing, nothing),
    faults.MotorsCut: (nothing, _cut_motors, _restart_motors),
    faults.WeakMotor: (_weaken_motor, nothing, _restore_thrust),
    faults.ThrustChange: (_change_thrust, nothing, _restore_thrust),
    faults.MassChange: (_change_mass, nothing, _restore_mass),
    faults.BatteryDrop: (_drop_battery, nothing, nothing),
    faults.Reboot: (_reboot, nothing, nothing),
    faults.ClockJump: (_jump_clock, nothing, _jump_clock_back),
    faults.Refusal: (_refuse, nothing, _allow),
    faults.PilotTakesOver: (_take_over, nothing, _hand_back),
    faults.PilotDisarms: (_disarm, nothing, nothing),
    faults.SecondSender: (_add_companion, _send_setpoints, nothing),
    faults.SecondVehicle: (_add_sender, _send_heartbeats, nothing),
    faults.Stranger: (_add_sender, _send_strange_datagrams, nothing),
}
