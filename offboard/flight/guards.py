"""Guards: the conditions of the phase table, functions of the facts. No I/O, no state."""

from __future__ import annotations

from collections.abc import Callable

from offboard.flight.facts import Facts
from offboard.flight.phases import OUTAGE_MAX_S, Rung
from offboard.flight.requests import Request

Guard = Callable[[Facts], bool]
DETECTOR_S = 1.0  # EXTENDED_SYS_STATE is requested at 5 Hz
LISTENED_S = 0.5  # to hear another sender: PX4 leaves OFFBOARD below 2 Hz


def vehicle_found(now: Facts) -> bool:
    return now.found


def ready(now: Facts) -> bool:
    return now.ready


def refused(now: Facts) -> bool:
    return now.refused


def armed_by_another(now: Facts) -> bool:
    return now.armed and not now.limits.begin_armed


def rebooted(now: Facts) -> bool:
    return now.rebooted


def rebooted_disarmed(now: Facts) -> bool:
    return now.rebooted and not now.armed and not now.landed


def other_sender(now: Facts) -> bool:
    """Another program controls the vehicle: it sends setpoints or mode commands, or says so."""
    return now.other_sender and not now.limits.begin_with_other_sender


def follows_others(now: Facts) -> bool:
    """The vehicle follows setpoints of another program in the mode that we asked for."""
    return now.engaged and now.follows_others and not now.limits.begin_with_other_sender


def other_vehicle(now: Facts) -> bool:
    """Several vehicles are heard: which one is meant?"""
    return now.other_vehicle


def usable(now: Facts) -> bool:
    """Nothing speaks against flying it."""
    return now.ready and not now.refused


def can_take_over(now: Facts) -> bool:
    """It flies in the mode of setpoints, and nobody else has it."""
    return (
        now.engaged
        and now.armed
        and now.in_the_air
        and not now.failsafe
        and not other_sender(now)
        and now.authority_known
        and not now.unfit_type
        and not silent(now)
        and not blind(now)
    )


def engaged_by_pilot(now: Facts) -> bool:
    return now.switched and can_take_over(now) and usable(now)


def engaged_but_unfit(now: Facts) -> bool:
    return now.switched and can_take_over(now) and not usable(now)


def started_in_the_air(now: Facts) -> bool:
    return now.request is Request.START and can_take_over(now) and usable(now)


def started_on_the_ground(now: Facts) -> bool:
    return now.request is Request.START and not now.armed and usable(now)


def engaged_too_soon(now: Facts) -> bool:
    """Switched away and back so fast that a failsafe may have done it."""
    return now.hasty and can_take_over(now) and now.in_phase_s > LISTENED_S


def found_engaged(now: Facts) -> bool:
    """Found in the air, in the mode of setpoints: another program may fly it."""
    flies = now.engaged and now.armed and now.in_the_air
    return flies and now.unclaimed and now.in_phase_s > LISTENED_S


def abandoned(now: Facts) -> bool:
    """A flight of this service was cut short there, and nobody else flies it."""
    alone = not now.other_vehicle
    return alone and now.left_engaged and found_engaged(now) and can_take_over(now)


def handed(now: Facts) -> bool:
    return now.handed


def requested(request: Request) -> Guard:
    """A guard that holds when the ground station has asked for this."""

    def wanted(now: Facts) -> bool:
        return now.request is request

    wanted.__name__ = f"requested_{request.name.lower()}"
    return wanted


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


def landed(now: Facts) -> bool:
    return now.landed and not now.armed


def disarmed_elsewhere(now: Facts) -> bool:
    """Disarmed, but not landed; the land detector has had time to report."""
    return not now.armed and not now.landed and now.disarmed_s > DETECTOR_S


def disarmed_for_good(now: Facts) -> bool:
    """Disarmed for longer than a heartbeat period: arming may have been in progress."""
    return not now.armed and now.in_phase_s > 1.5


def lost(now: Facts) -> bool:
    return now.lost


def lost_armed(now: Facts) -> bool:
    """A pilot has changed the mode of a vehicle that stays armed."""
    return now.lost and now.shown_since and now.armed


def lost_disarmed(now: Facts) -> bool:
    return now.lost and now.shown_since and not now.armed


def disarmed_again(now: Facts) -> bool:
    return now.disarmed_again


def authority_unknown(now: Facts) -> bool:
    return not now.authority_known


def silent(now: Facts) -> bool:
    return now.silence_s > now.limits.silence_s


def silent_for_long(now: Facts) -> bool:
    return now.silence_s > 2.0 * now.limits.silence_s


def in_own_failsafe(now: Facts) -> bool:
    """Setpoints were missing, and the autopilot's failsafe flies the vehicle."""
    return now.own_failsafe


def unheard_on_ground(now: Facts) -> bool:
    """It has landed, and no HEARTBEAT shows whether it is armed."""
    return now.landed and not now.authority_known


def out_of_reach(now: Facts) -> bool:
    return now.unreached_s > OUTAGE_MAX_S


def silent_on_ground(now: Facts) -> bool:
    return now.silence_s > now.limits.connect_s


def blind(now: Facts) -> bool:
    return now.blind_s > now.limits.blind_s


def stop_requested(now: Facts) -> bool:
    return now.stop_requested


def at_rung(rung: Rung) -> Guard:
    """A guard that holds when the ladder is at `rung`."""

    def reached(now: Facts) -> bool:
        return now.rung is rung

    reached.__name__ = f"ladder_{rung.name.lower()}"
    return reached


def longer_than(limit: str) -> Guard:
    """A guard that holds once the phase has lasted longer than the limit of this name."""

    def too_long(now: Facts) -> bool:
        return now.in_phase_s > float(getattr(now.limits, limit))

    too_long.__name__ = f"longer_than_{limit}"
    return too_long
