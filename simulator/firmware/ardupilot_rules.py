"""State table of ArduCopter: events, and what follows from them."""

from __future__ import annotations

from collections.abc import Mapping

from simulator.firmware.base import Rule
from simulator.firmware.values import Result, critical, info, warning

_FAILED = Result.FAILED
_NO_POSITION = warning("Mode change to {mode} failed: requires position")
_HEARTBEAT = ("HEARTBEAT",)
_ORIGIN_AND_HOME = ("GPS_GLOBAL_ORIGIN", "HOME_POSITION")
_ARMING = Rule("arm", do=("arm",), texts=(info("Arming motors"),), send=_ORIGIN_AND_HOME)
_DISARMING = info("Disarming motors")

_UNTIL_REBOOT = ("failsafe", "latch")
# FS_GCS_ENABLE 6 looks for a landing sequence in the mission first
_FURTHER_TEXTS = {
    ("ground station lost", 6): (
        warning("Unable to start landing sequence"),
        warning("Mode change to AUTO RTL failed: No return path or landing sequence found"),
        warning("Trying RTL Mode"),
    ),
}

_FAILSAFE = {
    "ground station lost": (warning("GCS Failsafe"),),
    "battery low": (
        warning("Battery 1 is low {battery_v:.2f}V used {used_mah:.0f} mAh"),
        warning("Battery Failsafe"),
    ),
    "battery critical": (
        warning("Battery 1 is critical {battery_v:.2f}V used {used_mah:.0f} mAh"),
        warning("Battery Failsafe"),
    ),
}


def _failsafe(
    event: str, parameter: str, modes: Mapping[int, str], do: tuple[str, ...] = ("failsafe",)
) -> list[Rule]:
    """Rows of a failsafe without delay: to the mode that the parameter selects, when armed."""
    return [
        Rule(
            event,
            when=("armed", f"{parameter}={value}"),
            to=mode,
            do=do,
            texts=(*_FAILSAFE[event], *_FURTHER_TEXTS.get((event, value), ())),
            send=_HEARTBEAT,
        )
        for value, mode in modes.items()
    ]


_BATTERY_MODES = {1: "LAND", 2: "RTL", 3: "SMART_RTL", 4: "SMART_RTL", 7: "BRAKE"}
_GROUND_MODES = {**_BATTERY_MODES, 1: "RTL", 5: "LAND", 6: "RTL"}


def _refusals(event: str, prefix: str, result: Result) -> list[Rule]:
    """Rows that refuse arming, or (MAV_CMD_RUN_PREARM_CHECKS) say what would; but for the mode."""

    def refuses(*texts: str, when: tuple[str, ...], mode: str = "*") -> Rule:
        said = tuple(critical(f"{prefix}: {text}") for text in texts)
        return Rule(event, mode, when, result=result, texts=said)

    imu, home = "Accels inconsistent", "AHRS: waiting for home"
    not_aligned = ("Need Alt Estimate", imu, "EKF attitude is bad", home)
    rows = [
        refuses("System not initialised", when=("not reached initialised",)),
        refuses("Internal Errors 0x400", when=("latched thrust not a number",)),
        refuses("Battery failsafe", when=("latched battery low",)),
        refuses("Battery failsafe", when=("latched battery critical",)),
        refuses(*not_aligned, when=("not reached attitude",)),
        refuses("Mode requires mission", when=("mission missing",), mode="AUTO"),
        refuses("{mode} mode not armable", when=("not mode arms",)),
        refuses("Need Position Estimate", home, when=("position missing", "not reached origin")),
        refuses("Need Position Estimate", when=("position missing",)),
        refuses(imu, "Gyros inconsistent", when=("not reached gyros",)),
        refuses("EKF velocity variance", when=("velocity rejected",)),
    ]
    return [row for row in rows if event == "arm" or "not mode arms" not in row.when]


