"""What a user is told: errors that the user can fix, values and names as a sentence or JSON shows
them, and sentences on what happens again and again.
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

EVERY_S = 1.0  # at most one sentence of a `Repeated`
# packages that a mistake from outside is not in; the backport calls entry points, too
_OURS = {"offboard", "importlib_metadata", *sys.stdlib_module_names}


class UserError(Exception):
    """An error that the user can fix. `str()` says what is wrong and what to do, without a
    traceback; a command that it ends prints it and exits with `code`: that of its class, unless
    another is given."""

    code = 2  # what was asked for is wrong

    def __init__(self, sentence: str, code: int | None = None) -> None:
        super().__init__(sentence)
        self.code = code or self.code


class Unavailable(UserError):
    """The request is valid but cannot be met now: a link, lock or process is not available."""

    code = 3  # it may work another time


class DocumentError(UserError):
    """A configuration that cannot be used. `problems` holds one sentence for each problem; `str()`
    joins them with line breaks."""

    def __init__(self, *problems: str) -> None:
        super().__init__("\n".join(problems))
        self.problems = problems


def located(error: BaseException) -> str:
    """An exception of code from outside, such as a controller, in one sentence with file and line
    of the mistake: of the innermost call in the package or folder that was called from here. Reads
    no file. Never raises an exception of its own."""
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
    """Put `source`, a file's name, before every problem of a DocumentError raised in the block."""
    try:
        yield
    except DocumentError as error:
        raise DocumentError(*(f"{source}: {each}" for each in error.problems)) from None


@contextmanager
def outside(what: str) -> Iterator[None]:
    """Code from outside is called in the block: whatever it raises, also to end the program, is a
    DocumentError after `what`, with file and line. A UserError stays one."""
    try:
        yield
    except UserError:
        raise
    except (Exception, SystemExit) as error:
        raise DocumentError(f"{what}: {located(error)}") from error


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


def typed(*words: str | Path) -> str:
    """Words of a command as they are typed in a shell; a path that begins with - is no option."""

    def plainly(word: str | Path) -> str:
        is_dashed = isinstance(word, Path) and str(word).startswith("-")
        return f"./{word}" if is_dashed else str(word)

    return shlex.join(map(plainly, words))


def meant(name: str, known: Iterable[str]) -> str:
    """ ", did you mean NAME?" with the nearest of the known names, or the first that contains it;
    empty where there is none."""
    names = list(known)
    near = difflib.get_close_matches(name, names, n=1)
    if len(name) >= 3:
        near += [each for each in names if name in each]
    return f", did you mean {near[0]}?" if near else ""


def counted(number: int, noun: str) -> str:
    """ "1 flight", "2 flights"."""
    return f"{number} {noun}{'s' * (number != 1)}"


def plain(value: Any, digits: int | None = None) -> Any:
    """The value for JSON, which has no NaN and no infinity: None for each float that is not finite,
    and lists for tuples; the other floats with `digits` significant digits."""

    def number(text: str) -> float:
        return float(f"{float(text):.{digits}g}" if digits else text)

    return json.loads(json.dumps(value), parse_float=number, parse_constant=lambda _: None)


def install(extra: str) -> str:
    """The line that installs the libraries of an extra. It names them and not this package, which
    was installed from a checkout or a wheel, and is on no index."""
    from importlib.metadata import requires

    marked = (each.partition(";") for each in requires("pso-offboard") or ())
    libraries = [name.strip() for name, _, marker in marked if extra in marker.split("extra")[-1]]
    return "pip install " + " ".join(f"'{each}'" for each in libraries)


class Repeated:
    """One sentence for the user. `add` what happened, with a figure, and ask `news` for it.

    `text` is a format of `most` (the greatest figure since the last sentence), `total` (their sum)
    and `times` (" (the longest of 4)", empty for a single one). Times are seconds of any clock.
    """

    def __init__(self, text: str) -> None:
        self._text = text
        self._said_s = -math.inf
        self._figures: list[float] = []

    def add(self, figure: float) -> None:
        self._figures.append(figure)

    def news(self, now_s: float) -> str:
        """What to say now; empty if nothing happened, or within a second of the last time."""
        figures = self._figures
        if not figures or now_s - self._said_s < EVERY_S:
            return ""
        self._said_s, self._figures = now_s, []
        times = f" (the longest of {len(figures)})" if len(figures) > 1 else ""
        return self._text.format(most=max(figures), total=sum(figures), times=times)
