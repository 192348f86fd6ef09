"""State table of PX4: events, and what follows from them."""

from __future__ import annotations

from collections.abc import Mapping

from simulator.firmware.base import AFTER_DELAY, Rule
from simulator.firmware.values import Result, Severity, StatusText, critical, info, warning

_LATER = Result.TEMPORARILY_REJECTED
_LOST = critical("Failsafe activated")
_NOT_AVAILABLE = critical("Switching to {mode} is currently not available")

_NO_MISSION = critical("Mission start denied! No valid mission")
_RTL, _LAND, _MISSION = "AUTO.RTL", "AUTO.LAND", "AUTO.MISSION"
_LANDED = ("landed",)
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


def _says(
    event: str,
    text: StatusText,
    *when: str,
    to: str = "*",
    do: tuple[str, ...] = (),
    result: Result = Result.ACCEPTED,
) -> Rule:
    """A row with one text."""
    return Rule(event, when=when, to=to, do=do, result=result, texts=(text,))


def _disarms(event: str, *texts: str, when: tuple[str, ...] = ()) -> Rule:
    """A row that disarms; the mode chosen last comes back."""
    return Rule(event, when=when, do=("disarm",), to="remembered", texts=tuple(map(info, texts)))


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
    _says("arm", critical("Arming denied: Resolve system health failures first"), result=_LATER),
    _says("checks", critical("Preflight Fail: horizontal velocity unstable"), "velocity rejected"),
    _says("checks", critical("Preflight Fail: GPS fix too low"), "fix missing", "COM_ARM_WO_GPS=0"),
    _says("checks", warning("Preflight: GPS fix too low"), "fix missing", "COM_ARM_WO_GPS=1"),
    Rule("force arm", when=("armed",)),
    Rule("force arm", do=("arm",), texts=(info("Armed by external command"),)),
    Rule("disarm", when=("not armed",)),
    _disarms("disarm", "Disarmed by external command", when=_LANDED),
    Rule("disarm", result=_LATER, texts=(critical("Disarming denied: not landed"),)),
    Rule("force disarm", when=("not armed",)),
    _disarms("force disarm", "Disarmed by external command"),
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
    _says("mission", _NO_MISSION, "mission missing", result=Result.DENIED),
    Rule("mission", when=("armed",), to=_MISSION),
    _says("mission", info("Armed by mission start"), "ready", to=_MISSION, do=("arm",)),
    _says("mission", critical("Switching to Mission is currently not available"), result=_LATER),
    Rule("mission progress", send=("MISSION_CURRENT",)),
    Rule("item reached", send=("MISSION_ITEM_REACHED",)),
    Rule("mission return", "AUTO.MISSION", to="AUTO.RTL", texts=(info("Returning to launch"),)),
    _disarms("mission finished", "Mission finished, landed", "Disarmed by landing", when=_LANDED),
    Rule("mission finished", texts=(info("Mission finished, loitering"),)),
    Rule("reboot", result=Result.DENIED),  # as SITL does, which cannot
    Rule("took off", texts=(info("Takeoff detected"),)),
    Rule("landed", texts=(info("Landing detected"),)),
    _disarms("settled", "Disarmed by landing"),
    _disarms("idle", "Disarmed by auto preflight disarming"),
)