RULES = (
    # A mode requested before was acknowledged and is lost
    Rule("initialised", to="STABILIZE", texts=(info("ArduPilot Ready"),)),
    Rule("origin", send=_ORIGIN_AND_HOME),
    Rule(
        "reminder",
        when=("not armed", "position missing"),
        texts=(critical("PreArm: Need Position Estimate"),),
    ),
    Rule("position", texts=(info("EKF3 IMU0 is using GPS"), info("EKF3 IMU1 is using GPS"))),
    # A heartbeat follows a mode change at once
    Rule("mode", when=("not armed",), to="requested", send=_HEARTBEAT),
    Rule("mode", when=("not position missing",), to="requested", send=_HEARTBEAT),
    Rule("mode", result=_FAILED, texts=(_NO_POSITION,)),
    Rule("turn"),
    Rule("loiter", when=("not position missing",), to="LOITER", send=_HEARTBEAT),
    Rule("loiter", result=_FAILED),
    Rule("mission", when=("not position missing",), to="AUTO", send=_HEARTBEAT),
    Rule("mission", result=_FAILED),
    Rule("mission progress", send=("MISSION_CURRENT",)),
    Rule("item reached", send=("MISSION_ITEM_REACHED",)),
    Rule("mission return", "AUTO", do=("return",)),  # within the mode
    Rule("mission finished", when=("landed",), do=("disarm",), texts=(_DISARMING,)),
    Rule("takeoff", "GUIDED", when=("armed", "landed", "climb requested"), do=("take off",)),
    Rule("takeoff", "GUIDED", when=("armed", "climbing", "climb requested"), do=("take off",)),
    Rule("takeoff", result=_FAILED),
    Rule("climbed", "GUIDED", do=("hold",)),
    Rule("land", to="LAND", send=_HEARTBEAT),
    Rule("return", when=("reached position",), to="RTL", send=_HEARTBEAT),
    Rule(
        "return", result=_FAILED, texts=(critical("Mode change to RTL failed: requires position"),)
    ),
    Rule("checks", when=("armed",), result=Result.TEMPORARILY_REJECTED),
    *_refusals("checks", "PreArm", Result.ACCEPTED),
    Rule("arm", when=("armed",)),
    *_refusals("arm", "Arm", _FAILED),
    _ARMING,
    Rule("force arm", when=("armed",)),
    Rule("force arm", do=_ARMING.do, texts=_ARMING.texts, send=_ARMING.send),
    Rule("disarm", when=("not armed",)),
    Rule("disarm", when=("landed",), do=("disarm",), texts=(_DISARMING,)),
    Rule("disarm", result=_FAILED),
    Rule("force disarm", when=("not armed",)),
    Rule("force disarm", do=("disarm",), texts=(_DISARMING,)),
    # No failsafe and no text: level with constant height, or standing still; the mode stays GUIDED
    Rule("stream lost", when=("attitude setpoint",), do=("level",)),
    Rule("stream lost", when=("velocity setpoint",), do=("hold",)),
    *_failsafe("ground station lost", "FS_GCS_ENABLE", _GROUND_MODES),
    Rule(
        "ground station found",
        when=("since ground station lost",),
        do=("recover",),
        texts=(warning("GCS Failsafe Cleared"),),
    ),
    *_failsafe("battery low", "BATT_FS_LOW_ACT", _BATTERY_MODES, _UNTIL_REBOOT),
    *_failsafe("battery critical", "BATT_FS_CRT_ACT", _BATTERY_MODES, _UNTIL_REBOOT),
    Rule("battery low", texts=(_FAILSAFE["battery low"][0],)),
    Rule("battery critical", texts=(_FAILSAFE["battery critical"][0],)),
    *(
        Rule(
            "position lost",
            when=("armed", "not landed", "mode needs position", f"FS_EKF_ACTION={value}"),
            to=mode,
            do=("failsafe",),
            texts=(critical("EKF variance"), critical(f"EKF Failsafe: changed to {mode} Mode")),
            send=_HEARTBEAT,
        )
        for value, mode in ((1, "LAND"), (2, "ALT_HOLD"), (3, "LAND"))
    ),
    Rule(
        "position found",
        when=("since position lost",),
        do=("recover",),
        texts=(critical("EKF Failsafe Cleared"),),
    ),
    Rule("thrust not a number", do=("latch",)),
    Rule("reboot", when=("not armed",), do=("reboot",)),
    Rule("reboot", result=_FAILED),
    Rule("settled", do=("disarm",), texts=(_DISARMING,)),
    Rule("idle", do=("disarm",), texts=(_DISARMING,)),
)
