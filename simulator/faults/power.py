"""Faults of motors, mass and battery."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from simulator.faults.base import Effect, Running, Timed, Vehicle, until_the_end

_NO_THRUST = 1e-9  # a factor that can be undone


def _scaled_thrust(vehicle: Vehicle, factor: float) -> Effect:
    vehicle.autopilot.plant.scale_thrust(factor)
    yield from until_the_end()
    vehicle.autopilot.plant.scale_thrust(1.0 / factor)


class WeakMotor(Timed):
    """One of four motors has `motor_scale` of its thrust; the mixer keeps the torques."""

    fault: Literal["weak_motor"]
    motor_scale: float = Field(ge=0, le=1)

    def effect(self, vehicle: Vehicle, running: Running) -> Effect:
        return _scaled_thrust(vehicle, (3.0 + self.motor_scale) / 4.0)


class ThrustChange(Timed):
    """Thrust of all motors multiplied by `thrust_scale`."""

    fault: Literal["thrust_change"]
    thrust_scale: float = Field(ge=0.1, le=3)

    def effect(self, vehicle: Vehicle, running: Running) -> Effect:
        return _scaled_thrust(vehicle, self.thrust_scale)


class MotorsCut(Timed):
    """No motor has thrust any more, from the first time on that the vehicle is below `below_m`."""

    fault: Literal["motors_cut"]
    below_m: float = Field(default=1e4, ge=0, le=1e4)  # above the ground

    def effect(self, vehicle: Vehicle, running: Running) -> Effect:
        plant, cut = vehicle.autopilot.plant, False
        while (yield):
            if not cut and plant.height_m <= self.below_m:
                cut = True
                plant.scale_thrust(_NO_THRUST)
        if cut:
            plant.scale_thrust(1.0 / _NO_THRUST)


class MassChange(Timed):
    """A load picked up or dropped: mass multiplied by `mass_scale`."""

    fault: Literal["mass_change"]
    mass_scale: float = Field(ge=0.2, le=5)

    def effect(self, vehicle: Vehicle, running: Running) -> Effect:
        vehicle.autopilot.plant.scale_mass(self.mass_scale)
        yield from until_the_end()
        vehicle.autopilot.plant.scale_mass(1.0 / self.mass_scale)


class BatteryDrop(Timed):
    """The charge of the battery drops to `remaining` of its capacity, permanently."""

    fault: Literal["battery_drop"]
    remaining: float = Field(ge=0, le=1)

    def effect(self, vehicle: Vehicle, running: Running) -> Effect:
        vehicle.autopilot.plant.set_battery(self.remaining)
        yield from ()
