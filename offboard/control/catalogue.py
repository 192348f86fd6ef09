"""Controllers by law name: the built-in ones, and those of installed packages.

A controller file (`config/controllers/*.yaml`) holds the settings of one law, named by `law`. A
package adds a law with an entry point in the group `pso_offboard.controllers`: its name is that of
the law, its object the law's `ControllerSettings`. The paper's law is added that way too.
"""

from __future__ import annotations

from collections.abc import Mapping
from importlib import import_module
from importlib.metadata import EntryPoint, entry_points

from offboard.control.base import ControllerSettings
from offboard.documents.reading import DocumentError

GROUP = "pso_offboard.controllers"

BUILT_IN: Mapping[str, str] = {
    "pso": "pso:PsoSettings",
    "lqr": "lqr:LqrSettings",
    "mpc": "mpc:MpcSettings",
    "horizon": "horizon:HorizonSettings",
    "mppi": "sampling:MppiSettings",
    "cem": "sampling:CemSettings",
    "pid": "pid:PidSettings",
    "autopilot": "autopilot:AutopilotSettings",
}
"""Module in `offboard.control.laws` and settings class of each law. A law is imported when it is
chosen, because whatever is imported is compiled before the first flight."""


def names() -> list[str]:
    """All law names: built in, then those of entry points. Loads none of these."""
    return list(dict.fromkeys((*BUILT_IN, *sorted(entry_points(group=GROUP).names))))


def settings_of(law: str) -> type[ControllerSettings]:
    """The settings class of one of `names`. A built-in law cannot be replaced.

    Raises DocumentError where an entry point cannot be used, with one sentence that names it.
    """
    if law in BUILT_IN:
        module, _, name = BUILT_IN[law].partition(":")
        built_in: type[ControllerSettings]
        built_in = getattr(import_module(f"offboard.control.laws.{module}"), name)
        return built_in
    found = entry_points(group=GROUP, name=law)
    if not found:
        raise DocumentError(f"there is no law named {law!r}; known are {', '.join(names())}")
    if len(found) > 1:
        which = " and ".join(sorted(_described(entry) for entry in found))
        raise DocumentError(f"law {law} is defined twice, by {which}; uninstall one of them")
    (entry,) = found
    try:
        loaded = entry.load()
    except Exception as error:  # whatever another package raises while it is imported
        raise _unusable(entry, f"{type(error).__name__}: {error}") from error
    if not (isinstance(loaded, type) and issubclass(loaded, ControllerSettings)):
        raise _unusable(entry, f"{loaded!r} is not a subclass of ControllerSettings")
    return loaded


def _unusable(entry: EntryPoint, reason: str) -> DocumentError:
    sentence = " ".join(f"law {entry.name} of {_described(entry)} cannot be used: {reason}".split())
    return DocumentError(sentence)


def _described(entry: EntryPoint) -> str:
    package = f"{entry.dist.name} {entry.dist.version}" if entry.dist else "an unknown package"
    return f"{package} ({entry.value})"
