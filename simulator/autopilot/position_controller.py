"""The position controller: flies the motion of the guidance or an attitude setpoint.

From motion and estimate it computes the demand on the attitude loop; it contains takeoff ramp and
land detector. Knows time and parameters; knows no modes by name, no state table and no MAVLink. The
commander (`simulator.autopilot.commander`) decides about modes.
"""

from __future__ import annotations

import math

from simulator.autopilot.ground import LandDetector, TakeoffRamp
from simulator.autopilot.guidance import Guidance
from simulator.autopilot.position_loop import Limits, PositionLoop, level
from simulator.autopilot.state import StateEstimate, VehicleState
from simulator.autopilot.values import NAN3, AttitudeSetpoint, Behaviour, MotionSetpoint, Triple
from simulator.steps import LOOP_S
from simulator.vehicle.attitude import Demand

_TILT_COSINE_MIN = 0.1  # limit of the tilt compensation: at most ten times the thrust
_HIGHER_M = 0.01  # a demanded place is above the vehicle if it is higher by this; less is noise
OFF = Demand()


class PositionController:
    """Flies one vehicle from arming to disarming."""

    def __init__(self, guidance: Guidance, state: VehicleState) -> None:
        firmware, parameters = guidance.firmware, guidance.parameters
        self._firmware, self._parameters = firmware, parameters
        self._guidance, self._state = guidance, state
        self.loop = PositionLoop(parameters)
        self.detector = LandDetector(parameters)
        self._ramp = TakeoffRamp(parameters)
        self.demand = OFF  # present demand on the attitude loop
        self.thrust_demanded = 0.0  # before the tilt compensation
        self.motion = MotionSetpoint()  # last motion flown
        self._setpoint: AttitudeSetpoint | None = None  # last attitude setpoint flown
        self._attitude = level(0.0)
        self._next_loop_s = 0.0
        self._armed_for_s = 0.0
        self._climb_thrust = 0.0  # thrust for an attitude setpoint with a climb rate
        self._velocity_down_mps = 0.0  # vertical setpoint of the velocity loop

    @property
    def landed(self) -> bool:
        """Whether the land detector considers the vehicle landed."""
        return self.detector.landed

    def enter(self, behaviour: Behaviour, place_ned_m: Triple = NAN3) -> None:
        """Begin a behaviour. `place_ned_m` is the place to which a takeoff climbs."""
        self._guidance.enter(behaviour, self._state.estimate, place_ned_m)
        self._next_loop_s = 0.0
        self.loop.reset(self._state.estimate.yaw_rad, integral=self._setpoint is not None)
        self._setpoint = None

    def arm(self) -> None:
        """Start the motors."""
        self._guidance.arm(self._state.estimate)
        self._ramp.arm()
        if not self.landed:
            self._ramp.skip()
        self._armed_for_s = 0.0
        self._attitude = level(self._state.estimate.yaw_rad)
        self.loop.reset(self._state.estimate.yaw_rad)

    def level_off(self) -> None:
        """Keep a level attitude, the yaw and the height, after attitude setpoints were lost."""
        self._guidance.level_off(self._state.estimate)
        self.loop.reset(self._state.estimate.yaw_rad)

    def step(self, armed: bool) -> Demand:
        """Return the demand for the step that begins now."""
        if not armed:
            self.demand, self._setpoint, self.thrust_demanded = OFF, None, 0.0
            if not self.landed and self._state.estimate.on_ground:
                self.detector.set_landed(True)
            return OFF
        setpoint = self._guidance.setpoint
        if not isinstance(setpoint, AttitudeSetpoint):
            setpoint = None
        elif setpoint is not self._setpoint:
            self._take(setpoint)
        if self._state.time_s >= self._next_loop_s - 1e-6:
            self._next_loop_s = self._state.time_s + LOOP_S
            self._armed_for_s += LOOP_S
            self._run_loop(setpoint, self._state.estimate)
        return self.demand

    def _run_loop(self, setpoint: AttitudeSetpoint | None, estimate: StateEstimate) -> None:
        """Run one period of the position loop."""
        behaviour = self._guidance.behaviour
        if behaviour is Behaviour.LEVEL:
            thrust = self._parameters.role("stick_thrust_least")
            self._demand(Demand(True, thrust, level(self.loop.yaw_rad)))
        elif setpoint is not None:
            if setpoint.climb_mps is not None:
                self._control_climb(setpoint.climb_mps, estimate)
            if setpoint.climb_mps is not None or self._boosts_thrust:
                self._fly_attitude(setpoint)
        elif behaviour is not Behaviour.COAST:
            self._fly_motion(estimate)
        self._detect_landing(setpoint, estimate)
        if self.landed:
            self.loop.forget_hover_thrust()
        else:
            self.loop.estimate_hover_thrust(self.demand.thrust * estimate.tilt_cosine, estimate)

    def _demand(self, demand: Demand) -> None:
        """Set the demand. Keep an equal object, which the plant then need not encode again."""
        if demand != self.demand:
            self.demand = demand

    # -- attitude setpoints ------------------------------------------------------------------

    @property
    def _boosts_thrust(self) -> bool:
        return self._parameters.role("tilt_boost") != 0.0

    def _take(self, setpoint: AttitudeSetpoint) -> None:
        """Fly a new attitude setpoint at once, not only in the next period of the loop."""
        if self._setpoint is None:
            self._climb_thrust = self.demand.thrust
        self._setpoint = setpoint
        if setpoint.attitude is not None:
            self._attitude = setpoint.attitude
        self._fly_attitude(setpoint)

    def _fly_attitude(self, setpoint: AttitudeSetpoint) -> None:
        """Demand the attitude or rates of a setpoint and its thrust, divided by the cosine of the
        tilt where the firmware does so (ATC_ANGLE_BOOST)."""
        thrust = setpoint.thrust if setpoint.climb_mps is None else self._climb_thrust
        if self._armed_for_s < self._parameters.role("setpoint_spool_s"):
            thrust = 0.0
        self.thrust_demanded = thrust
        if self._boosts_thrust:
            tilt_cosine = max(self._state.estimate.tilt_cosine, _TILT_COSINE_MIN)
            thrust = min(1.0, thrust * (1.0 / tilt_cosine))
        attitude = self._attitude if setpoint.rates_frd_radps is None else None
        self._demand(Demand(True, thrust, attitude, setpoint.rates_frd_radps))

    def _control_climb(self, climb_mps: float, estimate: StateEstimate) -> None:
        """Compute the thrust for a climb rate with the position loop."""
        motion = MotionSetpoint(velocity_ned_mps=(math.nan, math.nan, -climb_mps))
        integrate = not estimate.on_ground
        _, self._climb_thrust, _ = self.loop.step(motion, Limits(), estimate, integrate=integrate)
        if self.landed and climb_mps <= 0.0:
            self._climb_thrust = 0.0

    # -- motion ------------------------------------------------------------------------------

    def _fly_motion(self, estimate: StateEstimate) -> None:
        guidance, ramp = self._guidance, self._ramp
        lifts_off = guidance.active.lifts_off
        if self.landed and ramp.spooling and lifts_off:
            guidance.hold = MotionSetpoint(estimate.position_ned_m)
        self.motion = guidance.motion(estimate, landed=self.landed)
        climb_demanded = lifts_off and self._climb_demanded(estimate)
        ramp.step(climb_demanded=climb_demanded, landed=self.landed)
        still = estimate.on_ground and (ramp.lifting or self.landed)
        on_ramp = ramp.lifting and (self._firmware.integrates_on_ramp or ramp.ramp_ended)
        attitude, thrust, velocity_ned_mps = self.loop.step(
            self.motion, self._limits, estimate, integrate=not still or on_ramp
        )
        self._velocity_down_mps = velocity_ned_mps[2]
        if ramp.lifting:
            attitude = level(self.loop.yaw_rad) if estimate.on_ground else attitude
        elif self.landed:
            self.loop.reset(estimate.yaw_rad)
            attitude, thrust = level(estimate.yaw_rad), 0.0
        elif self.detector.contact:
            attitude, thrust = level(estimate.yaw_rad), self._parameters.role("thrust_least")
        self._attitude = attitude
        self.thrust_demanded = thrust * (estimate.tilt_cosine if self._boosts_thrust else 1.0)
        self._demand(Demand(True, thrust, attitude))

    @property
    def _limits(self) -> Limits:
        """Limits of the motion, from behaviour and takeoff ramp."""
        role, guidance = self._parameters.role, self._guidance
        automatic = guidance.active.automatic
        up_mps = self._ramp.climb_limit_mps()
        if guidance.active.climbing:
            up_mps = min(up_mps, role("takeoff_speed_mps"))
        turn_radps = self.motion.turn_radps
        return Limits(
            thrust_least=0.0 if self._ramp.lifting else role("thrust_least"),
            across_mps=guidance.speed_limit_mps,
            up_mps=up_mps,
            turn_radps=min(turn_radps, role("turn_radps")) if automatic else turn_radps,
            smooth=automatic,
        )

    def _climb_demanded(self, estimate: StateEstimate) -> bool:
        """Whether a higher place, a climb or an upward acceleration is demanded."""
        motion, guidance = self.motion, self._guidance
        if guidance.active.cannot_climb:
            return False
        return (
            motion.position_ned_m[2] < estimate.position_ned_m[2] - _HIGHER_M
            or motion.velocity_ned_mps[2] < 0.0
            or motion.acceleration_ned_mps2[2] < 0.0
        )

    # -- land detector -----------------------------------------------------------------------

    def _detect_landing(self, setpoint: AttitudeSetpoint | None, estimate: StateEstimate) -> None:
        was_landed, by_motion = self.landed, setpoint is None
        if not by_motion and self._firmware.ardupilot_setpoints:
            self.detector.reset()
            if self.thrust_demanded > 0.0:
                self.detector.set_landed(False)
        else:
            descends = by_motion and self._descent_demanded
            self.detector.step(estimate, self.demand.thrust, by_motion=by_motion, descends=descends)
        if self.landed and not was_landed:
            self._ramp.land()
        elif was_landed and not self.landed and not self._ramp.lifting:
            self._ramp.skip()

    @property
    def _descent_demanded(self) -> bool:
        """Whether a descent is demanded, or (`Firmware.place_below_is_descent`) a place below."""
        sinking_mps = self._parameters.role("sinking_mps")
        if self.motion.velocity_ned_mps[2] >= sinking_mps:
            return True
        return self._firmware.place_below_is_descent and self._velocity_down_mps > sinking_mps
