"""PX4's state table: what happens to it, and what it does and says then."""

from __future__ import annotations

from collections.abc import Mapping

from simulator.firmware.rules import AT_LAST, Rule
from simulator.firmware.vocabulary import Result, Say, Severity


def _info(text: str) -> Say:
    return Say(Severity.INFO, text)


def _critical(text: str) -> Say:
    return Say(Severity.CRITICAL, text)


_LATER = Result.TEMPORARILY_REJECTED
_LOST = _critical("Failsafe activated")
_NOT_AVAILABLE = _critical("Switching to {mode} is currently not available")

_RTL, _LAND = "AUTO.RTL", "AUTO.LAND"
_REGAINED = _info("GCS connection regained")
_WARNINGS = {
    "battery low": Say(Severity.EMERGENCY, "Low battery"),
    "battery critical": Say(Severity.EMERGENCY, "Critical battery"),
    "battery emergency": Say(Severity.EMERGENCY, "Emergency battery level"),
    "ground station lost": _info("Connection to ground station lost"),
}


def _put_off(event: str, parameter: str, modes: Mapping[int, str]) -> list[Rule]:
    """First hold, so that a pilot can take over; then the mode that the parameter's value names.

    While another waits already, only what is done at last changes.
    """
    chosen = [(f"{parameter}={value}", mode) for value, mode in modes.items()]
    return [
        Rule(event, when=("waiting",), do=("failsafe", "await"), say=_WARNINGS[event]),
        *(
            Rule(
                event,
                when=("armed", "not landed", value),
                to="AUTO.LOITER",
                do=("failsafe", "await"),
                say=_WARNINGS[event],
                also=(_critical("Failsafe activated: entering Hold for {delay_s:.0f} seconds"),),
            )
            for value, _ in chosen
        ),
        *(
            Rule(
                event + AT_LAST,
                when=(f"since {event}", value),
                to=mode,
                do=("failsafe",),
                say=_LOST,
            )
            for value, mode in chosen
        ),
    ]


RULES = (
    Rule("mode", when=("not armed",), to="requested"),
    Rule("mode", when=("mode can run",), to="requested"),
    Rule("mode", when=("planner asks",), result=_LATER, say=_NOT_AVAILABLE),
    Rule("mode", result=_LATER),
    Rule("takeoff", to="AUTO.TAKEOFF"),
    Rule("land", to="AUTO.LAND", say=_info("Landing at current position")),
    Rule("return", to="AUTO.RTL", say=_info("Returning to launch")),
    Rule("arm", when=("armed",)),
    Rule("arm", when=("ready",), do=("arm",), say=_info("Armed by external command")),
    Rule(
        "arm", result=_LATER, say=_critical("Arming denied: Resolve system health failures first")
    ),
    Rule("force arm", when=("armed",)),
    Rule("force arm", do=("arm",), say=_info("Armed by external command")),
    Rule("disarm", when=("not armed",)),
    Rule(
        "disarm",
        when=("landed",),
        do=("disarm",),
        to="remembered",
        say=_info("Disarmed by external command"),
    ),
    Rule("disarm", result=_LATER, say=_critical("Disarming denied: not landed")),
    Rule("force disarm", when=("not armed",)),
    Rule(
        "force disarm", do=("disarm",), to="remembered", say=_info("Disarmed by external command")
    ),
    *(
        Rule(
            "stream lost",
            "OFFBOARD",
            when=("armed", f"COM_OBL_RC_ACT={action}"),
            to=fallback,
            do=("failsafe",),
            say=_LOST,
        )
        for action, fallback in enumerate(
            ("POSCTL", "ALTCTL", "STABILIZED", "AUTO.RTL", "AUTO.LAND", "AUTO.LOITER")
        )
    ),
    Rule("stream found", when=("since stream lost",), to="remembered", do=("recover",)),
    *_put_off("battery critical", "COM_LOW_BAT_ACT", {1: _RTL, 2: _LAND, 3: _RTL}),
    *_put_off("battery emergency", "COM_LOW_BAT_ACT", {1: _RTL, 2: _LAND, 3: _LAND}),
    *_put_off("ground station lost", "NAV_DLL_ACT", {2: _RTL, 3: _LAND}),
    Rule(
        "ground station lost",
        when=("armed", "not landed", "NAV_DLL_ACT=1"),
        to="AUTO.LOITER",
        do=("failsafe",),
        say=_WARNINGS["ground station lost"],
        also=(_LOST,),
    ),
    Rule("battery low", when=("armed",), say=_WARNINGS["battery low"], also=(_LOST,)),
    *(Rule(event, say=said) for event, said in _WARNINGS.items()),
    Rule("ground station found", say=_REGAINED),
    Rule("position lost", "OFFBOARD", when=("not obeys motion",)),
    Rule("position lost", when=("armed", "not landed"), to=_LAND, do=("failsafe",), say=_LOST),
    Rule("position found", when=("since position lost",), to="remembered", do=("recover",)),
    Rule("climbed", "AUTO.TAKEOFF", to="AUTO.LOITER"),
    Rule("default height", say=_info("Using default takeoff altitude: {takeoff_m:.1f} m")),
    Rule("already higher", say=_critical("Already higher than takeoff altitude")),
    Rule(
        "return begun",
        say=_info(
            "RTL: start return at {target_amsl_m:.0f} m ({target_m:.0f} m above destination)"
        ),
    ),
    Rule("return lands", say=_info("RTL: land at destination")),
    Rule(
        "mission",
        when=("mission missing",),
        result=Result.DENIED,
        say=_critical("Mission start denied! No valid mission"),
    ),
    Rule("mission", when=("armed",), to="AUTO.MISSION"),
    Rule(
        "mission",
        when=("ready",),
        do=("arm",),
        to="AUTO.MISSION",
        say=_info("Armed by mission start"),
    ),
    Rule(
        "mission", result=_LATER, say=_critical("Switching to Mission is currently not available")
    ),
    Rule("mission begun", say=_info("Executing Mission")),
    Rule("mission climbs", say=_info("Climb to {climb_m:.1f} meters above home")),
    Rule("mission progress", send=("MISSION_CURRENT",)),
    Rule("item reached", send=("MISSION_ITEM_REACHED",)),
    Rule("mission return", "AUTO.MISSION", to="AUTO.RTL", say=_info("Returning to launch")),
    Rule(
        "mission finished",
        when=("landed",),
        do=("disarm",),
        to="remembered",
        say=_info("Mission finished, landed"),
        also=(_info("Disarmed by landing"),),
    ),
    Rule("mission finished", say=_info("Mission finished, loitering")),
    Rule("reboot", result=Result.DENIED),  # as SITL does, which cannot
    Rule("took off", say=_info("Takeoff detected")),
    Rule("landed", say=_info("Landing detected")),
    Rule("settled", do=("disarm",), to="remembered", say=_info("Disarmed by landing")),
    Rule(
        "idle",
        do=("disarm",),
        to="remembered",
        say=_info("Disarmed by auto preflight disarming"),
    ),
)
