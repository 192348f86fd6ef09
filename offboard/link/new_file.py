"""A new file that is complete or not there."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from errno import EEXIST
from pathlib import Path
from typing import BinaryIO

from offboard.documents.errors import UserError


@contextmanager
def new_file(path: Path) -> Iterator[BinaryIO]:
    """Write a file that must not exist. It appears at the end of the block, unless the block or the
    disk fails. Raises UserError."""
    incomplete = path.with_name(f".{os.getpid()}.part")
    try:
        with incomplete.open("xb") as file:
            yield file
        try:
            os.link(incomplete, path)  # unlike a rename, refuses to replace a file
        except PermissionError:  # a file system without links
            if path.exists():
                raise FileExistsError(EEXIST, os.strerror(EEXIST)) from None
            incomplete.rename(path)
    except OSError as error:
        raise UserError(f"{path} cannot be written ({error.strerror or error})") from None
    finally:
        with suppress(OSError):
            incomplete.unlink()
