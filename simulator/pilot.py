"""What the vehicle does in each mode: behaviour and estimate in, demand on the attitude loop out.

Knows position, time and parameters; knows no modes by name, no rules and no MAVLink. Decisions
about modes are the autopilot's (`simulator.autopilot`).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

from simulator.descent import Return, land_speed_mps, sink
from simulator.firmware.base import (
    AttitudeSetpoint,
    Behaviour,
    Firmware,
    MotionSetpoint,
    Quaternion,
    Triple,
)
from simulator.land_detector import LandDetector
from simulator.mission import Mission
from simulator.nav import Nav
from simulator.parameters import ParameterTable
from simulator.plant import STEP_S, Demand
from simulator.position_loop import PositionLoop
from simulator.takeoff import Takeoff

LOOP_STEPS = 2  # the position loop runs at every second step, as PX4's does on its estimate
LOOP_S = LOOP_STEPS * STEP_S
_TILT_BOOST_MAX = 10.0
_LIFTING = frozenset({Behaviour.TAKEOFF, Behaviour.SETPOINT, Behaviour.MISSION})
_STANDING = frozenset({Behaviour.HOLD, Behaviour.SETPOINT})
OFF = Demand()


class Pilot:
    """Flies one behaviour at a time."""

    def __init__(
        self, firmware: Firmware, parameters: ParameterTable, mission: Mission | None = None
    ) -> None:
        self._firmware = firmware
        self._parameters = parameters
        self._tuned = parameters.changes
        self.loop = PositionLoop(firmware.gains(parameters.__getitem__))
        self._detector = LandDetector(firmware.landing, parameters)
        self._takeoff = Takeoff(parameters)
        self.mission = mission or Mission(firmware.origin, firmware.mission_first)
        self.events = self.mission.events  # for the autopilot
        self.behaviour = Behaviour.HOLD
        self._return = Return(firmware, parameters, self.events)
        self._hold: Triple = (0.0, 0.0, 0.0)
        self._held = MotionSetpoint(self._hold)
        self._takeoff_z_m = math.nan
        self._demand = OFF
        self._source: AttitudeSetpoint | None = None
        self._attitude: Quaternion = (1.0, 0.0, 0.0, 0.0)
        self._next_loop_s = 0.0
        self._armed_for_s = 0.0
        self._climb_thrust = 0.0
        self._levelling: AttitudeSetpoint | None = None  # the last one of our own
        self._wanted_z_mps = 0.0
        self.home_ned_m: Triple = (0.0, 0.0, 0.0)
        self.home_yaw_rad = 0.0
        self.cruise_mps = math.inf  # asked for, in automatic flight
        self.climbed = False
        self.setpoint: AttitudeSetpoint | MotionSetpoint | None = None
        self.motion = MotionSetpoint()  # what the position loop was last asked for
        self.thrust_demanded = 0.0  # before it is raised for the tilt

    @property
    def landed(self) -> bool:
        """The land detector's verdict."""
        return self._detector.landed

    @property
    def landing(self) -> bool:
        """On the last way down."""
        return self.behaviour is Behaviour.LAND or (
            self._return.landing
            if self.behaviour is Behaviour.RETURN
            else self.behaviour is Behaviour.MISSION and self.mission.landing
        )

    @property
    def climbing(self) -> bool:
        """Taking off, by itself."""
        by_mission = self.behaviour is Behaviour.MISSION and self.mission.climbing
        return by_mission or self.behaviour is Behaviour.TAKEOFF

    @property
    def target_height_m(self) -> float:
        """Of what it holds or climbs to, above home."""
        place = self._return.place if self.behaviour is Behaviour.RETURN else self._hold
        return self.home_ned_m[2] - place[2]

    @property
    def demand(self) -> Demand:
        """The demand in force."""
        return self._demand

    def tell(self) -> list[str]:
        """The events since it was last asked."""
        told = [*(("climbed",) if self.climbed else ()), *self.events]
        self.events.clear()
        return told

    def fall(self, on_ground: bool) -> None:
        """The vehicle as a reboot finds it."""
        self._detector.landed = on_ground

    def enter(self, behaviour: Behaviour, nav: Nav, takeoff_z_m: float = math.nan) -> None:
        """Begin a behaviour here; hold after a climb keeps the climb's target.

        `takeoff_z_m`: NED height to climb to; NaN the default one.
        """
        if not (self.climbed and behaviour in (Behaviour.HOLD, Behaviour.SETPOINT)):
            self._hold = _ahead(nav)
        if behaviour is not self.behaviour:
            self.cruise_mps = math.inf
        self.behaviour = behaviour
        self._takeoff_z_m = takeoff_z_m
        self._return = Return(self._firmware, self._parameters, self.events)
        self.climbed = False
        self._next_loop_s = 0.0
        self._source = None
        self.loop.reset(nav.yaw_rad)
        self.mission.pause()

    def go_to(self, place_ned_m: Triple, yaw_rad: float) -> None:
        """Hold there, in a mode that holds or obeys; no number keeps the course."""
        self._hold = place_ned_m
        self._held = MotionSetpoint(place_ned_m, yaw_rad=yaw_rad, faces_way=True)
        if self.behaviour is Behaviour.SETPOINT:
            self.setpoint = self._held

    def turn_to(self, yaw_rad: float, turn_radps: float) -> None:
        """Keep this course while holding or obeying."""
        self._held = MotionSetpoint(self._hold, yaw_rad=yaw_rad, turn_radps=turn_radps)
        if isinstance(self.setpoint, MotionSetpoint):
            self.setpoint = replace(self.setpoint, yaw_rad=yaw_rad, turn_radps=turn_radps)

    def arm(self, nav: Nav) -> None:
        """The motors begin to turn: home is here."""
        self.home_ned_m, self.home_yaw_rad = nav.position_ned_m, nav.yaw_rad
        self._takeoff.arm()
        self.mission.pause()
        if not self.landed:
            self._takeoff.fly()
        self._armed_for_s = 0.0
        self._hold = nav.position_ned_m
        self._attitude = _level(nav.yaw_rad)
        self.loop.reset(nav.yaw_rad)

    def fly(self, time_s: float, armed: bool, look: Callable[[], Nav]) -> Demand:
        """The demand for the step that begins now. `look` gives the estimate when it is needed."""
        if not armed:
            self._demand, self._source, self.thrust_demanded = OFF, None, 0.0
            if not self.landed and look().on_ground:
                self._detector.stand()
            return OFF
        setpoint = self._attitude_setpoint
        if setpoint is not None:
            self._obey(setpoint, look)
        if time_s >= self._next_loop_s - 1e-6:
            self._next_loop_s = time_s + LOOP_S
            self._armed_for_s += LOOP_S
            self._loop_once(setpoint, look(), time_s)
        return self._demand

    def _loop_once(self, setpoint: AttitudeSetpoint | None, nav: Nav, time_s: float) -> None:
        """One period of the position loop's."""
        self._tune()
        if self.behaviour is Behaviour.LEVEL:
            thrust = self._parameters.role("stick_thrust_least")
            self._set(_level(self.loop.yaw_rad), None, thrust)
        elif setpoint is not None:
            if setpoint.climb_mps is not None or self._boosts_thrust:
                self._fly_vertical(setpoint, nav)
        elif self.behaviour is not Behaviour.COAST:
            self._fly_motion(nav, time_s)
        self._detect(setpoint, nav)

    def _tune(self) -> None:
        if self._tuned != self._parameters.changes:
            self._tuned = self._parameters.changes
            self.loop.tune(self._firmware.gains(self._parameters.__getitem__))

    def flies_itself(self, step: int, armed: bool, on_ground: bool) -> bool:
        """Whether `fly` will from this step on do no more than demand the attitude asked for, or
        run the position loop on one setpoint, until somebody speaks or the ground is touched."""
        if not armed:
            return self.landed and self._demand is OFF
        if self.landed or on_ground or self.climbed or self.events or not self._takeoff.flying:
            return False
        setpoint = self._attitude_setpoint
        if setpoint is None:
            known = self.motion is self._standing_motion() or self._loop_step(step) == step
            return known and self.behaviour in _STANDING
        return setpoint.climb_mps is None and not self._boosts_thrust

    def next_loop_step(self, step: int, look: Callable[[], Nav], never: int) -> int:
        """When the position loop, told all it needs, is to be run in place of `fly`."""
        if self._demand is OFF:
            return never
        setpoint = self._attitude_setpoint
        if setpoint is not None:
            self._obey(setpoint, look)
            return never
        self._tune()
        self.motion = self._standing_motion()
        self.loop.demand(LOOP_S, self.motion, *self._limits)
        self.loop.record["integrates"] = True
        return self._loop_step(step)

    def _loop_step(self, step: int) -> int:
        """The first step from this one on at which `fly` does more than repeat its demand."""
        return max(step, math.ceil((self._next_loop_s - 1e-6) / STEP_S))

    def flown(self, first_step: int, count: int) -> None:
        """Keep up with steps in which `fly` was not asked, as `flies_itself` allows."""
        loop_step = self._loop_step(first_step)
        if self._demand is OFF or loop_step >= first_step + count:
            return
        loops = (first_step + count - 1 - loop_step) // LOOP_STEPS + 1
        self._next_loop_s = (loop_step + LOOP_STEPS * (loops - 1)) * STEP_S + LOOP_S
        for _ in range(loops):
            self._armed_for_s += LOOP_S
        self._detector.rest()
        if self._attitude_setpoint is None:
            attitude, thrust, wanted = self.loop.result
            self._attitude = attitude
            self._wanted_z_mps = wanted[2]
            self.thrust_demanded = thrust
            self._set(attitude, None, thrust)

    def level(self, nav: Nav) -> None:
        """Nobody says what to do: level, course and height as they are."""
        self._levelling = AttitudeSetpoint(_level(nav.yaw_rad), None, 0.0, climb_mps=0.0)
        self.setpoint = self._levelling
        self.loop.reset(nav.yaw_rad)

    @property
    def obeys_attitude(self) -> bool:
        """Somebody else's attitude setpoint is flown."""
        setpoint = self._attitude_setpoint
        return setpoint is not None and setpoint is not self._levelling

    @property
    def obeys_motion(self) -> bool:
        """Somebody else's position, velocity or acceleration is flown."""
        return self.behaviour is Behaviour.SETPOINT and isinstance(self.setpoint, MotionSetpoint)

    @property
    def obeys_velocity(self) -> bool:
        """The same, but somebody must go on saying so."""
        if not (self.obeys_motion and isinstance(self.setpoint, MotionSetpoint)):
            return False
        rates = (*self.setpoint.velocity_ned_mps, *self.setpoint.acceleration_ned_mps2)
        return not all(map(math.isnan, rates))

    @property
    def _attitude_setpoint(self) -> AttitudeSetpoint | None:
        if self.behaviour is Behaviour.SETPOINT and isinstance(self.setpoint, AttitudeSetpoint):
            return self.setpoint
        return None

    @property
    def _boosts_thrust(self) -> bool:
        return self._parameters.role("tilt_boost") != 0.0

    def _obey(self, setpoint: AttitudeSetpoint, look: Callable[[], Nav]) -> None:
        if setpoint is self._source:
            return
        if self._source is None:
            self._climb_thrust = self._demand.thrust
        self._source = setpoint
        if setpoint.attitude is not None:
            self._attitude = setpoint.attitude
        self._command(setpoint, look)

    def _command(self, setpoint: AttitudeSetpoint, look: Callable[[], Nav]) -> None:
        """Its attitude or rates, and its thrust as this firmware takes it."""
        thrust = setpoint.thrust if setpoint.climb_mps is None else self._climb_thrust
        if self._armed_for_s < self._firmware.setpoint_spool_s:
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
            _, self._climb_thrust, _ = self.loop.step(
                LOOP_S,
                nav.position_ned_m,
                nav.velocity_ned_mps,
                climb,
                self._parameters.role("hover_thrust"),
                integrate=not nav.on_ground,
            )
            if self.landed and setpoint.climb_mps <= 0.0:
                self._climb_thrust = 0.0
        self._command(setpoint, lambda: nav)

    def _set(self, attitude: Quaternion | None, rates: Triple | None, thrust: float) -> None:
        demand = Demand(True, thrust, attitude, rates)
        if demand != self._demand:
            self._demand = demand

    # -- motion ------------------------------------------------------------------------------

    def _fly_motion(self, nav: Nav, time_s: float) -> None:
        lifts = self.behaviour in _LIFTING
        if self.landed and self._takeoff.spooling and lifts:
            self._hold = nav.position_ned_m
        self.motion = self._motion(nav, time_s)
        wants_up = lifts and self._asks_up(nav)
        self._takeoff.step(LOOP_S, wants_up)
        rises = self._takeoff.lifting
        hover, cruise_mps, climb_mps, least, turn_radps = self._limits
        attitude, thrust, wanted = self.loop.step(
            LOOP_S,
            nav.position_ned_m,
            nav.velocity_ned_mps,
            self.motion,
            hover,
            speed_xy_mps=cruise_mps,
            speed_up_mps=climb_mps,
            thrust_least=least,
            turn_radps=turn_radps,
            integrate=not (nav.on_ground and (rises or self.landed)),
        )
        self._wanted_z_mps = wanted[2]
        if rises:
            attitude = _level(self.loop.yaw_rad) if nav.on_ground else attitude
        elif self.landed:
            self.loop.reset(nav.yaw_rad)
            attitude, thrust = _level(nav.yaw_rad), 0.0
        elif self._detector.contact:
            attitude, thrust = _level(nav.yaw_rad), self._parameters.role("thrust_least")
        self._attitude = attitude
        self.thrust_demanded = thrust
        self._set(attitude, None, thrust)

    @property
    def _limits(self) -> tuple[float, float, float, float, float]:
        """Hover thrust, the speeds that the behaviour allows, across and upwards, m/s, the least
        thrust and the fastest turn, rad/s."""
        role = self._parameters.role
        across_mps, up_mps = math.inf, self._takeoff.speed_up_mps(self.loop.velocity_p_ps)
        turn_radps = self.motion.turn_radps
        by_setpoint = self.behaviour is Behaviour.SETPOINT
        if not by_setpoint or self._firmware.setpoints_as_automatic:
            across_mps = role("cruise_speed_mps")
            turn_radps = min(turn_radps, self.loop.gains.turn_radps)
        if not math.isinf(across_mps) or self.setpoint is self._held:
            across_mps = min(across_mps, self.cruise_mps)
        if self.behaviour is Behaviour.MISSION:
            across_mps = min(across_mps, self.mission.speed_mps)
        if self.climbing:
            up_mps = min(up_mps, role("takeoff_speed_mps"))
        least = 0.0 if self._takeoff.lifting else role("thrust_least")
        return role("hover_thrust"), across_mps, up_mps, least, turn_radps

    def _standing_motion(self) -> MotionSetpoint:
        """What is held or asked for, the same object as long as it is the same."""
        if self.behaviour is Behaviour.SETPOINT and isinstance(self.setpoint, MotionSetpoint):
            return self.setpoint
        if self._held.position_ned_m is not self._hold:
            self._held = MotionSetpoint(self._hold)
        return self._held

    def _asks_up(self, nav: Nav) -> bool:
        """Something above is demanded: a height, a climb or an acceleration."""
        motion = self.motion
        return (
            motion.position_ned_m[2] < nav.position_ned_m[2]
            or motion.velocity_ned_mps[2] < 0.0
            or motion.acceleration_ned_mps2[2] < 0.0
        )

    def _motion(self, nav: Nav, time_s: float) -> MotionSetpoint:
        if self.behaviour is Behaviour.TAKEOFF:
            return self._climb(nav)
        if self.behaviour is Behaviour.RETURN:
            return self._return.fly(time_s, nav, self.home_ned_m, self.home_yaw_rad)
        if self.behaviour is Behaviour.MISSION:
            return self._follow_mission(nav, time_s)
        if self.behaviour is Behaviour.LAND:
            return sink(self._hold, land_speed_mps(nav, self.home_ned_m[2], self._parameters))
        if self.behaviour is Behaviour.DESCEND:
            return sink(self._hold, self._firmware.descend_speed_mps)
        return self._standing_motion()

    def _climb(self, nav: Nav) -> MotionSetpoint:
        target_z = self._takeoff_z_m
        if math.isnan(target_z):
            target_z = nav.position_ned_m[2] - self._parameters.role("takeoff_height_m")
            self._takeoff_z_m = target_z
            self.events.append("default height")
        if nav.position_ned_m[2] < target_z + self._parameters.role("climbed_within_m"):
            self.climbed = not self.landed
        self._hold = (self._hold[0], self._hold[1], target_z)
        return MotionSetpoint(self._hold)

    def _follow_mission(self, nav: Nav, time_s: float) -> MotionSetpoint:
        motion = self.mission.fly(time_s, nav.position_ned_m, self.home_ned_m, landed=self.landed)
        if self.mission.landing:
            speed_mps = land_speed_mps(nav, self.home_ned_m[2], self._parameters)
            return sink(motion.position_ned_m, speed_mps)
        return motion

    # -- land detector -----------------------------------------------------------------------

    def _detect(self, setpoint: AttitudeSetpoint | None, nav: Nav) -> None:
        was_landed = self.landed
        if setpoint is not None and self._firmware.setpoint_decides_flight:
            self._detector.rest()
            if self.thrust_demanded > 0.0:
                self._detector.lift_off()
        else:
            by_motion = setpoint is None
            sinks = by_motion and self._sinks
            self._detector.step(LOOP_S, nav, self._demand.thrust, by_motion=by_motion, sinks=sinks)
        if self.landed and not was_landed:
            self._takeoff.land()
        elif was_landed and not self.landed and not self._takeoff.lifting:
            self._takeoff.fly()

    @property
    def _sinks(self) -> bool:
        """It was told to go down; where a place below is as good as a speed, by that too."""
        landing = self._firmware.landing
        told = self.motion.velocity_ned_mps[2] >= landing.sinking_mps
        return told or (landing.place_below_is_descent and self._wanted_z_mps > landing.sinking_mps)


def _level(yaw_rad: float) -> Quaternion:
    return (math.cos(0.5 * yaw_rad), 0.0, 0.0, math.sin(0.5 * yaw_rad))


def _tilt_boost(nav: Nav) -> float:
    """1 / cos(tilt) of the body."""
    _, x, y, _ = nav.attitude
    return 1.0 / max(1.0 - 2.0 * (x * x + y * y), 1.0 / _TILT_BOOST_MAX)


def _ahead(nav: Nav) -> Triple:
    """Where a vehicle comes to rest that brakes gently from here."""
    (x, y, z), (vx, vy, vz) = nav.position_ned_m, nav.velocity_ned_mps
    return (x + 0.5 * vx, y + 0.5 * vy, z + 0.2 * vz)
