"""A new file that is complete or not there, and libraries that are an extra of the package."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from importlib import import_module
from pathlib import Path
from typing import Any, BinaryIO

from offboard.documents.errors import UserError

INSTALL = "pip install 'pso-offboard[export]'"


@contextmanager
def new_file(path: Path) -> Iterator[BinaryIO]:
    """Open a file that does not exist yet; it is removed if the block fails. Raises UserError."""
    try:
        with path.open("xb") as file:
            try:
                yield file
            except BaseException:
                with suppress(OSError):
                    path.unlink()
                raise
    except FileExistsError:
        raise UserError(f"{path} exists already; choose another file with -o") from None
    except OSError as error:
        raise UserError(f"{path} cannot be written: {error.strerror or error}") from None


def library(name: str, kind: str) -> Any:
    """Import a library of the extra. Raises UserError with the line that installs it."""
    try:
        return import_module(name)
    except ImportError:
        raise UserError(f"--to {kind} needs {name.partition('.')[0]}: {INSTALL}") from None
