"""`offboard list`: the shipped files that a flight may be given, with their descriptions."""

from __future__ import annotations

from offboard.cli.shared import out, say
from offboard.documents import shipped


def list_files() -> None:
    """List the shipped files by name, with one line each."""
    from offboard.control import catalogue

    for number, kind in enumerate(shipped.FOLDERS):
        described = shipped.descriptions(kind)
        if kind == "controller":
            for law in catalogue.names():
                described.setdefault(law, "law of an installed package")
        width = max(map(len, described))
        out.print("\n" * (number > 0) + f"{kind}s", style="bold")
        for name, text in described.items():
            say(f"  {name:<{width}}  {text}", indent=width + 4)
