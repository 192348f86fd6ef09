"""Controllers by law name: the built-in ones, and those of installed packages.

A controller file (`config/controllers/*.yaml`) holds the settings of one law, named by `law`. A
package adds a law with an entry point in the group `pso_offboard.controllers`: its name is that of
the law, its object is the law's `ControllerSettings`. The paper's law is added that way too. A law
is imported when it is requested, so that a flight loads and compiles only what it needs.
"""

from __future__ import annotations

from importlib.metadata import EntryPoint, EntryPoints, entry_points
from inspect import isabstract
from typing import cast

from offboard.control.base import ControllerSettings
from offboard.documents.errors import DocumentError, outside

GROUP = "pso_offboard.controllers"

BUILT_IN = EntryPoints(
    EntryPoint(law, f"offboard.control.{settings}", GROUP)
    for law, settings in (
        ("pso", "law:PsoSettings"),
        ("lqr", "law:LqrSettings"),
        ("mpc", "mpc:MpcSettings"),
        ("horizon", "horizon:HorizonSettings"),
        ("pid", "pid:PidSettings"),
        ("autopilot", "autopilot:AutopilotSettings"),
    )
)


def names() -> list[str]:
    """Return all law names, first the built-in ones, then those of installed packages, without
    importing any of them."""
    installed = sorted(entry_points(group=GROUP).names)
    return list(dict.fromkeys((*(entry.name for entry in BUILT_IN), *installed)))


def settings_of(law: str) -> type[ControllerSettings]:
    """Return the settings class of `law`, one of `names`. A built-in law cannot be replaced.

    Raises DocumentError, with one sentence that names the entry point, if the law is unknown, is
    defined twice, or cannot be used.
    """
    found = BUILT_IN.select(name=law) or entry_points(group=GROUP, name=law)
    if not found:
        raise DocumentError(f"there is no law named {law!r}; known are {', '.join(names())}")
    if len(found) > 1:
        which = " and ".join(sorted(_described(entry) for entry in found))
        raise DocumentError(f"law {law} is defined twice, by {which}; uninstall one of them")
    (entry,) = found
    unusable = f"law {entry.name} of {_described(entry)} cannot be used"
    with outside(unusable):
        loaded = entry.load()
    is_settings = isinstance(loaded, type) and issubclass(loaded, ControllerSettings)
    if not is_settings or isabstract(loaded):
        sentence = f"{unusable}: {loaded!r} is not a subclass of ControllerSettings with `build`"
        raise DocumentError(" ".join(sentence.split()))
    return cast(type[ControllerSettings], loaded)


def _described(entry: EntryPoint) -> str:
    package = f"{entry.dist.name} {entry.dist.version}" if entry.dist else "an unknown package"
    return f"{package} ({entry.value})"
