"""ArduCopter's state table: what happens to it, and what it does and says then."""

from __future__ import annotations

from collections.abc import Mapping

from simulator.firmware.rules import Rule
from simulator.firmware.vocabulary import Result, Say, Severity


def _info(text: str) -> Say:
    return Say(Severity.INFO, text)


def _warning(text: str) -> Say:
    return Say(Severity.WARNING, text)


def _critical(text: str) -> Say:
    return Say(Severity.CRITICAL, text)


_FAILED = Result.FAILED
_NO_POSITION = Say(Severity.WARNING, "Mode change to {mode} failed: requires position")
_NEED_POSITION = _critical("Arm: Need Position Estimate")
_HEARTBEAT = ("HEARTBEAT",)
_ORIGIN_AND_HOME = ("GPS_GLOBAL_ORIGIN", "HOME_POSITION")
_ARMING = Rule("arm", do=("arm",), say=_info("Arming motors"), send=_ORIGIN_AND_HOME)
_DISARMING = _info("Disarming motors")

_FOR_GOOD = ("failsafe", "latch")
# FS_GCS_ENABLE 6 looks for a landing sequence in the mission first
_INSTEAD = {
    ("ground station lost", 6): (
        _warning("Unable to start landing sequence"),
        _warning("Mode change to AUTO RTL failed: No return path or landing sequence found"),
        _warning("Trying RTL Mode"),
    ),
}

_FAILSAFE = {
    "ground station lost": (_warning("GCS Failsafe"),),
    "battery low": (
        _warning("Battery 1 is low {battery_v:.2f}V used {used_mah:.0f} mAh"),
        _warning("Battery Failsafe"),
    ),
    "battery critical": (
        _warning("Battery 1 is critical {battery_v:.2f}V used {used_mah:.0f} mAh"),
        _warning("Battery Failsafe"),
    ),
}


def _failsafe(
    event: str, parameter: str, modes: Mapping[int, str], do: tuple[str, ...] = ("failsafe",)
) -> list[Rule]:
    """At once to the mode that the parameter's value names, unless it stands disarmed."""
    say, *also = _FAILSAFE[event]
    return [
        Rule(
            event,
            when=("armed", f"{parameter}={value}"),
            to=mode,
            do=do,
            say=say,
            also=(*also, *_INSTEAD.get((event, value), ())),
            send=_HEARTBEAT,
        )
        for value, mode in modes.items()
    ]


_BATTERY_MODES = {1: "LAND", 2: "RTL", 3: "SMART_RTL", 4: "SMART_RTL", 7: "BRAKE"}
_GROUND_MODES = {**_BATTERY_MODES, 1: "RTL", 5: "LAND", 6: "RTL"}

