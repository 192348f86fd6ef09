"""Effects of faults: what each does to the vehicle when it begins, at every step, and at its end.

An effect is a generator: it begins, then yields until its end. Each yield returns True at a step of
the vehicle, the step of its beginning among them, and False when the fault ends. What a fault is,
is in `simulator.faults`; when it begins and ends, in `simulator.injection`. This module knows the
whole vehicle.
"""

from __future__ import annotations

from collections.abc import Callable, Generator
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
    begins_s: float | None = None  # None until the event that starts its delay
    effect: Effect | None = None  # once it has begun
    over: bool = False


Effect = Generator[None, bool, None]


def _until_the_end() -> Effect:
    while (yield):
        pass


def _link(vehicle: Vehicle, running: Running) -> Effect:
    for channel in running.channels:
        channel.on = True
    yield from _until_the_end()
    for channel in running.channels:
        channel.on = False


def _estimator_jump(vehicle: Vehicle, running: Running) -> Effect:
    vehicle.autopilot.plant.reset_estimate(running.fault.offset_ned_m)
    yield from ()


def _gps_loss(vehicle: Vehicle, running: Running) -> Effect:
    vehicle.autopilot.state.gps_healthy = False
    speed_mps, drifted_m = running.fault.drift_mps, 0.0
    while (yield):
        step_m = speed_mps * STEP_S * 0.5**0.5
        speed_mps += running.fault.drift_mps2 * STEP_S
        drifted_m += step_m
        vehicle.autopilot.plant.drift_estimate((step_m, step_m, 0.0))
    vehicle.autopilot.state.gps_healthy = True
    if drifted_m:
        vehicle.autopilot.plant.reset_estimate((-drifted_m, -drifted_m, 0.0))


def _silent_message(vehicle: Vehicle, running: Running) -> Effect:
    vehicle.view.silent[running.fault.message] = running.fault.every or 0
    yield from _until_the_end()
    vehicle.view.silent.pop(running.fault.message, None)


def _stuck_message(vehicle: Vehicle, running: Running) -> Effect:
    vehicle.view.stuck[running.fault.message] = Stuck(running.fault.stamp_runs)
    yield from _until_the_end()
    vehicle.view.stuck.pop(running.fault.message, None)


def _velocity_error(vehicle: Vehicle, running: Running) -> Effect:
    vehicle.autopilot.state.velocity_error_ned_mps = running.fault.offset_ned_mps
    yield from _until_the_end()
    vehicle.autopilot.state.velocity_error_ned_mps = (0.0, 0.0, 0.0)


def _wrong_landed_state(vehicle: Vehicle, running: Running) -> Effect:
    on_ground = running.fault.reports is LandedState.ON_GROUND
    vehicle.view.wrong_landed_state = 1 if on_ground else 2
    yield from _until_the_end()
    vehicle.view.wrong_landed_state = None


def _blind_land_detector(vehicle: Vehicle, running: Running) -> Effect:
    while (yield):
        vehicle.autopilot.pilot.detector.reset()


def _motors_cut(vehicle: Vehicle, running: Running) -> Effect:
    plant, cut = vehicle.autopilot.plant, False
    while (yield):
        if not cut and plant.height_m <= running.fault.below_m:
            cut = True
            plant.scale_thrust(_NO_THRUST)
    if cut:
        plant.scale_thrust(1.0 / _NO_THRUST)


def _scaled_thrust(vehicle: Vehicle, factor: float) -> Effect:
    vehicle.autopilot.plant.scale_thrust(factor)
    yield from _until_the_end()
    vehicle.autopilot.plant.scale_thrust(1.0 / factor)


def _weak_motor(vehicle: Vehicle, running: Running) -> Effect:
    return _scaled_thrust(vehicle, (3.0 + running.fault.motor_scale) / 4.0)


def _thrust_change(vehicle: Vehicle, running: Running) -> Effect:
    return _scaled_thrust(vehicle, running.fault.thrust_scale)


def _mass_change(vehicle: Vehicle, running: Running) -> Effect:
    vehicle.autopilot.plant.scale_mass(running.fault.mass_scale)
    yield from _until_the_end()
    vehicle.autopilot.plant.scale_mass(1.0 / running.fault.mass_scale)


def _battery_drop(vehicle: Vehicle, running: Running) -> Effect:
    vehicle.autopilot.plant.set_battery(running.fault.remaining)
    yield from ()


