"""What the vehicle does in each mode: behaviour and estimate in, demand on the attitude loop out.

Knows position, time and parameters; knows no modes by name, no rules and no MAVLink. Decisions
about modes are the autopilot's (`simulator.autopilot`).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

from simulator.firmware.base import (
    AttitudeSetpoint,
    Behaviour,
    Firmware,
    MotionSetpoint,
    Quaternion,
    Triple,
)
from simulator.mission import Mission
from simulator.parameters import ParameterTable
from simulator.plant import STEP_S, Demand
from simulator.position_loop import PositionLoop

LOOP_STEPS = 2  # the position loop runs at every second step, as PX4's does on its estimate
LOOP_S = LOOP_STEPS * STEP_S
CONTACT_S = 0.3  # on the ground, wanting down: then the motors idle
AIRBORNE_S = 0.1
_ARRIVED_M = 1.0
_STICK_LESS_THRUST = 0.08  # MPC_MANTHR_MIN
_TILT_BOOST_MAX = 10.0
_LOW_THRUST_SHARE = 0.6  # of hover: less cannot lift
_LIFTING = frozenset({Behaviour.TAKEOFF, Behaviour.SETPOINT, Behaviour.MISSION})
_STANDING = frozenset({Behaviour.HOLD, Behaviour.SETPOINT})
OFF = Demand()


@dataclass(frozen=True, slots=True)
class Nav:
    """The estimate as plain floats, and whether the feet touch the ground."""

    position_ned_m: Triple
    velocity_ned_mps: Triple
    attitude: Quaternion
    rates_frd_radps: Triple
    on_ground: bool
    reset_counter: int = 0

    @property
    def yaw_rad(self) -> float:
        w, x, y, z = self.attitude
        return math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))


class Pilot:
    """Flies one behaviour at a time. `landed` is its land detector's verdict."""

    def __init__(
        self, firmware: Firmware, parameters: ParameterTable, mission: Mission | None = None
    ) -> None:
        self._firmware = firmware
        self._parameters = parameters
        self.loop = PositionLoop(firmware.gains)
        self.mission = mission or Mission(firmware.origin)
        self.events = self.mission.events  # for the autopilot
        self.behaviour = Behaviour.HOLD
        self._hold: Triple = (0.0, 0.0, 0.0)
        self._held = MotionSetpoint(self._hold)
        self._takeoff_z_m = math.nan
        self._return_stage = 0
        self._demand = OFF
        self._source: AttitudeSetpoint | None = None
        self._attitude: Quaternion = (1.0, 0.0, 0.0, 0.0)
        self._next_loop_s = 0.0
        self._armed_for_s = 0.0
        self._climb_thrust = 0.0
        self._levelling: AttitudeSetpoint | None = None  # the last one of our own
        self._ground_s = self._air_s = 0.0
        self._ramp_s = 0.0
        self._wants_down = True
        self.home_ned_m: Triple = (0.0, 0.0, 0.0)
        self.landed = True
        self.climbed = False
        self.setpoint: AttitudeSetpoint | MotionSetpoint | None = None
        self.motion = MotionSetpoint()  # what the position loop was last asked for
        self.thrust_demanded = 0.0  # before it is raised for the tilt

    @property
    def target_height_m(self) -> float:
        """Of what it holds or climbs to, above home."""
        return self.home_ned_m[2] - self._hold[2]

    @property
    def demand(self) -> Demand:
        """The demand in force."""
        return self._demand

    def enter(self, behaviour: Behaviour, nav: Nav, takeoff_z_m: float = math.nan) -> None:
        """Begin a behaviour here; hold after a climb keeps the climb's target.

        `takeoff_z_m`: NED height to climb to; NaN the default one.
        """
        if not (self.climbed and behaviour in (Behaviour.HOLD, Behaviour.SETPOINT)):
            self._hold = _ahead(nav)
        self.behaviour = behaviour
        self._takeoff_z_m = takeoff_z_m
        self._return_stage = 0
        self.climbed = False
        self._next_loop_s = 0.0
        self._source = None
        self.loop.reset(nav.yaw_rad)
        if behaviour is Behaviour.MISSION:
            self.mission.begin(nav.position_ned_m, self.landed, self.home_ned_m)

    def arm(self, nav: Nav) -> None:
        """The motors begin to turn: home is here."""
        self.home_ned_m = nav.position_ned_m
        self._ramp_s = -self._firmware.spool_up_s
        self._armed_for_s = 0.0
        self._hold = nav.position_ned_m
        self._attitude = _level(nav.yaw_rad)
        self.loop.reset(nav.yaw_rad)

    def fly(self, time_s: float, armed: bool, look: Callable[[], Nav]) -> Demand:
        """The demand for the step that begins now. `look` gives the estimate when it is needed."""
        if not armed:
            self._demand, self._source, self.thrust_demanded = OFF, None, 0.0
            self.landed = self.landed or look().on_ground
            return OFF
        setpoint = self._attitude_setpoint
        if setpoint is not None:
            self._obey(setpoint, look)
        if time_s >= self._next_loop_s - 1e-6:
            self._next_loop_s = time_s + LOOP_S
            self._armed_for_s += LOOP_S
            nav = look()
            if self.behaviour is Behaviour.LEVEL:
                self._set(_level(self.loop.yaw_rad), None, _STICK_LESS_THRUST)
            elif setpoint is None:
                self._fly_motion(nav, time_s)
            elif setpoint.climb_mps is not None or self._boosts_thrust:
                self._fly_vertical(setpoint, nav)
            self._detect(nav)
        return self._demand

    def flies_itself(self, armed: bool, on_ground: bool) -> bool:
        """Whether `fly` will do no more than demand the attitude asked for, or run the position
        loop on an unchanged setpoint, until somebody speaks or the ground is touched."""
        if not armed:
            return self.landed and self._demand is OFF
        if self.landed or on_ground or self.climbed or self.events or self._ground_s:
            return False
        setpoint = self._attitude_setpoint
        if setpoint is None:
            return self.behaviour in _STANDING
        return setpoint.climb_mps is None and not self._boosts_thrust

    def next_loop_step(self, step: int, look: Callable[[], Nav], never: int) -> int:
        """When the position loop, told all it needs, is to be run in place of `fly`."""
        if self._demand is OFF:
            return never
        setpoint = self._attitude_setpoint
        if setpoint is not None:
            self._obey(setpoint, look)
            return never
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
            if not self._firmware.setpoint_decides_flight:
                self._air_s += LOOP_S
        if self._attitude_setpoint is None:
            attitude, thrust, wanted = self.loop.result
            self._attitude = attitude
            self._wants_down = not _wants_up(wanted, self.motion)
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
        lifting = self.behaviour in _LIFTING
        if self.landed and lifting and self._ramp_s < 0.0:
            self._hold = nav.position_ned_m
        motion = self._motion(nav, time_s)
        hover, cruise, up = self._limits
        self.motion = motion
        attitude, thrust, wanted = self.loop.step(
            LOOP_S,
            nav.position_ned_m,
            nav.velocity_ned_mps,
            motion,
            hover,
            speed_xy_mps=cruise,
            speed_up_mps=up,
            integrate=not nav.on_ground,
        )
        if self.landed:
            attitude, thrust = self._lift(lifting and _wants_up(wanted, motion), thrust, hover, nav)
        elif self._ground_s > CONTACT_S:
            attitude, thrust = _level(nav.yaw_rad), 0.0
        self._attitude = attitude
        self._wants_down = not _wants_up(wanted, motion)
        self.thrust_demanded = thrust
        self._set(attitude, None, thrust)

    @property
    def _limits(self) -> tuple[float, float, float]:
        """Hover thrust, and the speeds that the behaviour allows, across and upwards, m/s."""
        cruise, up = math.inf, math.inf
        if self.behaviour is not Behaviour.SETPOINT:
            cruise = self._parameters.role("cruise_speed_mps")
        if self.behaviour is Behaviour.MISSION:
            cruise = min(cruise, self.mission.speed_mps)
        if self.behaviour is Behaviour.TAKEOFF:
            up = self._parameters.role("takeoff_speed_mps")
        return self._parameters.role("hover_thrust"), cruise, up

    def _standing_motion(self) -> MotionSetpoint:
        """What is held or asked for, the same object as long as it is the same."""
        if self.behaviour is Behaviour.SETPOINT and isinstance(self.setpoint, MotionSetpoint):
            return self.setpoint
        if self._held.position_ned_m is not self._hold:
            self._held = MotionSetpoint(self._hold)
        return self._held

    def _lift(
        self, wants_up: bool, thrust: float, hover: float, nav: Nav
    ) -> tuple[Quaternion, float]:
        """On the ground: spool up, then ramp the thrust until the vehicle leaves it."""
        if self._ramp_s < 0.0 or wants_up:
            self._ramp_s += LOOP_S
        if self._ramp_s <= 0.0 or not wants_up:
            self.loop.reset(nav.yaw_rad)
            return _level(nav.yaw_rad), 0.0
        share = min(1.0, self._ramp_s / self._firmware.thrust_ramp_s)
        return _level(self.loop.yaw_rad), share * max(thrust, 1.2 * hover)

    def _motion(self, nav: Nav, time_s: float) -> MotionSetpoint:
        if self.behaviour is Behaviour.TAKEOFF:
            return self._takeoff(nav)
        if self.behaviour is Behaviour.RETURN:
            return self._return(nav)
        if self.behaviour is Behaviour.MISSION:
            return self._follow_mission(nav, time_s)
        if self.behaviour is Behaviour.LAND:
            return _sink(self._hold, self._land_speed(nav))
        if self.behaviour is Behaviour.DESCEND:
            return _sink(self._hold, self._firmware.descend_speed_mps)
        return self._standing_motion()

    def _takeoff(self, nav: Nav) -> MotionSetpoint:
        target_z = self._takeoff_z_m
        if math.isnan(target_z):
            target_z = nav.position_ned_m[2] - self._parameters.role("takeoff_height_m")
            self._takeoff_z_m = target_z
            self.events.append("default height")
        if nav.position_ned_m[2] < target_z + self._firmware.climbed_within_m:
            self.climbed = not self.landed
        self._hold = (self._hold[0], self._hold[1], target_z)
        return MotionSetpoint(self._hold)

    def _return(self, nav: Nav) -> MotionSetpoint:
        """Climb (lower the nearer home is, under a cone of 45 degrees), fly home, land."""
        home_x, home_y, home_z = self.home_ned_m
        x, y, z = nav.position_ned_m
        distance = math.hypot(x - home_x, y - home_y)
        if self._return_stage == 0:
            height = min(self._parameters.role("return_height_m"), distance)
            self._hold = (self._hold[0], self._hold[1], min(z, home_z - height))
            self._return_stage = 1
            self.events.append("return begun")
        if self._return_stage == 1 and z < self._hold[2] + _ARRIVED_M:
            self._hold = (home_x, home_y, self._hold[2])
            self._return_stage = 2
        if self._return_stage == 2 and distance < _ARRIVED_M:
            self._return_stage = 3
            self.events.append("return lands")
        if self._return_stage == 3:
            return _sink(self._hold, self._land_speed(nav))
        return MotionSetpoint(self._hold)

    def _follow_mission(self, nav: Nav, time_s: float) -> MotionSetpoint:
        motion = self.mission.fly(time_s, nav.position_ned_m, self.home_ned_m)
        if self.mission.landing:
            return _sink(motion.position_ned_m, self._land_speed(nav))
        return motion

    def _land_speed(self, nav: Nav) -> float:
        height_m = self.home_ned_m[2] - nav.position_ned_m[2]
        slow = self._parameters.role("land_speed_mps")
        fast = max(slow, self._parameters.role("descent_speed_mps"))
        slow_below_m, fast_above_m = self._firmware.landing_heights_m
        share = (height_m - slow_below_m) / (fast_above_m - slow_below_m)
        return slow + min(1.0, max(0.0, share)) * (fast - slow)

    # -- land detector -----------------------------------------------------------------------

    def _detect(self, nav: Nav) -> None:
        """Contact and the wish to go down make a landing; a moment without contact a takeoff."""
        setpoint = self._attitude_setpoint
        if setpoint is not None and self._firmware.setpoint_decides_flight:
            self._ground_s = 0.0
            pushed = self.thrust_demanded > 0.0
            self.landed = self.landed and not pushed
            return
        low = self._demand.thrust < _LOW_THRUST_SHARE * self._parameters.role("hover_thrust")
        if setpoint is None:
            low = low or self._wants_down
        self._ground_s = self._ground_s + LOOP_S if nav.on_ground and low else 0.0
        self._air_s = 0.0 if nav.on_ground else self._air_s + LOOP_S
        if not self.landed and self._ground_s >= self._firmware.landed_after_s:
            self.landed = True
            self._ramp_s = 0.0
        elif self.landed and self._air_s >= AIRBORNE_S:
            self.landed = False
            self.loop.reset(self.loop.yaw_rad)


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


def _sink(hold: Triple, speed_mps: float) -> MotionSetpoint:
    return MotionSetpoint((hold[0], hold[1], math.nan), (math.nan, math.nan, speed_mps))


def _wants_up(wanted: Triple, motion: MotionSetpoint) -> bool:
    if math.isnan(wanted[2]):
        return motion.acceleration_ned_mps2[2] < -0.1
    return wanted[2] < -0.1
