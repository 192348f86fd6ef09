"""Errors that the user can fix; values, names and exceptions formatted for messages and JSON; and
sentences about recurring events.
"""

from __future__ import annotations

import difflib
import json
import math
import os
import shlex
import sys
import traceback
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

EVERY_S = 1.0  # shortest time between two sentences of a `Repeated`
# packages in which `located` does not look for a mistake: importlib_metadata loads entry points,
# pydantic calls validators
_OURS = {"offboard", "importlib_metadata", "pydantic", *sys.stdlib_module_names}


class UserError(Exception):
    """An error that the user can fix. `str()` says what is wrong and what to do. A command that
    ends with it prints that text without a traceback and exits with `code` (default: that of the
    class)."""

    code = 2  # the request itself is wrong

    def __init__(self, sentence: str, code: int | None = None) -> None:
        super().__init__(sentence)
        self.code = code or self.code


class Unavailable(UserError):
    """The request is valid but cannot be met now: a link, lock or process is not available."""

    code = 3  # the same request may succeed later


class DocumentError(UserError):
    """A configuration cannot be used. `problems` holds one sentence for each problem; `str()`
    joins them with line breaks."""

    def __init__(self, *problems: str) -> None:
        super().__init__("\n".join(problems))
        self.problems = problems


def located(error: BaseException) -> str:
    """Format an exception of external code, such as a controller, as one sentence with the file and
    line of the mistake. That is the innermost call inside the package or folder that our code
    called. The sentence of a UserError is complete. Reads no file and never raises."""
    if isinstance(error, UserError):
        return str(error)
    calls = []  # package, folder, place
    for frame, line in traceback.walk_tb(error.__traceback__):
        package = str(frame.f_globals.get("__name__")).partition(".")[0]
        file = frame.f_code.co_filename
        calls.append((package, os.path.dirname(file), f" ({file}:{line})"))
    called = next((each for each in calls if each[0] not in _OURS), ("offboard", None))
    theirs = [each[2] for each in calls if each[0] == called[0] or each[1] == called[1]]
    place = theirs[-1] if theirs else ""
    try:
        said = str(error)
    except Exception:
        said = "it cannot be printed"
    return " ".join(f"{type(error).__name__}: {said}{place}".split())


@contextmanager
def naming(source: str) -> Iterator[None]:
    """Prefix every problem of a DocumentError that the block raises with `source`, a file name."""
    try:
        yield
    except DocumentError as error:
        raise DocumentError(*(f"{source}: {each}" for each in error.problems)) from None


def wrong_result(function: Any, result: object, wanted: str) -> DocumentError:
    """The error for a function of external code that returns `result` instead of `wanted`. It has
    the file and line of the function."""
    code = getattr(function, "__code__", None)
    place = f" ({code.co_filename}:{code.co_firstlineno})" if code else ""
    name = getattr(function, "__qualname__", type(function).__name__)
    return DocumentError(f"{name} returns {abridged(repr(result))}, not {wanted}{place}")


@contextmanager
def outside(what: str) -> Iterator[None]:
    """Convert any exception of external code in the block, also SystemExit, to a DocumentError that
    begins with `what` and has file and line. A UserError is not converted."""
    try:
        yield
    except UserError:
        raise
    except (Exception, SystemExit) as error:
        raise DocumentError(f"{what}: {located(error)}") from error


def shown(value: Any) -> str:
    """A value as text for a message: at most 60 characters, strings in quotes."""
    if value is None:
        return "an empty value"
    text = str(value).lower() if isinstance(value, bool) else repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


def abridged(name: object) -> str:
    """A name or path for a message: at most 100 characters; bytes that are not text are escaped."""
    text = str(name).encode(errors="backslashreplace").decode()
    return text if len(text) <= 100 else f"{text[:97]}..."


def typed(*words: str | Path) -> str:
    """The words of a command, quoted for a shell. A path that begins with - gets a leading ./, so
    that it is not taken for an option."""

    def plainly(word: str | Path) -> str:
        is_dashed = isinstance(word, Path) and str(word).startswith("-")
        return f"./{word}" if is_dashed else str(word)

    return shlex.join(map(plainly, words))


def meant(name: str, known: Iterable[str]) -> str:
    """Return ", did you mean NAME?" with the closest known name, or with the first one that
    contains `name`; empty if there is neither."""
    names = list(known)
    near = difflib.get_close_matches(name, names, n=1)
    if len(name) >= 3:
        near += [each for each in names if name in each]
    return f", did you mean {near[0]}?" if near else ""


def counted(number: int, noun: str) -> str:
    """A number and its noun, for example "1 flight" or "2 flights"."""
    return f"{number} {noun}{'s' * (number != 1)}"


def plain(value: Any, digits: int | None = None) -> Any:
    """Convert a value for JSON, which has no NaN and no infinity: a float that is not finite
    becomes None, other floats are rounded to `digits` significant digits, tuples become lists."""

    def number(text: str) -> float:
        return float(f"{float(text):.{digits}g}" if digits else text)

    return json.loads(json.dumps(value), parse_float=number, parse_constant=lambda _: None)


def install(extra: str) -> str:
    """The pip command that installs the libraries of an extra. It names the libraries, because this
    package itself is on no index: it was installed from a checkout or a wheel."""
    from importlib.metadata import requires

    marked = (each.partition(";") for each in requires("pso-offboard") or ())
    libraries = [name.strip() for name, _, marker in marked if extra in marker.split("extra")[-1]]
    return "pip install " + " ".join(f"'{each}'" for each in libraries)


class Repeated:
    """A sentence for the user about an event that recurs. `add` each event with its figure; `news`
    returns the sentence, at most once a second.

    `text` is a format string with `most` (the greatest figure since the last sentence), `total`
    (the sum of these figures) and `times` (for example " (the longest of 4)"; empty for a single
    event). Times are seconds of any clock.
    """

    def __init__(self, text: str) -> None:
        self._text = text
        self._said_s = -math.inf
        self._figures: list[float] = []

    def add(self, figure: float) -> None:
        self._figures.append(figure)

    def news(self, now_s: float) -> str:
        """The sentence about the events since the last one; empty if there were none, or if the
        last sentence is less than EVERY_S old."""
        figures = self._figures
        if not figures or now_s - self._said_s < EVERY_S:
            return ""
        self._said_s, self._figures = now_s, []
        times = f" (the longest of {len(figures)})" if len(figures) > 1 else ""
        return self._text.format(most=max(figures), total=sum(figures), times=times)
