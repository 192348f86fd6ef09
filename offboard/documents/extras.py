"""Extras of this package: what to install for a command that needs one."""

from __future__ import annotations

from importlib.metadata import requires


def install(extra: str) -> str:
    """The line that installs the libraries of an extra. It names them and not this package, which
    was installed from a checkout or a wheel, and is on no index."""
    marked = (each.partition(";") for each in requires("pso-offboard") or ())
    libraries = [name.strip() for name, _, marker in marked if extra in marker.split("extra")[-1]]
    return "pip install " + " ".join(f"'{each}'" for each in libraries)
