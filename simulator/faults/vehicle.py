"""Faults of motors, mass and battery, of the estimator and of the land detector."""

from __future__ import annotations

from enum import StrEnum
from typing import Literal

from pydantic import Field

from offboard.model.vehicle import Triple
from simulator.faults.fault import Effect, Running, Timed, Vehicle, until_the_end
from simulator.steps import STEP_S

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


class EstimatorJump(Timed):
    """The position estimate jumps, and its reset counter increases."""

    fault: Literal["estimator_jump"]
    offset_ned_m: Triple

    def effect(self, vehicle: Vehicle, running: Running) -> Effect:
        vehicle.autopilot.plant.reset_estimate(self.offset_ned_m)
        yield from ()


class GpsLoss(Timed):
    """No GPS fix: the position estimate drifts to the north-east, faster and faster with
    `drift_mps2`, and jumps back with the fix."""

    fault: Literal["gps_loss"]
    drift_mps: float = Field(default=0.0, ge=0, le=10)
    drift_mps2: float = Field(default=0.0, ge=0, le=10)

    def effect(self, vehicle: Vehicle, running: Running) -> Effect:
        vehicle.autopilot.state.gps_healthy = False
        speed_mps, drifted_m = self.drift_mps, 0.0
        while (yield):
            step_m = speed_mps * STEP_S * 0.5**0.5
            speed_mps += self.drift_mps2 * STEP_S
            drifted_m += step_m
            vehicle.autopilot.plant.drift_estimate((step_m, step_m, 0.0))
        vehicle.autopilot.state.gps_healthy = True
        if drifted_m:
            vehicle.autopilot.plant.reset_estimate((-drifted_m, -drifted_m, 0.0))


class VelocityError(Timed):
    """The velocity estimate has an offset, without an estimator reset."""

    fault: Literal["velocity_error"]
    offset_ned_mps: Triple

    def effect(self, vehicle: Vehicle, running: Running) -> Effect:
        vehicle.autopilot.state.velocity_error_ned_mps = self.offset_ned_mps
        yield from until_the_end()
        vehicle.autopilot.state.velocity_error_ned_mps = (0.0, 0.0, 0.0)


class LandedState(StrEnum):
    """What EXTENDED_SYS_STATE can report wrongly."""

    ON_GROUND = "on_ground"
    IN_AIR = "in_air"


class WrongLandedState(Timed):
    """EXTENDED_SYS_STATE reports this state; the autopilot itself knows the true one."""

    fault: Literal["wrong_landed_state"]
    reports: LandedState

    def effect(self, vehicle: Vehicle, running: Running) -> Effect:
        on_ground = self.reports is LandedState.ON_GROUND
        vehicle.view.wrong_landed_state = 1 if on_ground else 2
        yield from until_the_end()
        vehicle.view.wrong_landed_state = None


class BlindLandDetector(Timed):
    """The land detector never detects a landing, so that the vehicle does not disarm."""

    fault: Literal["blind_land_detector"]

    def effect(self, vehicle: Vehicle, running: Running) -> Effect:
        while (yield):
            vehicle.autopilot.position_controller.detector.reset()