def _reboot(vehicle: Vehicle, running: Running) -> Effect:
    vehicle.reboot(running.fault.for_s)
    yield from ()


def _clock_jump(vehicle: Vehicle, running: Running) -> Effect:
    jump_us = round(running.fault.jump_s * 1e6)
    vehicle.view.clock_offset_us += jump_us
    yield from _until_the_end()
    vehicle.view.clock_offset_us -= jump_us


def _refusal(vehicle: Vehicle, running: Running) -> Effect:
    of = running.fault.of
    text = critical(f"{_REFUSED_TITLES[of]}: {running.fault.text}")
    for event in _REFUSED_EVENTS[of]:
        vehicle.autopilot.commander.refused[event] = text
    yield from _until_the_end()
    for event in _REFUSED_EVENTS[of]:
        vehicle.autopilot.commander.refused.pop(event, None)


def _pilot_takes_over(vehicle: Vehicle, running: Running) -> Effect:
    """Switch the mode as a command would; a mode that needs sticks is entered as by the pilot."""
    autopilot = vehicle.autopilot
    mode = autopilot.firmware.mode_named(running.fault.mode or autopilot.firmware.hold_mode)
    assert mode is not None, "simulator.config checks it"
    before = autopilot.commander.mode.name
    autopilot.handle("mode", Request(mode.name))
    if autopilot.commander.mode is not mode:
        autopilot.commander.switch(mode.name)
    yield from _until_the_end()
    vehicle.autopilot.handle("mode", Request(before))


def _pilot_disarms(vehicle: Vehicle, running: Running) -> Effect:
    vehicle.autopilot.handle("force disarm")
    yield from ()


def _sender(vehicle: Vehicle, running: Running) -> Sender:
    return Sender(running.fault.system or vehicle.view.system, running.fault.component)


def _second_sender(vehicle: Vehicle, running: Running) -> Effect:
    fault, target, sender = running.fault, vehicle.view.system, _sender(vehicle, running)
    if fault.command is not None:
        vehicle.companion.receive(sender.command(target, fault.command, fault.params))
    while (yield):
        sender.step += 1
        for _ in sender.due(fault.setpoint_rate_hz):
            vehicle.companion.receive(sender.level_setpoint(vehicle.view.system, fault.thrust))
        for _ in sender.due(_HEARTBEAT_HZ):
            vehicle.companion.outbox.forward(sender.companion_heartbeat(fault.custom_mode))


def _second_vehicle(vehicle: Vehicle, running: Running) -> Effect:
    sender = _sender(vehicle, running)
    while (yield):
        sender.step += 1
        for _ in sender.due(running.fault.rate_hz):
            heartbeat = sender.autopilot_heartbeat(vehicle.autopilot.firmware)
            vehicle.companion.outbox.forward(heartbeat)


def _stranger(vehicle: Vehicle, running: Running) -> Effect:
    """Send datagrams of another sender; those that wait to be sent are limited in number."""
    fault, sender = running.fault, _sender(vehicle, running)
    while (yield):
        sender.step += 1
        for _ in sender.due(fault.rate_hz):
            if fault.sends is Datagrams.NOISE:
                running.datagrams.append(running.random.randbytes(fault.size_bytes))
            else:
                running.datagrams.append(sender.autopilot_heartbeat(vehicle.autopilot.firmware))
        del running.datagrams[:-_DATAGRAMS_MAX]


EFFECTS: dict[type, Callable[[Vehicle, Running], Effect]] = {
    faults.LinkFault: _link,
    faults.EstimatorJump: _estimator_jump,
    faults.GpsLoss: _gps_loss,
    faults.SilentMessage: _silent_message,
    faults.StuckMessage: _stuck_message,
    faults.VelocityError: _velocity_error,
    faults.WrongLandedState: _wrong_landed_state,
    faults.BlindLandDetector: _blind_land_detector,
    faults.MotorsCut: _motors_cut,
    faults.WeakMotor: _weak_motor,
    faults.ThrustChange: _thrust_change,
    faults.MassChange: _mass_change,
    faults.BatteryDrop: _battery_drop,
    faults.Reboot: _reboot,
    faults.ClockJump: _clock_jump,
    faults.Refusal: _refusal,
    faults.PilotTakesOver: _pilot_takes_over,
    faults.PilotDisarms: _pilot_disarms,
    faults.SecondSender: _second_sender,
    faults.SecondVehicle: _second_vehicle,
    faults.Stranger: _stranger,
}
