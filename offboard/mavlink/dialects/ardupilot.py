"""ArduCopter 4.3 and later."""

from __future__ import annotations

import math
from dataclasses import replace
from types import MappingProxyType

from pymavlink.dialects.v20.all import enums

from offboard.mavlink.dialects.base import (
    ACCELERATION_LIMIT,
    RATE_LIMIT,
    TRACKING_TELEMETRY,
    Dialect,
    SetpointLoss,
    Valid,
    WantedMessage,
    WatchedParameter,
)

_MODES = {
    number: mode.name.removeprefix("COPTER_MODE_")
    for number, mode in enums["COPTER_MODE"].items()
    if not mode.name.endswith("ENUM_END")
}

_STATION = WatchedParameter("SYSID_MYGCS", "system id of its ground station")
_JERK = WatchedParameter(
    "PSC_JERK_XY",
    "how soon BRAKE, which is asked for hold, stops the vehicle",
    # BRAKE reduces the speed by the share (jerk / 7.5) per second
    advice=(
        Valid(
            "hold is BRAKE, which stops within 7.5 m divided by this value, for each m/s of speed",
            10.0,
            lowest=10.0,
        ),
    ),
    advice_only=True,
)
# Names of the parameters until 4.6 -> since 4.7
_ACCELERATIONS = {"ATC_ACCEL_R_MAX": "ATC_ACC_R_MAX", "ATC_ACCEL_P_MAX": "ATC_ACC_P_MAX"}
_RATES = "ATC_RATE_R_MAX", "ATC_RATE_P_MAX"
_ORIGIN = (
    "set the origin of its estimator (SET_GPS_GLOBAL_ORIGIN; Mission Planner: Set EKF Origin Here)"
)
_UNCHECKED = Valid("the vehicle arms without all of its checks", 1.0, 1.0, 1.0)

# A parameter with `replaces` has this name since ArduCopter 4.7
ARDUPILOT = Dialect(
    name="ardupilot",
    mav_autopilot=3,
    modes=MappingProxyType(_MODES),
    mode_parameters=lambda custom_mode: (float(custom_mode),),
    engage_mode="GUIDED",
    # not LOITER: there the throttle stick sets the climb rate, and without a radio it descends
    hold_mode="BRAKE",
    land_mode="LAND",
    return_mode="RTL",
    takes_off_by_command=True,
    unused_parameter=0.0,  # NaN ends its SITL with a floating point exception
    divides_by_tilt=True,  # ATC_ANGLE_BOOST 1
    integers_bytewise=False,
    watched_parameters=(
        WatchedParameter(
            "GUID_OPTIONS",
            "without bit 3 (value 8) the thrust field is a climb rate",
            Valid(bits=8),
            must_answer=True,
        ),
        WatchedParameter(
            "GUID_TIMEOUT",
            "seconds without setpoints before the vehicle levels",
            Valid(lowest=0.3, highest=5.0, set_to=1.0),  # ArduCopter's default is 3, see the advice
            advice=(
                Valid(
                    "where setpoints stop, as with a lost link, the last tilt is flown for "
                    "this many seconds; then the vehicle levels, holds its height and drifts: it "
                    "does not land, and does not say so",
                    1.0,
                    highest=1.5,
                ),
                Valid(
                    "it levels before the supervisor, which lands it if we stop, acts",
                    1.0,
                    lowest=0.6,
                ),
            ),
        ),
        WatchedParameter("MOT_THST_HOVER", "normalised thrust that holds the weight"),
        WatchedParameter(
            "ATC_ANGLE_BOOST",
            "the autopilot must divide thrust by the cosine of the tilt",
            Valid(lowest=1.0, highest=1.0, set_to=1.0),
            must_answer=True,
        ),
        WatchedParameter(
            "FS_GCS_ENABLE",
            "what the vehicle does when the heartbeat of its ground station is lost",
        ),
        _STATION,
        replace(_STATION, name="MAV_GCS_SYSID", replaces=_STATION.name),
        _JERK,
        replace(_JERK, name="PSC_JERK_NE", replaces=_JERK.name),
        replace(_JERK, name="PSC_NE_JERK", replaces=_JERK.name),
        WatchedParameter("FS_THR_ENABLE", "what the vehicle does when the radio is lost"),
        WatchedParameter("SYSID_ENFORCE", "whether commands are accepted only from SYSID_MYGCS"),
        WatchedParameter(
            "MAV_OPTIONS",
            "bit 0 (value 1): commands are accepted only from MAV_GCS_SYSID",
            replaces="SYSID_ENFORCE",
        ),
        WatchedParameter(
            "ARMING_CHECK", "pre-arm checks that the vehicle makes; 1 is all", advice=(_UNCHECKED,)
        ),
        WatchedParameter(
            "ARMING_SKIPCHK",
            "pre-arm checks that the vehicle does not make",
            advice=(replace(_UNCHECKED, set_to=0.0, lowest=0.0, highest=0.0),),
            replaces="ARMING_CHECK",
        ),
        WatchedParameter("ANGLE_MAX", "greatest tilt of its own modes, hundredths of a degree"),
        WatchedParameter(
            "ATC_ANGLE_MAX", "greatest tilt of its own modes, degrees", replaces="ANGLE_MAX"
        ),
        *(
            each
            for old, new in _ACCELERATIONS.items()
            for each in (
                WatchedParameter(old, "greatest angular acceleration, 0.01 degree/s^2"),
                WatchedParameter(new, "greatest angular acceleration, degree/s^2", replaces=old),
            )
        ),
        *(
            WatchedParameter(each, "greatest angular rate, degree/s; 0 is no limit")
            for each in _RATES
        ),
    ),
    hover_parameter="MOT_THST_HOVER",
    tilt_parameters=MappingProxyType(
        {"ANGLE_MAX": math.radians(0.01), "ATC_ANGLE_MAX": math.radians(1.0)}
    ),
    tilting_parameters=MappingProxyType(
        dict.fromkeys(_ACCELERATIONS, (ACCELERATION_LIMIT, math.radians(0.01)))
        | dict.fromkeys(_ACCELERATIONS.values(), (ACCELERATION_LIMIT, math.radians(1.0)))
        | dict.fromkeys(_RATES, (RATE_LIMIT, math.radians(1.0)))
    ),
    estimator_message="EKF_STATUS_REPORT",
    slow_hint="another ground station may set the rates (MAVProxy: `set streamrate -1`), or the "
    "link is full",
    unsaid="see the ground station",
    remedies=MappingProxyType(
        {
            "waiting for home": f"wait for a GPS fix, or without GPS {_ORIGIN}",
            "is not neutral": "move the throttle stick down, the others to their centre",
        }
    ),
    without_gps=_ORIGIN,
    oldest=(4, 3),
    setpoint_loss=lambda parameters: SetpointLoss(parameters.get("GUID_TIMEOUT", 3.0)),
    wanted=(
        *TRACKING_TELEMETRY,
        WantedMessage("HEARTBEAT", 10.0, optional=True),  # the only report of the mode
        WantedMessage("EKF_STATUS_REPORT", 2.0, optional=True),
        WantedMessage("SIM_STATE", 50.0, optional=True),  # true state, from a simulator
    ),
)
