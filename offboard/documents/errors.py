"""Errors of configuration: the exceptions, and one sentence for each error that pydantic reports.

A sentence names the key, the offending value and what is allowed, in pydantic's words:
`period_s: 7 should be less than or equal to 0.5`.
"""

from __future__ import annotations

import difflib
import sysconfig
import traceback
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from pydantic_core import ErrorDetails

Schema = Mapping[str, Any]
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
    of the mistake: of the innermost call in the folder that was called from here."""
    calls = [call for call in traceback.extract_tb(error.__traceback__) if _is_file(call.filename)]
    outside = [call for call in calls if not call.filename.startswith(_PACKAGE)]
    folder = str(Path(outside[0].filename).parent) if outside else ""
    theirs = [call for call in outside if call.filename.startswith(folder)] or calls
    place = f" ({theirs[-1].filename}:{theirs[-1].lineno})" if theirs else ""
    return " ".join(f"{type(error).__name__}: {error}{place}".split())


def _is_file(name: str) -> bool:
    """Whether it is neither of the standard library nor of no file."""
    standard = name.startswith(_STANDARD) and "site-packages" not in name
    return not (standard or name.startswith("<"))


@contextmanager
def naming(source: str) -> Iterator[None]:
    """Put `source`, a file's name, before every problem of a DocumentError raised in the block."""
    try:
        yield
    except DocumentError as error:
        raise DocumentError(*(f"{source}: {each}" for each in error.problems)) from None


def sentence(detail: ErrorDetails, document: Any, schema: Schema) -> str:
    """The sentence for one pydantic error.

    `detail` is from `ValidationError.errors()`, `document` the value that was validated, `schema`
    the JSON schema of the whole model.
    """
    path = abridged(key_path(detail, document))
    kind, value = detail["type"], shown(detail["input"])
    if kind == "extra_forbidden":
        return _unknown_key(path, _places(detail["loc"][:-1], schema))
    if kind == "missing":
        return f"{path} is missing"
    if kind.startswith("union_tag"):
        places = _places(detail["loc"], schema)
        union = next(place["discriminator"] for place in places if "discriminator" in place)
        key, allowed = f"{path}.{union['propertyName']}", f"one of {', '.join(union['mapping'])}"
        tag = detail["ctx"].get("tag")
        return f"{key}: {tag!r} is not {allowed}" if tag else f"{key} is missing ({allowed})"
    _, separator, allowed = detail["msg"].partition(" should ")
    where = f"{path}: " if path else ""
    if separator:
        return f"{where}{value} should {allowed.replace(' after validation', '')}"
    return f"{where}{detail['msg'].removeprefix('Value error, ')}"


def key_path(detail: ErrorDetails, document: Any) -> str:
    """The dotted path of the key that a pydantic error is about.

    pydantic's location also holds the names of union members; these are no keys of `document`.
    """
    keys: list[str] = []
    value = document
    for part in detail["loc"]:
        has_key = isinstance(value, Mapping) and part in value
        has_index = isinstance(value, list) and isinstance(part, int) and part < len(value)
        if has_key or has_index:
            value = value[part]
            keys.append(str(part))
    if detail["type"] == "missing":
        keys.append(str(detail["loc"][-1]))
    return ".".join(keys)


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


def _unknown_key(path: str, sections: list[Schema]) -> str:
    known = sorted({key for section in sections for key in section.get("properties", ())})
    near = difflib.get_close_matches(path.rpartition(".")[2], known, n=1)
    hint = f", did you mean {near[0]}?" if near else ""
    return f"{path} is not a known key{hint} (known keys: {', '.join(known)})"


def _places(location: tuple[int | str, ...], root: Schema) -> list[Schema]:
    """The schemas that a value at this location may have."""
    places = list(_members(root, root))
    for part in location:
        children = [child for place in places for child in _children(place, part)]
        places = [member for child in children for member in _members(child, root)]
    return places


def _members(schema: Schema, root: Schema) -> Iterator[Schema]:
    """The schema, and the members if it is a union, with references resolved."""
    if "$ref" in schema:
        schema = root["$defs"][schema["$ref"].rpartition("/")[2]]
    yield schema
    for member in schema.get("oneOf", schema.get("anyOf", ())):
        yield from _members(member, root)


def _children(schema: Schema, part: int | str) -> Iterator[Schema]:
    """The schemas behind one part of a location: a key, an index or the tag of a union."""
    tagged = schema.get("discriminator", {}).get("mapping", {}).get(part)
    if tagged:
        yield {"$ref": tagged}
    key = "items" if isinstance(part, int) else "additionalProperties"
    child = schema.get("properties", {}).get(part, schema.get(key))
    if isinstance(child, Mapping):
        yield child
