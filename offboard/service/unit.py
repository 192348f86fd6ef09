"""The systemd unit of the service, from the template beside this module.

It runs as a user of its own, which can read what everybody can, and write only below its state
directory.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

from jinja2 import Environment, StrictUndefined

WATCHDOG_S = 10
TEMPLATE = Path(__file__).with_name("offboard.service.j2")
PRIVATE = (Path("/tmp"), Path("/var/tmp"))  # the unit has its own
OTHERS_READ, OTHERS_ENTER = 0o4, 0o1


def unit(arguments: Sequence[str], connection: str, signing_key: Path | None = None) -> str:
    """The text of a unit that runs `offboard daemon` with these arguments, which name neither
    the key nor, for the state directory, `--out`."""
    template = Environment(undefined=StrictUndefined, keep_trailing_newline=True).from_string(
        TEMPLATE.read_text(encoding="utf-8")
    )
    command = [sys.executable, "-P", "-m", "offboard", "daemon", *arguments]
    words = [quoted(word) for word in command]
    if not any(word.startswith("--out") for word in arguments):
        words += ["--out", "%S/offboard"]
    if signing_key:
        words += ["--signing-key", "%d/signing-key"]
    return template.render(
        command=" ".join(words),
        connection=connection.replace("%", "%%"),
        serial=connection.startswith("serial:"),
        signing_key=str(signing_key.absolute()).replace("%", "%%") if signing_key else "",
        watchdog_s=WATCHDOG_S,
    )


def unreadable(path: Path) -> str:
    """Why the user of the unit cannot read this file or directory; empty if it can."""
    for place in (path.absolute(), path.resolve()):
        if any(private in place.parents for private in PRIVATE):
            return f"the unit cannot see {place}: it has a {place.parts[1]} of its own"
        closed = [each for each in place.parents if not each.stat().st_mode & OTHERS_ENTER]
        if not place.stat().st_mode & OTHERS_READ:
            closed.append(place)
        if closed:
            return f"the user of the unit cannot read {place}: {closed[-1]} is closed to others"
    return ""


def quoted(word: str) -> str:
    """A word of ExecStart=, in which systemd replaces nothing."""
    escaped = word.replace("\\", "\\\\").replace('"', '\\"').replace("%", "%%").replace("$", "$$")
    plain = escaped and not any(c.isspace() or c in "\"'\\;" for c in escaped)
    return escaped if plain else f'"{escaped}"'
