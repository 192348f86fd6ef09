"""State table of PX4: events, and what follows from them."""

from __future__ import annotations

from collections.abc import Mapping

from simulator.firmware.base import AFTER_DELAY, Rule
from simulator.firmware.values import Result, Severity, StatusText, critical, info, warning

_LATER = Result.TEMPORARILY_REJECTED
_LOST = critical("Failsafe activated")
_NOT_AVAILABLE = critical("Switching to {mode} is currently not available")

_RTL, _LAND = "AUTO.RTL", "AUTO.LAND"
_REGAINED = info("GCS connection regained")
_WARNINGS = {
    "battery low": StatusText(Severity.EMERGENCY, "Low battery"),
    "battery critical": StatusText(Severity.EMERGENCY, "Critical battery"),
    "battery emergency": StatusText(Severity.EMERGENCY, "Emergency battery level"),
    "ground station lost": info("Connection to ground station lost"),
}


def _delayed(event: str, parameter: str, modes: Mapping[int, str]) -> list[Rule]:
    """Rows of a failsafe with delay: Hold first, so that a pilot can take over, then the mode that
    the parameter selects. A second failsafe during the delay changes that mode only."""
    chosen = [(f"{parameter}={value}", mode) for value, mode in modes.items()]
    return [
        Rule(event, when=("action delayed",), do=("failsafe", "delay"), texts=(_WARNINGS[event],)),
        *(
            Rule(
                event,
                when=("armed", "not landed", value),
                to="AUTO.LOITER",
                do=("failsafe", "delay"),
                texts=(
                    _WARNINGS[event],
                    critical("Failsafe activated: entering Hold for {delay_s:.0f} seconds"),
                ),
            )
            for value, _ in chosen
        ),
        *(
            Rule(
                event + AFTER_DELAY,
                when=(f"since {event}", value),
                to=mode,
                do=("failsafe",),
                texts=(_LOST,),
            )
            for value, mode in chosen
        ),
    ]


RULES = (
    Rule("mode", when=("not armed",), to="requested"),
    Rule("mode", when=("mode can run",), to="requested"),
    Rule("mode", when=("requested by ground station",), result=_LATER, texts=(_NOT_AVAILABLE,)),
    Rule("mode", result=_LATER),
    Rule("takeoff", to="AUTO.TAKEOFF"),
    Rule("land", to="AUTO.LAND", texts=(info("Landing at current position"),)),
    Rule("return", to="AUTO.RTL", texts=(info("Returning to launch"),)),
    Rule("arm", when=("armed",)),
    Rule("arm", when=("ready",), do=("arm",), texts=(info("Armed by external command"),)),
    Rule(
        "arm",
        result=_LATER,
        texts=(critical("Arming denied: Resolve system health failures first"),),
    ),
    Rule(
        "checks",
        when=("velocity rejected",),
        texts=(critical("Preflight Fail: horizontal velocity unstable"),),
    ),
    Rule(
        "checks",
        when=("fix missing", "COM_ARM_WO_GPS=0"),
        texts=(critical("Preflight Fail: GPS fix too low"),),
    ),
    Rule(
        "checks",
        when=("fix missing", "COM_ARM_WO_GPS=1"),
        texts=(warning("Preflight: GPS fix too low"),),
    ),
    Rule("force arm", when=("armed",)),
    Rule("force arm", do=("arm",), texts=(info("Armed by external command"),)),
    Rule("disarm", when=("not armed",)),
    Rule(
        "disarm",
        when=("landed",),
        do=("disarm",),
        to="remembered",
        texts=(info("Disarmed by external command"),),
    ),
    Rule("disarm", result=_LATER, texts=(critical("Disarming denied: not landed"),)),
    Rule("force disarm", when=("not armed",)),
    Rule(
        "force disarm",
        do=("disarm",),
        to="remembered",
        texts=(info("Disarmed by external command"),),
    ),
    *(
        Rule(
            "stream lost",
            "OFFBOARD",
            when=("armed", f"COM_OBL_RC_ACT={action}"),
            to=fallback,
            do=("failsafe",),
            texts=(_LOST,),
        )
        for action, fallback in enumerate(
            ("POSCTL", "ALTCTL", "STABILIZED", "AUTO.RTL", "AUTO.LAND", "AUTO.LOITER")
        )
    ),
    Rule("stream found", when=("since stream lost",), to="remembered", do=("recover",)),
    *_delayed("battery critical", "COM_LOW_BAT_ACT", {1: _RTL, 2: _LAND, 3: _RTL}),
    *_delayed("battery emergency", "COM_LOW_BAT_ACT", {1: _RTL, 2: _LAND, 3: _LAND}),
    *_delayed("ground station lost", "NAV_DLL_ACT", {2: _RTL, 3: _LAND}),
    Rule(
        "ground station lost",
        when=("armed", "not landed", "NAV_DLL_ACT=1"),
        to="AUTO.LOITER",
        do=("failsafe",),
        texts=(_WARNINGS["ground station lost"], _LOST),
    ),
    Rule("battery low", when=("armed",), texts=(_WARNINGS["battery low"], _LOST)),
    *(Rule(event, texts=(text,)) for event, text in _WARNINGS.items()),
    Rule("ground station found", texts=(_REGAINED,)),
    Rule("position lost", "OFFBOARD", when=("not motion setpoint",)),
    Rule("position lost", when=("armed", "not landed"), to=_LAND, do=("failsafe",), texts=(_LOST,)),
    Rule("position found", when=("since position lost",), to="remembered", do=("recover",)),
    Rule("climbed", "AUTO.TAKEOFF", to="AUTO.LOITER"),
    Rule("already higher", texts=(critical("Already higher than takeoff altitude"),)),
    Rule(
        "mission",
        when=("mission missing",),
        result=Result.DENIED,
        texts=(critical("Mission start denied! No valid mission"),),
    ),
    Rule("mission", when=("armed",), to="AUTO.MISSION"),
    Rule(
        "mission",
        when=("ready",),
        do=("arm",),
        to="AUTO.MISSION",
        texts=(info("Armed by mission start"),),
    ),
    Rule(
        "mission",
        result=_LATER,
        texts=(critical("Switching to Mission is currently not available"),),
    ),
    Rule("mission progress", send=("MISSION_CURRENT",)),
    Rule("item reached", send=("MISSION_ITEM_REACHED",)),
    Rule("mission return", "AUTO.MISSION", to="AUTO.RTL", texts=(info("Returning to launch"),)),
    Rule(
        "mission finished",
        when=("landed",),
        do=("disarm",),
        to="remembered",
        texts=(info("Mission finished, landed"), info("Disarmed by landing")),
    ),
    Rule("mission finished", texts=(info("Mission finished, loitering"),)),
    Rule("reboot", result=Result.DENIED),  # as SITL does, which cannot
    Rule("took off", texts=(info("Takeoff detected"),)),
    Rule("landed", texts=(info("Landing detected"),)),
    Rule("settled", do=("disarm",), to="remembered", texts=(info("Disarmed by landing"),)),
    Rule(
        "idle",
        do=("disarm",),
        to="remembered",
        texts=(info("Disarmed by auto preflight disarming"),),
    ),
)
