"""The facts of one moment and the questions that the phase table asks of them. No I/O, no state."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from offboard.flight.phases import Limits


@dataclass(frozen=True, slots=True)
class Facts:
    """All facts that a guard may look at, at one moment. SI; times in seconds, NaN where there
    is none yet."""

    limits: Limits
    in_phase_s: float  # vehicle time since the phase began, ours while that does not flow
    silence_s: float  # wall time since the vehicle was heard
    blind_s: float  # age of the older of position and attitude, vehicle time
    found: bool
    ready: bool  # telemetry flows, parameters were read, pre-arm checks pass
    misconfigured: bool
    rebooted: bool  # since it was first heard to flow
    engaged: bool
    landing: bool  # the vehicle shows its landing mode
    failsafe: bool  # the vehicle shows a failsafe or an emergency
    armed: bool
    in_the_air: bool  # by the vehicle's own account
    lifted_off: bool
    at_start: bool
    late_s: float  # since the start of the reference should have been reached
    track_time_s: float
    track_start_s: float
    track_end_s: float
    rest_time_s: float
    position_error_m: float
    tilt_rad: float
    stop_requested: bool
    missed_decisions: int  # one after the other
    contradicted: bool  # the vehicle file, by telemetry
    lifted_by_command: bool = False  # the autopilot takes off by itself, without setpoints
    excites: bool = False  # steps are wanted before the reference is joined
    learnt: bool = False  # what they showed is taken over


Guard = Callable[[Facts], bool]


def vehicle_found(now: Facts) -> bool:
    return now.found


def ready(now: Facts) -> bool:
    return now.ready


def misconfigured(now: Facts) -> bool:
    return now.misconfigured


def armed_by_another(now: Facts) -> bool:
    return now.armed and not now.limits.begin_armed


def rebooted(now: Facts) -> bool:
    return now.rebooted


def flown_by_another(now: Facts) -> bool:
    """In the mode that only a stream of setpoints holds, before we sent one."""
    return now.engaged and now.armed and not now.lifted_by_command


def streamed(now: Facts) -> bool:
    return now.in_phase_s >= now.limits.stream_s


def needs_no_stream(now: Facts) -> bool:
    return now.lifted_by_command


def engaged(now: Facts) -> bool:
    return now.engaged


def engaged_in_the_air(now: Facts) -> bool:
    return now.engaged and now.armed and now.in_the_air


def armed(now: Facts) -> bool:
    return now.armed and now.engaged


def lifted_off(now: Facts) -> bool:
    return now.lifted_off


def at_start(now: Facts) -> bool:
    return now.at_start


def too_late_at_start(now: Facts) -> bool:
    return now.late_s > now.limits.late_s


def at_start_to_excite(now: Facts) -> bool:
    return now.at_start and now.excites


def learnt(now: Facts) -> bool:
    return now.learnt


def at_full_speed(now: Facts) -> bool:
    return now.track_time_s >= now.track_start_s


def track_over(now: Facts) -> bool:
    return now.track_time_s >= now.track_end_s


def at_rest(now: Facts) -> bool:
    return now.track_time_s >= now.rest_time_s


def disarmed(now: Facts) -> bool:
    return not now.armed


def disarmed_for_good(now: Facts) -> bool:
    """Long enough for a heartbeat, 1 Hz, to contradict: an arming may have been under way."""
    return not now.armed and now.in_phase_s > 1.5


def mode_taken(now: Facts) -> bool:
    return not now.engaged


def taken_armed(now: Facts) -> bool:
    """A pilot took over just as it armed: whether it stays so is the pilot's to say."""
    return now.armed and not now.engaged


def landing_taken(now: Facts) -> bool:
    """A pilot took over; a failsafe that lands is left to finish."""
    return not (now.engaged or now.landing or now.failsafe)


def silent(now: Facts) -> bool:
    return now.silence_s > now.limits.silence_s


def lost(now: Facts) -> bool:
    return now.silence_s > 2.0 * now.limits.silence_s


def silent_on_ground(now: Facts) -> bool:
    return now.silence_s > now.limits.connect_s


def blind(now: Facts) -> bool:
    return now.blind_s > now.limits.blind_s


def stop_requested(now: Facts) -> bool:
    return now.stop_requested


def diverged(now: Facts) -> bool:
    return now.position_error_m > now.limits.position_error_m


def toppled(now: Facts) -> bool:
    return now.tilt_rad > now.limits.tilt_rad


def controller_failed(now: Facts) -> bool:
    return now.missed_decisions >= now.limits.missed_decisions


def contradicted(now: Facts) -> bool:
    return now.contradicted


def longer_than(limit: str) -> Guard:
    """A guard that holds when the phase has lasted longer than the named limit."""

    def too_long(now: Facts) -> bool:
        return now.in_phase_s > float(getattr(now.limits, limit))

    too_long.__name__ = f"longer_than_{limit}"
    return too_long
