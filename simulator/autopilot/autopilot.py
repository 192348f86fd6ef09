"""The autopilot of one plant: each step controls the plant and then handles events.

The commander decides about modes, the guidance chooses the motion, the position controller flies
it, and health raises the events that nobody requests. Knows no MAVLink frames, sockets or clock:
its time is counted in steps of the plant.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from simulator.autopilot.behaviours import BEHAVIOURS
from simulator.autopilot.commander import NO_REQUEST, Commander, Request
from simulator.autopilot.firmware import Firmware
from simulator.autopilot.guidance import Guidance
from simulator.autopilot.health import MONITOR_STEPS, Health
from simulator.autopilot.mission import Mission
from simulator.autopilot.parameters import ParameterTable
from simulator.autopilot.position_controller import PositionController
from simulator.autopilot.state import VehicleState
from simulator.autopilot.values import (
    AttitudeSetpoint,
    Behaviour,
    MotionSetpoint,
    Result,
    StatusText,
    Triple,
)
from simulator.geodesy import TERRAIN_FRAMES, down_m, to_metres
from simulator.steps import STEP_S
from simulator.vehicle.plant import Plant

# Setpoint messages
ATTITUDE = "SET_ATTITUDE_TARGET"
LOCAL, GLOBAL = "SET_POSITION_TARGET_LOCAL_NED", "SET_POSITION_TARGET_GLOBAL_INT"
_POSITION_IGNORED, _LOCAL_NED = 0b111, 1  # type_mask; MAV_FRAME


class Autopilot:
    """Autopilot of one vehicle; `step` advances it and its plant by STEP_S.

    Args:
        firmware: the simulated firmware.
        plant: the vehicle.
        parameters, mission: those from before a reboot; None: the firmware's defaults, no items.
        boot_scale: factor on the times of the boot events.
    """

    def __init__(
        self,
        firmware: Firmware,
        plant: Plant,
        parameters: ParameterTable | None = None,
        mission: Mission | None = None,
        *,
        boot_scale: float = 1.0,
    ) -> None:
        self.firmware, self.plant = firmware, plant
        self.outputs_us = [0] * 16  # pulse widths set by MAV_CMD_DO_SET_SERVO
        self.parameters = parameters or ParameterTable(firmware)
        self.mission = mission or Mission(firmware, self.parameters)
        self.state = VehicleState(plant)
        self.guidance = Guidance(firmware, self.parameters, self.mission, BEHAVIOURS)
        self.health = Health(self.guidance, boot_scale)
        self.position_controller = PositionController(self.guidance, self.state)
        self.commander = Commander(self.guidance, self.position_controller, self.state, self.health)

    def handle(self, event: str, request: Request = NO_REQUEST) -> Result:
        """Handle an event that a command or a fault raises; return the acknowledgement."""
        return self.commander.handle(event, request)

    def take_setpoint(self, message: str, values: Mapping[str, Any]) -> None:
        """Take a setpoint message (ATTITUDE, LOCAL or GLOBAL, in any frame) if the firmware accepts
        it in the present mode."""
        mode = self.commander.mode
        accepted = mode.behaviour is Behaviour.SETPOINT
        if message != ATTITUDE:
            accepted = accepted and mode.needs_position
        if self.firmware.ardupilot_setpoints and not accepted:
            return
        setpoint, refusal = self._read_setpoint(message, values)
        self.commander.texts += () if refusal is None else (refusal,)
        if setpoint is None:
            return
        self.guidance.newest_s = self.state.time_s
        self.guidance.follow(setpoint)
        self._end_takeoff()
        if isinstance(setpoint, AttitudeSetpoint) and setpoint.event:
            self.handle(setpoint.event)

    def _read_setpoint(
        self, message: str, values: Mapping[str, Any]
    ) -> tuple[AttitudeSetpoint | MotionSetpoint | None, StatusText | None]:
        """Return the setpoint of a message, or the text about its refusal; both may be None."""
        firmware = self.firmware
        if message == ATTITUDE:
            return firmware.attitude_setpoint(values, self.parameters), None
        frame = values["coordinate_frame"]
        if message == LOCAL:
            local = firmware.in_local_frame(values, self.state.estimate)
        elif _has_position(values) and frame not in firmware.global_frames:
            return None, firmware.setpoint_rejection(message, frame)
        else:
            local = self._in_metres(values)
        setpoint = firmware.motion_setpoint(local)
        if setpoint is not None:
            return setpoint, None
        frame = local["coordinate_frame"]
        return None, firmware.setpoint_rejection(message, None if frame == _LOCAL_NED else frame)

    def _in_metres(self, values: Mapping[str, Any]) -> Mapping[str, Any]:
        """Convert the fields of GLOBAL to those of LOCAL in MAV_FRAME 1. A position with an ignored
        coordinate is ignored."""
        origin, frame, mask = self.firmware.origin, values["coordinate_frame"], values["type_mask"]
        x, y = to_metres(origin, values["lat_int"] * 1e-7, values["lon_int"] * 1e-7)
        z = down_m(values["alt"], frame, origin, self.guidance.home_ned_m[2])
        if frame in TERRAIN_FRAMES:
            z = -values["alt"]
        mask |= 0 if _has_position(values) else _POSITION_IGNORED
        place = {"coordinate_frame": _LOCAL_NED, "x": x, "y": y, "z": z, "type_mask": mask}
        return {**values, **place}

    def go_to(self, place_ned_m: Triple, yaw_rad: float) -> None:
        """Fly to this place and hold it, in a mode that holds or follows setpoints. With a NaN yaw
        the nose points in the direction of flight."""
        self._end_takeoff()
        self.guidance.hold_at(place_ned_m, yaw_rad)

    def _end_takeoff(self) -> None:
        """End a takeoff in a mode that follows setpoints (ArduCopter GUIDED)."""
        behaviour = self.commander.mode.behaviour
        if self.guidance.behaviour is not behaviour:
            self.position_controller.enter(behaviour)

    def step(self) -> None:
        """Control the plant for STEP_S, then handle the events of the step."""
        was_landed = self.position_controller.landed
        self.plant.advance(STEP_S, self.position_controller.step(self.commander.armed))
        self.state.step()
        for event in self._events(was_landed):
            self.commander.handle(event)

    def _events(self, was_landed: bool) -> Iterator[str]:
        """Events of this step; each is handled before the next condition is checked."""
        commander, now_s = self.commander, self.state.time_s
        controller = self.position_controller
        yield from self.health.boot_events(now_s)
        follows = commander.mode.behaviour is Behaviour.SETPOINT
        if commander.failsafe or follows:
            alive = self.guidance.stream_alive(now_s)
            if commander.failsafe and alive:
                yield "stream found"
            elif commander.armed and follows and not alive:
                yield "stream lost"
        if commander.armed:
            yield from self.health.flight(now_s, was_landed, controller.landed)
            while self.guidance.events:
                yield self.guidance.events.pop(0)
        if commander.armed:
            yield from self.health.timeout(now_s, controller.landed)
        if self.state.steps % MONITOR_STEPS == 0:
            battery, has_fix = self.plant.battery, self.plant.gps_healthy
            yield from self.health.monitor(now_s, commander.armed, battery, has_fix)
            yield from commander.due_events()


def _has_position(values: Mapping[str, Any]) -> bool:
    return not values["type_mask"] & _POSITION_IGNORED
