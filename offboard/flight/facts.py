"""Facts of one moment: all that a guard of the phase table or a row of the ladder may use."""

from __future__ import annotations

import math
from dataclasses import dataclass

from offboard.flight.phases import Limits, Rung
from offboard.flight.requests import Request


@dataclass(frozen=True, slots=True)
class Facts:
    """SI; NaN for what is not known yet. `assessment.facts` computes them."""

    limits: Limits
    in_phase_s: float  # since the phase began, on Session.link_time_s
    silence_s: float  # host time since the last telemetry
    blind_s: float  # age of the older of position and attitude, vehicle time
    found: bool
    ready: bool  # by the preflight list, nothing is to be waited for
    refused: bool  # by the preflight list, whatever is waited for
    rebooted: bool  # after its telemetry was complete
    engaged: bool  # the vehicle shows the mode in which it follows setpoints
    lost: bool  # the vehicle is not ours any more
    shown_since: bool  # and a HEARTBEAT has come since then
    authority_known: bool
    own_failsafe: bool  # setpoints were missing, and the autopilot's failsafe flies it
    unreached_s: float  # without telemetry, or without a report of the mode; 0 while both arrive
    failsafe: bool  # the vehicle shows a failsafe or an emergency
    armed: bool
    in_the_air: bool
    landed: bool  # by the land detector, the height and the speed of the descent
    disarmed_s: float  # since it was reported disarmed; 0 while armed
    lifted_off: bool
    at_start: bool
    late_s: float  # since the planned end of the climb
    track_time_s: float
    track_start_s: float
    track_end_s: float
    rest_time_s: float
    position_error_m: float
    prediction_error_m: float
    tilt_rad: float
    tilt_error_rad: float
    height_m: float  # above the take-off point
    distance_m: float  # horizontal, from the take-off point
    stop_requested: bool
    missed_decisions: int  # in a row
    contradicted: bool  # telemetry contradicts the vehicle file
    unfit_type: bool = False  # no multirotor: none of its modes means what we know
    telemetry_age_s: float = 0.0  # beyond the least delay of the link
    link_growth_s: float = 0.0
    clock_jump_s: float = 0.0
    position_jump_m: float = 0.0  # of the reported position, all of the last ten seconds
    positioning_lost: bool = False  # what the estimate was made of when the flight began
    battery: float = 1.0
    hover_thrust: float = math.nan  # normalised, as setpoints that are followed show it now
    full_thrust_sink_mps: float = 0.0  # downward speed while setpoints demand the full thrust
    other_sender: bool = False
    follows_others: bool = False  # setpoints of another program, by the thrust that it reports
    other_vehicle: bool = False  # several vehicles were heard, and none was chosen
    disarmed_again: bool = False  # after arming was accepted
    lifted_by_command: bool = False  # the autopilot takes off on a command, without setpoints
    request: Request = Request.NONE  # of the ground station
    switched: bool = False  # by the pilot, in the air, to the mode of setpoints
    hasty: bool = False  # the same, before a HEARTBEAT has shown the mode that it left
    unclaimed: bool = False  # found in the air in the mode of setpoints
    left_engaged: bool = False  # there a flight of this service was cut short
    handed: bool = False  # it shows a mode that we asked for at the end
    rung: Rung = Rung.FLY  # of the ladder, which judges the other facts
    excites: bool = False  # identification steps are flown before the track
    identified: bool = False  # and their result is in use
