"""Faults of motors, mass, battery, estimator and land detector; actions of a pilot, refusals of the
autopilot, and its reboot.
"""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from offboard.model.vehicle import Triple
from simulator.autopilot.commander import Request
from simulator.autopilot.values import critical
from simulator.faults.fault import Effect, ModeName, Running, Timed, Vehicle, until_the_end
from simulator.steps import STEP_S

_NO_THRUST = 1e-9  # factor on the thrust; not 0, so that it can be undone


class ThrustChange(Timed):
    """The thrust of all motors is multiplied by `thrust_scale`."""

    fault: Literal["thrust_change"]
    thrust_scale: float = Field(ge=0.1, le=3)

    def effect(self, vehicle: Vehicle, running: Running) -> Effect:
        vehicle.autopilot.plant.scale_thrust(self.thrust_scale)
        yield from until_the_end()
        vehicle.autopilot.plant.scale_thrust(1.0 / self.thrust_scale)


class MotorsCut(Timed):
    """The motors have no thrust, from the first time at which the vehicle is below `below_m`."""

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
    """A load is picked up or dropped: the mass is multiplied by `mass_scale`."""

    fault: Literal["mass_change"]
    mass_scale: float = Field(ge=0.2, le=5)

    def effect(self, vehicle: Vehicle, running: Running) -> Effect:
        vehicle.autopilot.plant.scale_mass(self.mass_scale)
        yield from until_the_end()
        vehicle.autopilot.plant.scale_mass(1.0 / self.mass_scale)


class BatteryDrop(Timed):
    """The charge of the battery drops to the share `remaining` of its capacity, permanently."""

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
    """No GPS fix: the position estimate drifts to the north-east at `drift_mps`, with acceleration
    `drift_mps2`, and jumps back when the fix returns."""

    fault: Literal["gps_loss"]
    drift_mps: float = Field(default=0.0, ge=0, le=10)
    drift_mps2: float = Field(default=0.0, ge=0, le=10)

    def effect(self, vehicle: Vehicle, running: Running) -> Effect:
        plant, speed_mps, drifted_m = vehicle.autopilot.plant, self.drift_mps, 0.0
        plant.gps_healthy = False
        while (yield):
            step_m = speed_mps * STEP_S * 0.5**0.5
            speed_mps += self.drift_mps2 * STEP_S
            drifted_m += step_m
            plant.drift_estimate((step_m, step_m, 0.0))
        plant.gps_healthy = True
        if drifted_m:
            plant.reset_estimate((-drifted_m, -drifted_m, 0.0))


class VelocityError(Timed):
    """The velocity estimate has an offset, without an estimator reset."""

    fault: Literal["velocity_error"]
    offset_ned_mps: Triple

    def effect(self, vehicle: Vehicle, running: Running) -> Effect:
        vehicle.autopilot.plant.velocity_error_ned_mps[:] = self.offset_ned_mps
        yield from until_the_end()
        vehicle.autopilot.plant.velocity_error_ned_mps[:] = 0.0


class WrongLandedState(Timed):
    """EXTENDED_SYS_STATE reports this state; the autopilot itself uses the detected one."""

    fault: Literal["wrong_landed_state"]
    reports: Literal["on_ground", "in_air"]

    def effect(self, vehicle: Vehicle, running: Running) -> Effect:
        vehicle.view.wrong_landed_state = 1 if self.reports == "on_ground" else 2
        yield from until_the_end()
        vehicle.view.wrong_landed_state = None


class BlindLandDetector(Timed):
    """The land detector never detects a landing, so that the vehicle does not disarm."""

    fault: Literal["blind_land_detector"]

    def effect(self, vehicle: Vehicle, running: Running) -> Effect:
        while (yield):
            vehicle.autopilot.position_controller.detector.reset()


# Requests that can be refused: events of each, and beginning of the text
_REFUSED = {
    "arm": (("arm", "force arm"), "Arming denied"),
    "offboard": (("offboard",), "Switching to Offboard denied"),
    "takeoff": (("takeoff",), "Takeoff denied"),
}


class Refusal(Timed):
    """The autopilot refuses a request and says so in a STATUSTEXT."""

    fault: Literal["refusal"]
    of: Literal["arm", "offboard", "takeoff"]
    text: str = Field(default="Resolve system health failures first", min_length=1, max_length=200)

    def effect(self, vehicle: Vehicle, running: Running) -> Effect:
        events, title = _REFUSED[self.of]
        refused = vehicle.autopilot.commander.refused  # a reboot keeps it
        refused |= dict.fromkeys(events, critical(f"{title}: {self.text}"))
        yield from until_the_end()
        for event in events:
            refused.pop(event, None)


class PilotTakesOver(Timed):
    """The pilot switches to a mode, and after `for_s` back to the mode before.

    ArduCopter has the stick input of SITL without RC, throttle down, until a client overrides it.
    Without MANUAL_CONTROL, PX4 descends slowly in POSCTL.
    """

    fault: Literal["pilot_takes_over"]
    mode: ModeName | None = None  # None: the mode of the firmware that holds position

    def effect(self, vehicle: Vehicle, running: Running) -> Effect:
        """Switch the mode as a command does; if it may not, as the pilot's mode switch does."""
        autopilot = vehicle.autopilot
        mode = autopilot.firmware.mode_named(self.mode or autopilot.firmware.hold_mode)
        assert mode is not None, "the scenario was checked"
        before = autopilot.commander.mode.name
        autopilot.handle("mode", Request(mode.name))
        if autopilot.commander.mode is not mode:
            autopilot.commander.switch(mode.name)
        yield from until_the_end()
        vehicle.autopilot.handle("mode", Request(before))


class PilotDisarms(Timed):
    """The pilot disarms, also in the air."""

    fault: Literal["pilot_disarms"]

    def effect(self, vehicle: Vehicle, running: Running) -> Effect:
        vehicle.autopilot.handle("force disarm")
        yield from ()


class Reboot(Timed):
    """The autopilot reboots: after `for_s` of silence it is disarmed, and its time begins at 0."""

    fault: Literal["reboot"]
    for_s: float = Field(default=2.0, gt=0, le=60)

    def effect(self, vehicle: Vehicle, running: Running) -> Effect:
        vehicle.reboot(self.for_s)
        yield from ()