RULES = (
    Rule(
        "barometer",
        say=_info("Barometer 1 calibration complete"),
        also=(_info("Barometer 2 calibration complete"),),
    ),
    # A mode asked for before was acknowledged and is lost
    Rule(
        "initialised",
        to="STABILIZE",
        say=_info("ArduPilot Ready"),
        also=(_info("AHRS: DCM active"),),
    ),
    Rule(
        "estimator",
        say=_info("EKF3 IMU0 initialised"),
        also=(_info("EKF3 IMU1 initialised"), _info("AHRS: EKF3 active")),
    ),
    Rule(
        "tilt",
        say=_info("EKF3 IMU0 tilt alignment complete"),
        also=(_info("EKF3 IMU1 tilt alignment complete"),),
    ),
    Rule(
        "attitude",
        say=_info("EKF3 IMU0 MAG0 initial yaw alignment complete"),
        also=(_info("EKF3 IMU1 MAG0 initial yaw alignment complete"),),
    ),
    Rule(
        "gps",
        say=_info("GPS 1: probing for u-blox at 230400 baud"),
        also=(_info("GPS 1: detected u-blox"),),
    ),
    Rule(
        "origin",
        say=_info("EKF3 IMU0 origin set"),
        also=(_info("Field Elevation Set: 584m"),),
        send=_ORIGIN_AND_HOME,
    ),
    Rule("other origin", say=_info("EKF3 IMU1 origin set")),
    Rule(
        "reminder",
        when=("not armed", "position missing"),
        say=_critical("PreArm: Need Position Estimate"),
    ),
    Rule(
        "position",
        say=_info("EKF3 IMU0 is using GPS"),
        also=(_info("EKF3 IMU1 is using GPS"),),
    ),
    # A change of mode is shown by a heartbeat at once
    Rule("mode", when=("not armed",), to="requested", send=_HEARTBEAT),
    Rule("mode", when=("not position missing",), to="requested", send=_HEARTBEAT),
    Rule("mode", result=_FAILED, say=_NO_POSITION),
    Rule("turn"),
    Rule("loiter", when=("not position missing",), to="LOITER", send=_HEARTBEAT),
    Rule("loiter", result=_FAILED),
    Rule("mission", when=("not position missing",), to="AUTO", send=_HEARTBEAT),
    Rule("mission", result=_FAILED),
    Rule("mission progress", send=("MISSION_CURRENT",)),
    Rule("item reached", send=("MISSION_ITEM_REACHED",)),
    Rule("mission return", "AUTO", do=("return",)),  # within the mode
    Rule("mission finished", when=("landed",), do=("disarm",), say=_DISARMING),
    Rule("takeoff", "GUIDED", when=("armed", "landed", "climb asked"), do=("take off",)),
    Rule("takeoff", "GUIDED", when=("armed", "climbing", "climb asked"), do=("take off",)),
    Rule("takeoff", result=_FAILED),
    Rule("climbed", "GUIDED", do=("hold",)),
    Rule("land", to="LAND", send=_HEARTBEAT),
    Rule("return", when=("reached position",), to="RTL", send=_HEARTBEAT),
    Rule("return", result=_FAILED, say=_critical("Mode change to RTL failed: requires position")),
    Rule("arm", when=("armed",)),
    Rule(
        "arm",
        when=("not reached initialised",),
        result=_FAILED,
        say=_critical("Arm: System not initialised"),
    ),
    Rule(
        "arm",
        when=("latched thrust not a number",),
        result=_FAILED,
        say=_critical("Arm: Internal Errors 0x400"),
    ),
    *(
        Rule(
            "arm",
            when=(f"latched {event}",),
            result=_FAILED,
            say=_critical("Arm: Battery failsafe"),
        )
        for event in ("battery low", "battery critical")
    ),
    Rule(
        "arm",
        when=("not reached attitude",),
        result=_FAILED,
        say=_critical("Arm: Need Alt Estimate"),
        also=(
            _critical("Arm: Accels inconsistent"),
            _critical("Arm: EKF attitude is bad"),
            _critical("Arm: AHRS: waiting for home"),
        ),
    ),
    Rule(
        "arm",
        "AUTO",
        when=("mission missing",),
        result=_FAILED,
        say=_critical("Arm: Mode requires mission"),
    ),
    Rule(
        "arm",
        when=("not mode arms",),
        result=_FAILED,
        say=_critical("Arm: {mode} mode not armable"),
    ),
    Rule(
        "arm",
        when=("position missing", "not reached origin"),
        result=_FAILED,
        say=_NEED_POSITION,
        also=(_critical("Arm: AHRS: waiting for home"),),
    ),
    Rule("arm", when=("position missing",), result=_FAILED, say=_NEED_POSITION),
    Rule(
        "arm",
        when=("not reached gyros",),
        result=_FAILED,
        say=_critical("Arm: Accels inconsistent"),
        also=(_critical("Arm: Gyros inconsistent"),),
    ),
    _ARMING,
    Rule("force arm", when=("armed",)),
    Rule("force arm", do=_ARMING.do, say=_ARMING.say, send=_ARMING.send),
    Rule("disarm", when=("not armed",)),
    Rule("disarm", when=("landed",), do=("disarm",), say=_DISARMING),
    Rule("disarm", result=_FAILED),
    Rule("force disarm", when=("not armed",)),
    Rule("force disarm", do=("disarm",), say=_DISARMING),
    # No failsafe and no text: level, height held, or standing still, and still GUIDED
    Rule("stream lost", when=("obeys attitude",), do=("level",)),
    Rule("stream lost", when=("obeys velocity",), do=("hold",)),
    *_failsafe("ground station lost", "FS_GCS_ENABLE", _GROUND_MODES),
    Rule(
        "ground station found",
        when=("since ground station lost",),
        do=("recover",),
        say=_warning("GCS Failsafe Cleared"),
    ),
    *_failsafe("battery low", "BATT_FS_LOW_ACT", _BATTERY_MODES, _FOR_GOOD),
    *_failsafe("battery critical", "BATT_FS_CRT_ACT", _BATTERY_MODES, _FOR_GOOD),
    Rule("battery low", say=_FAILSAFE["battery low"][0]),
    Rule("battery critical", say=_FAILSAFE["battery critical"][0]),
    *(
        Rule(
            "position lost",
            when=("armed", "not landed", "mode needs position", f"FS_EKF_ACTION={value}"),
            to=mode,
            do=("failsafe",),
            say=_critical("EKF variance"),
            also=(_critical(f"EKF Failsafe: changed to {mode} Mode"),),
            send=_HEARTBEAT,
        )
        for value, mode in ((1, "LAND"), (2, "ALT_HOLD"), (3, "LAND"))
    ),
    Rule(
        "position found",
        when=("since position lost",),
        do=("recover",),
        say=_critical("EKF Failsafe Cleared"),
    ),
    Rule("thrust not a number", do=("latch",)),
    Rule("reboot", when=("not armed",), do=("restart",)),
    Rule("reboot", result=_FAILED),
    Rule("settled", do=("disarm",), say=_DISARMING),
    Rule("idle", do=("disarm",), say=_DISARMING),
)
