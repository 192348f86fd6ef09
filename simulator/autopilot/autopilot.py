"""One autopilot on one plant, step by step: it controls the plant and then handles events.

The commander decides about modes, the guidance chooses the motion, the position controller flies
it, health reports what changes without a request. Knows no MAVLink frames, sockets or
clock: its time is the plant's.
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
from simulator.autopilot.setpoints import ATTITUDE, SetpointStream
from simulator.autopilot.state import VehicleState
from simulator.autopilot.values import AttitudeSetpoint, Behaviour, Result, Triple
from simulator.steps import STEP_S
from simulator.vehicle.plant import Plant


class Autopilot:
    """Autopilot of one vehicle; `step` moves it and its plant by STEP_S.

    Args:
        firmware: which autopilot is simulated.
        plant: the vehicle.
        parameters, mission: kept over a reboot; None: the firmware's defaults, no items.
        boot_scale: factor on the times of the start.
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
        self.outputs_us = [0] * 16  # pulse widths that a client asked for
        self.parameters = parameters or ParameterTable(firmware)
        self.mission = mission or Mission(firmware, self.parameters)
        self.state = VehicleState(plant)
        self.stream = SetpointStream(firmware, self.parameters)
        self.guidance = Guidance(firmware, self.parameters, self.mission, BEHAVIOURS)
        self.health = Health(firmware, self.parameters, self.mission, self.stream, boot_scale)
        self.position_controller = PositionController(self.guidance, self.state)
        self.commander = Commander(self.guidance, self.position_controller, self.state, self.health)

    def handle(self, event: str, request: Request = NO_REQUEST) -> Result:
        """Handle an event from outside; returns the acknowledgement."""
        return self.commander.handle(event, request)

    def take_setpoint(self, message: str, values: Mapping[str, Any]) -> None:
        """Take a setpoint message, by its name in `simulator.autopilot.setpoints` and its fields,
        where the firmware accepts it in the present mode."""
        mode = self.commander.mode
        accepted = mode.behaviour is Behaviour.SETPOINT
        if message != ATTITUDE:
            accepted = accepted and mode.needs_position
        if not (accepted or self.firmware.setpoints_outlive_modes):
            return
        home_down_m = self.guidance.home_ned_m[2]
        setpoint, refusal = self.stream.read(message, values, self.state.estimate, home_down_m)
        self.commander.texts += () if refusal is None else (refusal,)
        if setpoint is None:
            return
        self.stream.newest_s = self.state.time_s
        self.guidance.follow(setpoint)
        self._end_takeoff()
        if isinstance(setpoint, AttitudeSetpoint) and setpoint.event:
            self.handle(setpoint.event)

    def go_to(self, place_ned_m: Triple, yaw_rad: float) -> None:
        """Hold this place, in a mode that holds or follows setpoints; a NaN yaw faces the
        direction of flight."""
        self._end_takeoff()
        self.guidance.hold_at(place_ned_m, yaw_rad)

    def _end_takeoff(self) -> None:
        """End the takeoff of a mode that follows setpoints."""
        behaviour = self.commander.mode.behaviour
        if self.guidance.behaviour is not behaviour:
            self.position_controller.enter(behaviour)

    def step(self) -> None:
        """Fly STEP_S, then handle the events of the step."""
        was_landed = self.position_controller.landed
        self.plant.advance(STEP_S, self.position_controller.step(self.commander.armed))
        self.state.step()
        for event in self._events(was_landed):
            self.commander.handle(event)

    def _events(self, was_landed: bool) -> Iterator[str]:
        """Events of this step; each is handled before the next one is looked for."""
        commander, now_s = self.commander, self.state.time_s
        controller = self.position_controller
        yield from self.health.boot_events(now_s)
        follows = commander.mode.behaviour is Behaviour.SETPOINT
        if commander.failsafe or follows:
            alive = self.stream.alive(now_s)
            if commander.failsafe and alive:
                yield "stream found"
            elif commander.armed and follows and not alive:
                yield "stream lost"
        if commander.armed:
            yield from commander.flight_time.step(now_s, was_landed, controller.landed)
            while self.guidance.events:
                yield self.guidance.events.pop(0)
        if commander.armed:
            yield from commander.flight_time.timeout(now_s, controller.landed)
        if self.state.steps % MONITOR_STEPS == 0:
            battery, has_fix = self.plant.battery, self.plant.gps_healthy
            yield from self.health.monitor(now_s, commander.armed, battery, has_fix)
            yield from commander.due_events()
