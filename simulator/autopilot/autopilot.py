"""One autopilot on one plant, step by step: it flies, and then looks at what happened.

Its parts: the commander decides about modes, the navigator says where to be, the pilot flies there,
health and watch see to what changes by itself. Here is their order in time.
Knows no MAVLink frames, sockets or clock: the vehicle's time is the plant's.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from simulator.autopilot.commander import NOTHING, Commander, Wish
from simulator.autopilot.guidance import Guidance
from simulator.autopilot.health import Health
from simulator.autopilot.mission import Mission
from simulator.autopilot.nav import Senses
from simulator.autopilot.navigator import Navigator
from simulator.autopilot.parameters import ParameterTable
from simulator.autopilot.pilot import Pilot
from simulator.autopilot.setpoints import ATTITUDE, SetpointStream
from simulator.autopilot.sticks import Sticks
from simulator.autopilot.watch import EVERY_STEPS, Watch
from simulator.firmware.base import Firmware
from simulator.firmware.values import AttitudeSetpoint, Behaviour, MotionSetpoint, Result, Triple
from simulator.steps import STEP_S
from simulator.vehicle.plant import Plant


class Autopilot:
    """`step` moves it and its plant by STEP_S."""

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
        rules = firmware.missions
        self.mission = mission or Mission(
            firmware.origin,
            int(rules.home_first),
            rules.turning,
            rules.reached_above_landing,
            rules.keeps_speed,
        )
        self.senses = Senses(plant)
        self.watch = Watch(firmware, self.parameters)
        self.stream = SetpointStream(firmware, self.parameters)
        self.health = Health(
            firmware, self.parameters, self.mission, self.stream, self.watch, boot_scale
        )
        self.sticks = None if firmware.flight.sticks is None else Sticks(firmware.flight.sticks)
        self.guidance = Guidance(firmware, self.parameters, self.mission, self.sticks)
        self.navigator = Navigator(self.guidance)
        self.pilot = Pilot(firmware, self.parameters, self.navigator)
        self.commander = Commander(
            firmware, self.parameters, self.navigator, self.pilot, self.senses, self.health
        )

    # -- what comes in -----------------------------------------------------------------------

    def happen(self, event: str, wish: Wish = NOTHING) -> Result:
        """An event from outside."""
        return self.commander.happen(event, wish)

    def obey(self, message: str, values: Mapping[str, Any]) -> None:
        """A setpoint message, by its name in `simulator.autopilot.setpoints`, and its fields."""
        mode = self.commander.mode
        outlives = self.firmware.setpoints.outlive_modes
        if not (outlives or mode.behaviour is Behaviour.SETPOINT):
            return
        if message == ATTITUDE:
            self._fly(self.stream.attitude(values))
        elif outlives or mode.needs_position:
            home_down_m = self.guidance.home_ned_m[2]
            setpoint, said = self.stream.motion(message, values, self.senses.look(), home_down_m)
            self.commander.texts += () if said is None else (said,)
            self._fly(setpoint)

    def go_to(self, place_ned_m: Triple, yaw_rad: float) -> None:
        """Hold there, in a mode that holds or obeys; no number faces the way there."""
        self._end_takeoff()
        self.navigator.go_to(place_ned_m, yaw_rad)

    def _end_takeoff(self) -> None:
        """Of a mode that climbs before it obeys."""
        behaviour = self.commander.mode.behaviour
        if self.navigator.behaviour is not behaviour:
            self.pilot.enter(behaviour, self.senses.look())

    def _fly(self, setpoint: AttitudeSetpoint | MotionSetpoint | None) -> None:
        if setpoint is None:
            return
        self.stream.newest_s = self.senses.time_s
        self.navigator.follow(setpoint)
        self._end_takeoff()
        if isinstance(setpoint, AttitudeSetpoint) and setpoint.event:
            self.happen(setpoint.event)

    # -- time --------------------------------------------------------------------------------

    def step(self) -> None:
        """Fly STEP_S, then see what happened."""
        commander, pilot, senses = self.commander, self.pilot, self.senses
        was_landed = pilot.landed
        self.plant.advance(STEP_S, pilot.fly(senses.time_s, commander.armed, senses.look))
        senses.step()
        while (event := self.health.reach(senses.time_s)) is not None:
            commander.happen(event)
        if commander.failsafe or commander.mode.behaviour is Behaviour.SETPOINT:
            self._watch_stream()
        if commander.armed:
            self._watch_flight(was_landed)
        if senses.steps % EVERY_STEPS == 0:
            self._watch_surroundings()

    def _watch_stream(self) -> None:
        commander, alive = self.commander, self.stream.alive(self.senses.time_s)
        if commander.failsafe and alive:
            commander.happen("stream found")
        elif commander.armed and commander.mode.behaviour is Behaviour.SETPOINT and not alive:
            commander.happen("stream lost")

    def _watch_flight(self, was_landed: bool) -> None:
        commander, pilot, now_s = self.commander, self.pilot, self.senses.time_s
        airtime = commander.airtime
        event = airtime.step(now_s, was_landed=was_landed, landed=pilot.landed)
        if event is not None:
            commander.happen(event)
        for event in self.navigator.take_events():
            commander.happen(event)
        if not commander.armed:
            return
        event = airtime.over(now_s, landed=pilot.landed)
        if event is not None:
            commander.happen(event)

    def _watch_surroundings(self) -> None:
        senses = self.senses
        battery, armed = senses.truth.battery, self.commander.armed
        for event in self.watch.step(senses.time_s, armed, battery, senses.gps_healthy):
            self.commander.happen(event)
        self.commander.carry_out()
