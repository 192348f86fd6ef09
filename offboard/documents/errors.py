"""Errors that the user can fix: the exceptions, and values and names as a sentence shows them."""

from __future__ import annotations

import sysconfig
import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

_PACKAGE, _STANDARD = str(Path(__file__).parents[1]), sysconfig.get_path("stdlib")


class UserError(Exception):
    """An error that the user can fix. `str()` says what is wrong and what to do, without a
    traceback; the commands print it and exit with code 2. `is_usage`: what was asked for is wrong;
    otherwise it may work another time."""

    is_usage = True


class DocumentError(UserError):
    """A configuration that cannot be used. `problems` holds one sentence for each problem; `str()`
    joins them with line breaks."""

    def __init__(self, *problems: str) -> None:
        super().__init__("\n".join(problems))
        self.problems = problems


def located(error: BaseException) -> str:
    """An exception of code from outside, such as a controller, in one sentence with file and line
    of the mistake: of the innermost call in the folder that was called from here. Reads no file."""
    walked = traceback.walk_tb(error.__traceback__)
    calls = [(frame.f_code.co_filename, line) for frame, line in walked]
    calls = [(file, line) for file, line in calls if _is_file(file)]
    outside = [(file, line) for file, line in calls if not file.startswith(_PACKAGE)]
    folder = str(Path(outside[0][0]).parent) if outside else ""
    theirs = [(file, line) for file, line in outside if file.startswith(folder)] or calls
    place = " ({}:{})".format(*theirs[-1]) if theirs else ""
    return " ".join(f"{type(error).__name__}: {error}{place}".split())


def _is_file(name: str) -> bool:
    """Whether it is neither of the standard library, or of its backport, nor of no file."""
    standard = name.startswith(_STANDARD) and "site-packages" not in name
    return not (standard or name.startswith("<") or "importlib_metadata" in name)


@contextmanager
def naming(source: str) -> Iterator[None]:
    """Put `source`, a file's name, before every problem of a DocumentError raised in the block."""
    try:
        yield
    except DocumentError as error:
        raise DocumentError(*(f"{source}: {each}" for each in error.problems)) from None


def shown(value: Any) -> str:
    """A value as text for a message: short, strings in quotes."""
    if value is None:
        return "an empty value"
    text = str(value).lower() if isinstance(value, bool) else repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


def abridged(name: object) -> str:
    """A name or path for a message: at most 100 characters, without what is no text."""
    text = str(name).encode(errors="backslashreplace").decode()
    return text if len(text) <= 100 else f"{text[:97]}..."
