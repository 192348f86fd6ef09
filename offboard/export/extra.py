"""Libraries that are an extra of the package."""

from __future__ import annotations

from importlib import import_module
from typing import Any

from offboard.documents.errors import UserError

INSTALL = "pip install 'pso-offboard[export]'"


def library(name: str, kind: str) -> Any:
    """Import a library of the extra. Raises UserError with the line that installs it."""
    try:
        return import_module(name)
    except ImportError:
        raise UserError(f"--to {kind} needs {name.partition('.')[0]}: {INSTALL}") from None
