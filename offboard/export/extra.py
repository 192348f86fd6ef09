"""Libraries that are an extra of the package."""

from __future__ import annotations

from importlib import import_module
from typing import Any

from offboard.documents.errors import UserError
from offboard.documents.extras import install


def library(name: str, kind: str) -> Any:
    """Import a library of the extra. Raises UserError with the line that installs it."""
    try:
        return import_module(name)
    except ImportError:
        line = install("export")
        raise UserError(f"--to {kind} needs {name.partition('.')[0]}: {line}") from None
