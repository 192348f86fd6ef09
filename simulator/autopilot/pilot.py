"""The pilot: flies what the navigator wants, or the attitude that is asked for.

Motion and estimate in, demand on the attitude loop out; takeoff and landing as the thrust has them.
Knows time and parameters; knows no modes by name, no rules and no MAVLink. Decisions about modes
are the commander's (`simulator.autopilot.commander`).
"""

from __future__ import annotations

import math
from collections.abc import Callable

from simulator.autopilot.behaviours import Control
from simulator.autopilot.land_detector import LandDetector
from simulator.autopilot.nav import Nav
from simulator.autopilot.navigator import Navigator, level
from simulator.autopilot.parameters import ParameterTable
from simulator.autopilot.position_loop import Limits, PositionLoop
from simulator.autopilot.takeoff import Takeoff
from simulator.firmware.base import Firmware
from simulator.firmware.values import (
    NAN3,
    AttitudeSetpoint,
    Behaviour,
    MotionSetpoint,
    Quaternion,
    Triple,
)
from simulator.steps import LOOP_S
from simulator.vehicle.attitude import Demand

_TILT_BOOST_MAX = 10.0
OFF = Demand()


class Pilot:
    """Flies one vehicle, from the motors' first turn to their last."""

    def __init__(
        self, firmware: Firmware, parameters: ParameterTable, navigator: Navigator
    ) -> None:
        self._firmware = firmware
        self._parameters = parameters
        self._navigator = navigator
        self._tuned = parameters.changes
        self.loop = PositionLoop(firmware.flight.gains(parameters.__getitem__))
        self._detector = LandDetector(firmware.flight.landing, parameters)
        self._takeoff = Takeoff(parameters)
        self.demand = OFF  # in force
        self.thrust_demanded = 0.0  # before it is raised for the tilt
        self.motion = MotionSetpoint()  # what the position loop was last asked for
        self._obeyed: AttitudeSetpoint | None = None
        self._attitude: Quaternion = (1.0, 0.0, 0.0, 0.0)
        self._next_loop_s = 0.0
        self._armed_for_s = 0.0
        self._climb_thrust = 0.0
        self._wanted_z_mps = 0.0

    @property
    def landed(self) -> bool:
        """The land detector's verdict."""
        return self._detector.landed

    def fall(self, on_ground: bool) -> None:
        """The vehicle as a reboot finds it."""
        self._detector.landed = on_ground

    def enter(self, behaviour: Behaviour, nav: Nav, takeoff_ned_m: Triple = NAN3) -> None:
        """Begin a behaviour here, as the navigator does."""
        self._navigator.enter(behaviour, nav, takeoff_ned_m)
        self._next_loop_s = 0.0
        self._obeyed = None
        self.loop.reset(nav.yaw_rad)

    def arm(self, nav: Nav) -> None:
        """The motors begin to turn: home is here."""
        self._navigator.arm(nav)
        self._takeoff.arm()
        if not self.landed:
            self._takeoff.fly()
        self._armed_for_s = 0.0
        self._attitude = level(nav.yaw_rad)
        self.loop.reset(nav.yaw_rad)

    def level_off(self, nav: Nav) -> None:
        """No setpoint arrives: level attitude, present yaw and height."""
        self._navigator.level_off(nav)
        self.loop.reset(nav.yaw_rad)

    def fly(self, time_s: float, armed: bool, look: Callable[[], Nav]) -> Demand:
        """The demand for the step that begins now. `look` gives the estimate when it is needed."""
        if not armed:
            self.demand, self._obeyed, self.thrust_demanded = OFF, None, 0.0
            if not self.landed and look().on_ground:
                self._detector.stand()
            return OFF
        setpoint = self._navigator.attitude_setpoint
        if setpoint is not None:
            self._obey(setpoint, look)
        if time_s >= self._next_loop_s - 1e-6:
            self._next_loop_s = time_s + LOOP_S
            self._armed_for_s += LOOP_S
            self._loop_once(setpoint, look(), time_s)
        return self.demand

    def _loop_once(self, setpoint: AttitudeSetpoint | None, nav: Nav, time_s: float) -> None:
        """One period of the position loop's."""
        self._tune()
        control = self._navigator.active.control
        if control is Control.LEVEL:
            thrust = self._parameters.role("stick_thrust_least")
            self._set(level(self.loop.yaw_rad), None, thrust)
        elif setpoint is not None:
            if setpoint.climb_mps is not None or self._boosts_thrust:
                self._fly_vertical(setpoint, nav)
        elif control is Control.MOTION:
            self._fly_motion(nav, time_s)
        self._detect(setpoint, nav)

    def _tune(self) -> None:
        if self._tuned != self._parameters.changes:
            self._tuned = self._parameters.changes
            self.loop.tune(self._firmware.flight.gains(self._parameters.__getitem__))

    @property
    def _boosts_thrust(self) -> bool:
        return self._parameters.role("tilt_boost") != 0.0

    def _obey(self, setpoint: AttitudeSetpoint, look: Callable[[], Nav]) -> None:
        if setpoint is self._obeyed:
            return
        if self._obeyed is None:
            self._climb_thrust = self.demand.thrust
        self._obeyed = setpoint
        if setpoint.attitude is not None:
            self._attitude = setpoint.attitude
        self._command(setpoint, look)

    def _command(self, setpoint: AttitudeSetpoint, look: Callable[[], Nav]) -> None:
        """Its attitude or rates, and its thrust as this firmware takes it."""
        thrust = setpoint.thrust if setpoint.climb_mps is None else self._climb_thrust
        if self._armed_for_s < self._firmware.setpoints.spool_s:
            thrust = 0.0
        self.thrust_demanded = thrust
        if self._boosts_thrust:
            thrust = min(1.0, thrust * _tilt_boost(look()))
        attitude = self._attitude if setpoint.rates_frd_radps is None else None
        self._set(attitude, setpoint.rates_frd_radps, thrust)

    def _fly_vertical(self, setpoint: AttitudeSetpoint, nav: Nav) -> None:
        """What of an attitude setpoint needs the estimate: the climb rate, the tilt."""
        if setpoint.climb_mps is not None:
            climb = MotionSetpoint(velocity_ned_mps=(math.nan, math.nan, -setpoint.climb_mps))
            limits = Limits(self._parameters.role("hover_thrust"))
            estimate = (nav.position_ned_m, nav.velocity_ned_mps)
            _, self._climb_thrust, _ = self.loop.step(
                climb, limits, *estimate, integrate=not nav.on_ground
            )
            if self.landed and setpoint.climb_mps <= 0.0:
                self._climb_thrust = 0.0
        self._command(setpoint, lambda: nav)

    def _set(self, attitude: Quaternion | None, rates: Triple | None, thrust: float) -> None:
        demand = Demand(True, thrust, attitude, rates)
        if demand != self.demand:
            self.demand = demand

    # -- motion ------------------------------------------------------------------------------

    def _fly_motion(self, nav: Nav, time_s: float) -> None:
        lifts = self._navigator.active.lifts_off
        if self.landed and self._takeoff.spooling and lifts:
            self._navigator.guidance.hold_ned_m = nav.position_ned_m
        waits = not (self._takeoff.flying or self._takeoff.lifting)
        self.motion = self._navigator.motion(nav, time_s, landed=self.landed, waits=waits)
        wants_up = lifts and self._asks_up(nav)
        self._takeoff.step(LOOP_S, wants_up)
        rises = self._takeoff.lifting
        still = nav.on_ground and (rises or self.landed)
        integrates = not still or (rises and self._firmware.flight.integrates_on_ramp)
        estimate = (nav.position_ned_m, nav.velocity_ned_mps)
        attitude, thrust, wanted = self.loop.step(
            self.motion, self._limits, *estimate, integrate=integrates
        )
        self._wanted_z_mps = wanted[2]
        if rises:
            attitude = level(self.loop.yaw_rad) if nav.on_ground else attitude
        elif self.landed:
            self.loop.reset(nav.yaw_rad)
            attitude, thrust = level(nav.yaw_rad), 0.0
        elif self._detector.contact:
            attitude, thrust = level(nav.yaw_rad), self._parameters.role("thrust_least")
        self._attitude = attitude
        self.thrust_demanded = thrust
        self._set(attitude, None, thrust)

    @property
    def _limits(self) -> Limits:
        """As the behaviour allows, and the takeoff."""
        role, navigator, gains = self._parameters.role, self._navigator, self.loop.gains
        up_mps = self._takeoff.speed_up_mps(gains.velocity_z[0])
        if navigator.active.climbing and not navigator.planned:
            up_mps = min(up_mps, role("takeoff_speed_mps"))
        turn_radps = self.motion.turn_radps
        if navigator.active.automatic:
            turn_radps = min(turn_radps, gains.turn_radps)
        return Limits(
            hover_thrust=role("hover_thrust"),
            thrust_least=0.0 if self._takeoff.lifting else role("thrust_least"),
            across_mps=math.inf if navigator.planned else navigator.cruise_mps,
            up_mps=up_mps,
            down_mps=gains.follows_down_mps if navigator.planned else gains.speed_down_mps,
            turn_radps=turn_radps,
            gently=navigator.active.automatic and not navigator.planned,
        )

    def _asks_up(self, nav: Nav) -> bool:
        """Something above is demanded: a height, a climb or an acceleration."""
        motion, navigator = self.motion, self._navigator
        if navigator.active.cannot_climb:
            return False
        if navigator.planned:
            return navigator.plans_up
        return (
            motion.position_ned_m[2] < nav.position_ned_m[2]
            or motion.velocity_ned_mps[2] < 0.0
            or motion.acceleration_ned_mps2[2] < 0.0
        )

    # -- land detector -----------------------------------------------------------------------

    def _detect(self, setpoint: AttitudeSetpoint | None, nav: Nav) -> None:
        was_landed = self.landed
        if setpoint is not None and self._firmware.setpoints.imply_flight:
            self._detector.rest()
            if self.thrust_demanded > 0.0:
                self._detector.lift_off()
        else:
            by_motion = setpoint is None
            sinks = by_motion and self._sinks
            self._detector.step(LOOP_S, nav, self.demand.thrust, by_motion=by_motion, sinks=sinks)
        if self.landed and not was_landed:
            self._takeoff.land()
        elif was_landed and not self.landed and not self._takeoff.lifting:
            self._takeoff.fly()

    @property
    def _sinks(self) -> bool:
        """It was told to go down; where a place below is as good as a speed, by that too."""
        landing = self._firmware.flight.landing
        told = self.motion.velocity_ned_mps[2] >= landing.sinking_mps
        return told or (landing.place_below_is_descent and self._wanted_z_mps > landing.sinking_mps)


def _tilt_boost(nav: Nav) -> float:
    """1 / cos(tilt) of the body."""
    _, x, y, _ = nav.attitude
    return 1.0 / max(1.0 - 2.0 * (x * x + y * y), 1.0 / _TILT_BOOST_MAX)
