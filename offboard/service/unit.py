"""The systemd unit of the service, from the template beside this module."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

from jinja2 import Environment, StrictUndefined

WATCHDOG_S = 10
TEMPLATE = Path(__file__).with_name("offboard.service.j2")


def unit(arguments: Sequence[str], connection: str) -> str:
    """The text of a unit that runs `offboard daemon` with these arguments."""
    template = Environment(undefined=StrictUndefined, keep_trailing_newline=True).from_string(
        TEMPLATE.read_text(encoding="utf-8")
    )
    command = [sys.executable, "-m", "offboard", "daemon", *arguments]
    words = [quoted(word) for word in command]
    if not any(word.startswith("--out") for word in arguments):
        words += ["--out", "%S/offboard"]
    return template.render(
        command=" ".join(words),
        connection=connection.replace("%", "%%"),
        serial=connection.startswith("serial:"),
        watchdog_s=WATCHDOG_S,
    )


def quoted(word: str) -> str:
    """A word of ExecStart=, in which systemd replaces nothing."""
    escaped = word.replace("\\", "\\\\").replace('"', '\\"').replace("%", "%%").replace("$", "$$")
    plain = escaped and not any(c.isspace() or c in "\"'\\;" for c in escaped)
    return escaped if plain else f'"{escaped}"'
