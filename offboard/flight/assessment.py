"""From all that is known to the facts of one moment, and to the words that explain an end.

Reads view, session, plan and observer; changes none of them and decides nothing.
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
from offboard.flight.view import VehicleView
from offboard.mavlink.dialects.base import Takeoff
from offboard.mavlink.session import Session
from offboard.model.frames import thrust_direction_from_quaternion

LIFT_OFF_HEIGHT_M = 0.15
LIFT_OFF_CLIMB_MPS = 0.4
TAKE_OVER_HEIGHT_M = 1.0  # of an autopilot's own takeoff
MINIMUM_TELEMETRY_HZ = 10.0
FAILSAFE_STATUS = 5  # MAV_STATE_CRITICAL; 6 is an emergency


@dataclass(frozen=True, slots=True)
class Progress:
    """What the companion itself knows of the moment: where it is in the flight."""

    phase: Phase
    in_phase_s: float
    silence_s: float
    rebooted: bool
    stop_reason: str
    missed_decisions: int
    failure: str
    contradiction: str = ""
    excites: bool = False
    learnt: bool = False


class Assessment:
    """Facts about one flight, on demand."""

    def __init__(
        self,
        view: VehicleView,
        session: Session,
        plan: FlightPlan,
        observer: Observer,
        readiness: Readiness,
        limits: Limits,
    ) -> None:
        self._view = view
        self._session = session
        self._plan = plan
        self._observer = observer
        self._readiness = readiness
        self._limits = limits

    def facts(self, progress: Progress) -> Facts:
        """The facts for the guards."""
        view, plan, dialect = self._view, self._plan, self._session.dialect
        track, time_s = plan.track, view.time_s
        heartbeat = view.heartbeat
        return Facts(
            limits=self._limits,
            in_phase_s=progress.in_phase_s,
            silence_s=progress.silence_s,
            blind_s=max(view.position_age_s, view.attitude_age_s),
            found=view.found is not None,
            ready=not self.unready(),
            misconfigured=bool(self._complaints()),
            rebooted=progress.rebooted,
            engaged=dialect is not None and view.mode == dialect.engage_mode,
            landing=dialect is not None and view.mode == dialect.land_mode,
            failsafe=heartbeat is not None and heartbeat.system_status >= FAILSAFE_STATUS,
            armed=view.armed,
            in_the_air=view.in_the_air,
            lifted_off=progress.phase is Phase.TAKEOFF and self._lifted_off(),
            at_start=progress.phase is Phase.CLIMB and self._at_start(time_s),
            late_s=plan.late_s(time_s),
            lifted_by_command=self.lifted_by_command,
            excites=progress.excites,
            learnt=progress.learnt,
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

    def words(self, facts: Facts, progress: Progress) -> dict[str, object]:
        """The figures that a row's reason may quote."""
        dialect, view = self._session.dialect, self._view
        older = view.position_age_s >= view.attitude_age_s
        return {
            "mode": view.mode,
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
            "complaint": "; ".join(self._complaints()),
            "unready": self.unready(),
        }

    def unready(self) -> str:
        """Why the vehicle cannot be engaged yet; empty when it can."""
        view, session = self._view, self._session
        if not view.has_state or session.dialect is None:
            return "no LOCAL_POSITION_NED or no ATTITUDE_QUATERNION arrives"
        rates = session.rates_hz
        slow = [s for s in session.shortfalls if rates[s.name] < MINIMUM_TELEMETRY_HZ]
        for shortfall in slow:
            if shortfall.name in ("LOCAL_POSITION_NED", "ATTITUDE_QUATERNION"):
                return (
                    f"{shortfall.name} arrives at {shortfall.measured_hz:.1f} Hz, "
                    f"at least {MINIMUM_TELEMETRY_HZ:.0f} Hz are needed"
                )
        if view.armed and view.landed == "unknown":
            return "it is armed and does not say whether it flies (EXTENDED_SYS_STATE)"
        unanswered = self._readiness.unanswered(session.dialect, view.parameters)
        if unanswered:
            return f"it does not tell its parameter {', '.join(unanswered)}"
        if not self._readiness.settled(session.dialect, view.parameters, session.link_time_s):
            return "its parameters are still being read"
        if not (view.prearm_ok or view.armed):
            return "its pre-arm checks do not pass"
        return ""

    def _complaints(self) -> list[str]:
        dialect = self._session.dialect
        return [] if dialect is None else Readiness.complaints(dialect, self._view.parameters)

    def _tilt_rad(self) -> float:
        if self._view.attitude is None:
            return 0.0
        down = thrust_direction_from_quaternion(np.array(self._view.attitude.attitude))[2]
        return math.acos(min(1.0, max(-1.0, float(down))))

    @property
    def lifted_by_command(self) -> bool:
        """The autopilot takes off by itself, without setpoints."""
        dialect = self._session.dialect
        return dialect is not None and dialect.takeoff is Takeoff.COMMAND

    def _lifted_off(self) -> bool:
        position = self._view.position
        if position is None:
            return False
        height_m = self._plan.origin_ned_m[2] - position.position_ned_m[2]
        if self.lifted_by_command:
            return height_m > TAKE_OVER_HEIGHT_M
        return height_m > LIFT_OFF_HEIGHT_M or -position.velocity_ned_mps[2] > LIFT_OFF_CLIMB_MPS

    def position_error_m(self) -> float:
        """Distance of the reported position from the reference in force."""
        position = self._view.position
        sample = self._plan.sample(position.time_s) if position else None
        if position is None or sample is None:
            return 0.0
        return float(np.linalg.norm(np.array(position.position_ned_m) - sample.position_ned_m))

    def _at_start(self, time_s: float) -> bool:
        if self._view.position is None:
            return False
        state = self._observer.predict(time_s)
        position = np.array(self._view.position.position_ned_m)
        return self._plan.at_start(time_s, position, state.velocity_ned_mps)
