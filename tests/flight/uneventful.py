"""The facts of a moment in which nothing happens."""

from __future__ import annotations

import math

from offboard.flight.facts import Facts
from offboard.flight.phases import Limits

UNEVENTFUL = Facts(
    limits=Limits(),
    in_phase_s=0.0,
    silence_s=0.0,
    blind_s=0.0,
    found=False,
    ready=False,
    refused=False,
    rebooted=False,
    engaged=True,
    lost=False,
    shown_since=False,
    authority_known=True,
    own_failsafe=False,
    unreached_s=0.0,
    failsafe=False,
    armed=True,
    in_the_air=False,
    landed=True,
    disarmed_s=0.0,
    lifted_off=False,
    at_start=False,
    late_s=math.nan,
    track_time_s=math.nan,
    track_start_s=4.0,
    track_end_s=20.0,
    rest_time_s=23.5,
    position_error_m=0.0,
    prediction_error_m=0.0,
    tilt_rad=0.0,
    tilt_error_rad=0.0,
    height_m=1.0,
    distance_m=2.0,
    stop_requested=False,
    missed_decisions=0,
    contradicted=False,
)
