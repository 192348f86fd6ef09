"""Guards: the facts at one moment, and the conditions of the transitions. No I/O, no state."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from offboard.flight.phases import Limits


@dataclass(frozen=True, slots=True)
class Facts:
    """All that a guard may use. SI; NaN for what is not known yet."""

    limits: Limits
    in_phase_s: float  # since the phase began, on Session.link_time_s
    silence_s: float  # wall time since the last telemetry
    blind_s: float  # age of the older of position and attitude, vehicle time
    found: bool
    ready: bool  # telemetry flows, parameters were read, pre-arm checks pass
    misconfigured: bool
    rebooted: bool  # after its telemetry was complete
    engaged: bool  # the vehicle shows the mode in which it follows our setpoints
    landing: bool  # the vehicle shows its landing mode
    failsafe: bool  # the vehicle shows a failsafe or an emergency
    armed: bool
    in_the_air: bool  # as the vehicle reports
    lifted_off: bool
    at_start: bool
    late_s: float  # since the planned end of the climb
    track_time_s: float
    track_start_s: float
    track_end_s: float
    rest_time_s: float
    position_error_m: float
    tilt_rad: float
    stop_requested: bool
    missed_decisions: int  # in a row
    contradicted: bool  # telemetry contradicts the vehicle file
    lifted_by_command: bool = False  # the autopilot takes off on a command, without setpoints
    excites: bool = False  # identification steps are flown before the track
    identified: bool = False  # and their result is in use


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
    """Armed and in the mode of setpoints, before we sent one."""
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


def identified(now: Facts) -> bool:
    return now.identified


def at_full_speed(now: Facts) -> bool:
    return now.track_time_s >= now.track_start_s


def track_over(now: Facts) -> bool:
    return now.track_time_s >= now.track_end_s


def at_rest(now: Facts) -> bool:
    return now.track_time_s >= now.rest_time_s


def disarmed(now: Facts) -> bool:
    return not now.armed


def disarmed_for_good(now: Facts) -> bool:
    """Disarmed for longer than a heartbeat period: arming may have been in progress."""
    return not now.armed and now.in_phase_s > 1.5


def mode_left(now: Facts) -> bool:
    return not now.engaged


def mode_left_armed(now: Facts) -> bool:
    """A pilot changed the mode while the vehicle armed: it stays armed, as the pilot decides."""
    return now.armed and not now.engaged


def landing_left(now: Facts) -> bool:
    """A pilot changed the mode during the landing; the modes of a failsafe do not count."""
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
    """A guard that holds once the phase has lasted longer than the limit of this name."""

    def too_long(now: Facts) -> bool:
        return now.in_phase_s > float(getattr(now.limits, limit))

    too_long.__name__ = f"longer_than_{limit}"
    return too_long
