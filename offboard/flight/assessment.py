"""Assessment: the facts of one moment for the guards, and the figures that explain a transition.

Reads state, session, plan and observer; changes none of them and decides nothing.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from offboard.estimation.observer import Observer
from offboard.flight.flight_plan import FlightPlan
from offboard.flight.guards import Facts
from offboard.flight.phases import Limits, Phase
from offboard.flight.readiness import Readiness
from offboard.flight.state import VehicleState
from offboard.mavlink.dialects.base import Takeoff
from offboard.mavlink.session import Session
from offboard.model.frames import thrust_direction_from_quaternion

LIFT_OFF_HEIGHT_M = 0.15
LIFT_OFF_CLIMB_MPS = 0.4
TAKE_OVER_HEIGHT_M = 1.0  # where setpoints replace the autopilot's own take-off
MINIMUM_TELEMETRY_HZ = 10.0
FAILSAFE_STATUS = 5  # MAV_STATE_CRITICAL; 6 is an emergency


@dataclass(frozen=True, slots=True)
class Progress:
    """What the companion knows about its own flight at one moment."""

    phase: Phase
    in_phase_s: float
    silence_s: float
    rebooted: bool
    stop_reason: str
    missed_decisions: int
    failure: str
    contradiction: str = ""
    excites: bool = False
    identified: bool = False


class Assessment:
    """Facts about one flight, on demand."""

    def __init__(
        self,
        state: VehicleState,
        session: Session,
        plan: FlightPlan,
        observer: Observer,
        readiness: Readiness,
        limits: Limits,
    ) -> None:
        self._state = state
        self._session = session
        self._plan = plan
        self._observer = observer
        self._readiness = readiness
        self._limits = limits

    def facts(self, progress: Progress) -> Facts:
        """The facts for the guards."""
        state, plan, dialect = self._state, self._plan, self._session.dialect
        track, time_s = plan.track, state.time_s
        heartbeat = state.heartbeat
        return Facts(
            limits=self._limits,
            in_phase_s=progress.in_phase_s,
            silence_s=progress.silence_s,
            blind_s=max(state.position_age_s, state.attitude_age_s),
            found=state.found is not None,
            ready=not self.not_ready(),
            misconfigured=bool(self._problems()),
            rebooted=progress.rebooted,
            engaged=dialect is not None and state.mode == dialect.engage_mode,
            landing=dialect is not None and state.mode == dialect.land_mode,
            failsafe=heartbeat is not None and heartbeat.system_status >= FAILSAFE_STATUS,
            armed=state.armed,
            in_the_air=state.in_the_air,
            lifted_off=progress.phase is Phase.TAKEOFF and self._lifted_off(),
            at_start=progress.phase is Phase.CLIMB and self._at_start(time_s),
            late_s=plan.late_s(time_s),
            lifted_by_command=self.lifted_by_command,
            excites=progress.excites,
            identified=progress.identified,
            track_time_s=plan.track_time_s(time_s),
            track_start_s=track.track_start_s,
            track_end_s=track.track_end_s,
            rest_time_s=track.duration_s + 0.5,
            position_error_m=self.position_error_m(),
            tilt_rad=self._tilt_rad(),
            stop_requested=bool(progress.stop_reason),
            missed_decisions=progress.missed_decisions,
            contradicted=bool(progress.contradiction),
        )

    def figures(self, facts: Facts, progress: Progress) -> dict[str, object]:
        """The values for the names in braces in the reasons of the phase table."""
        dialect, state = self._session.dialect, self._state
        older = state.position_age_s >= state.attitude_age_s
        return {
            "mode": state.mode,
            "mode_wanted": dialect.engage_mode if dialect else "offboard mode",
            "silence_s": facts.silence_s,
            "blind_s": facts.blind_s,
            "blind_to": "LOCAL_POSITION_NED" if older else "ATTITUDE_QUATERNION",
            "in_phase_s": facts.in_phase_s,
            "late_s": facts.late_s,
            "position_error_m": facts.position_error_m,
            "tilt_deg": math.degrees(facts.tilt_rad),
            "position_error_limit_m": self._limits.position_error_m,
            "stop": progress.stop_reason,
            "failure": progress.failure,
            "contradiction": progress.contradiction,
            "problems": "; ".join(self._problems()),
            "not_ready": self.not_ready(),
        }

    def not_ready(self) -> str:
        """Why the vehicle cannot be engaged yet; empty if it can."""
        state, session = self._state, self._session
        if not state.has_state or session.dialect is None:
            return "no LOCAL_POSITION_NED or no ATTITUDE_QUATERNION arrives"
        rates_hz = session.rates_hz
        for name in ("ATTITUDE_QUATERNION", "LOCAL_POSITION_NED"):
            if rates_hz[name] < MINIMUM_TELEMETRY_HZ:
                return (
                    f"{name} arrives at {rates_hz[name]:.1f} Hz, "
                    f"at least {MINIMUM_TELEMETRY_HZ:.0f} Hz are needed"
                )
        if state.armed and state.landed == "unknown":
            return "it is armed and does not report whether it flies (EXTENDED_SYS_STATE)"
        unanswered = self._readiness.unanswered(session.dialect, state.parameters)
        if unanswered:
            return f"no reply for parameter {', '.join(unanswered)}"
        if not self._readiness.complete(session.dialect, state.parameters, session.link_time_s):
            return "its parameters are still being read"
        if not (state.prearm_ok or state.armed):
            return "its pre-arm checks do not pass"
        return ""

    def _problems(self) -> list[str]:
        dialect = self._session.dialect
        return [] if dialect is None else Readiness.problems(dialect, self._state.parameters)

    def _tilt_rad(self) -> float:
        if self._state.attitude is None:
            return 0.0
        down = thrust_direction_from_quaternion(np.array(self._state.attitude.attitude))[2]
        return math.acos(min(1.0, max(-1.0, float(down))))

    @property
    def lifted_by_command(self) -> bool:
        """The autopilot takes off on a command, without setpoints."""
        dialect = self._session.dialect
        return dialect is not None and dialect.takeoff is Takeoff.COMMAND

    def _lifted_off(self) -> bool:
        position = self._state.position
        if position is None:
            return False
        height_m = self._plan.origin_ned_m[2] - position.position_ned_m[2]
        if self.lifted_by_command:
            return height_m > TAKE_OVER_HEIGHT_M
        return height_m > LIFT_OFF_HEIGHT_M or -position.velocity_ned_mps[2] > LIFT_OFF_CLIMB_MPS

    def position_error_m(self) -> float:
        """Distance of the reported position from the reference; 0 without a reference."""
        position = self._state.position
        sample = self._plan.sample(position.time_s) if position else None
        if position is None or sample is None:
            return 0.0
        return float(np.linalg.norm(np.array(position.position_ned_m) - sample.position_ned_m))

    def _at_start(self, time_s: float) -> bool:
        if self._state.position is None:
            return False
        velocity_ned_mps = self._observer.predict(time_s).velocity_ned_mps
        position = np.array(self._state.position.position_ned_m)
        return self._plan.at_start(time_s, position, velocity_ned_mps)
