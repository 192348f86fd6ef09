"""What a schema allows at one place of a document, and the sentence for a value that is not it.

Works on pydantic's error details and the JSON schema of the model, so that a sentence can name
both ends of a range and the known keys. Pure; used by `document` only.
"""

from __future__ import annotations

import difflib
from collections.abc import Mapping, Sequence
from typing import Any

from pydantic_core import ErrorDetails

Schema = Mapping[str, Any]

_RANGE_TYPES = {"greater_than", "greater_than_equal", "less_than", "less_than_equal"}
_BOUNDS = (
    ("exclusiveMinimum", "> "),
    ("minimum", ">= "),
    ("exclusiveMaximum", "< "),
    ("maximum", "<= "),
)
_NOUNS = {
    "number": "a number",
    "integer": "a whole number",
    "boolean": "true or false",
    "string": "text",
    "array": "a list",
    "object": "a section of keys",
    "null": "empty",
}


def sentence(detail: ErrorDetails, document: Any, root: Schema) -> str:
    """One pydantic error about `document` -> `path: value is wrong, and what is allowed`.

    `root` is the JSON schema of the whole model.
    """
    kind, location = detail["type"], detail["loc"]
    path, value = _path(location, document)
    allowed = expected(_at(location, root), root)
    if kind in ("union_tag_invalid", "union_tag_not_found"):
        discriminator = _discriminator(_at(location, root) or {})
        path, value = _path((*location, str(discriminator.get("propertyName"))), document)
        allowed = "one of " + ", ".join(discriminator.get("mapping", ()))
    if kind == "extra_forbidden":
        return _unknown_key(path, _at(location[:-1], root))
    must = f" (must be {allowed})" if allowed else ""
    if kind in ("missing", "union_tag_not_found"):
        return f"{path} is missing{must}"
    where = f"{path}: " if path else ""
    if kind in _RANGE_TYPES:
        return f"{where}{shown(value)} is out of range{must}"
    if kind == "finite_number":
        return f"{where}{shown(value)} is not finite{must}"
    if kind in ("value_error", "assertion_error"):
        return f"{where}{detail['msg'].split(', ', 1)[-1]}"
    if allowed:
        return f"{where}{shown(value)} is not {allowed}"
    return f"{where}{shown(value)}: {detail['msg'][:1].lower()}{detail['msg'][1:]}"


def place(detail: ErrorDetails, document: Any) -> str:
    """The dotted key path that one pydantic error about `document` is about."""
    return _path(detail["loc"], document)[0]


def expected(schema: Schema | None, root: Schema) -> str:
    """A phrase such as `a number > 0 and <= 2`, or empty when the schema does not say."""
    if schema is None:
        return ""
    schema = _resolved(schema, root)
    if "const" in schema:
        return shown(schema["const"])
    if "enum" in schema:
        return "one of " + ", ".join(str(choice) for choice in schema["enum"])
    members = schema.get("oneOf") or schema.get("anyOf")
    if members:
        phrases = dict.fromkeys(expected(member, root) for member in members)
        return " or ".join(phrase for phrase in phrases if phrase)
    noun = _NOUNS.get(schema.get("type", ""), "")
    bounds = " and ".join(f"{sign}{schema[key]:g}" for key, sign in _BOUNDS if key in schema)
    return f"{noun} {bounds}{_size(schema, root)}".replace("  ", " ").strip()


def shown(value: Any) -> str:
    """A value as it would stand in a message: short, text in quotes."""
    if value is None:
        return "an empty value"
    text = str(value).lower() if isinstance(value, bool) else repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


def _size(schema: Schema, root: Schema) -> str:
    if schema.get("type") == "string":
        least, most, unit = schema.get("minLength"), schema.get("maxLength"), "characters"
    else:
        least, most, unit = schema.get("minItems"), schema.get("maxItems"), "entries"
    if least is None and most is None:
        return ""
    if least == most:
        items: Sequence[Schema] = schema.get("prefixItems", ())
        phrases = dict.fromkeys(expected(item, root) for item in items)
        each = f", each {next(iter(phrases))}" if len(phrases) == 1 and any(phrases) else ""
        return f" of {least} {unit}{each}"
    if most is None:
        return f" of at least {least} {unit}"
    return f" of {least or 0} to {most} {unit}"


def _unknown_key(path: str, section: Schema | None) -> str:
    known = sorted((section or {}).get("properties", {}))
    key = path.rpartition(".")[2]
    near = difflib.get_close_matches(key, known, n=1)
    hint = f", did you mean {near[0]}?" if near else ""
    return f"{path} is not a known key{hint} (known keys: {', '.join(known) or 'none'})"


def _path(location: tuple[int | str, ...], document: Any) -> tuple[str, Any]:
    """Dotted path and value in the document. The names pydantic puts in between for the members
    of a union are no part of the document and are left out; a missing key ends the path."""
    keys: list[str] = []
    value = document
    for position, part in enumerate(location):
        in_list = isinstance(part, int) and isinstance(value, list) and part < len(value)
        if in_list or (isinstance(value, Mapping) and part in value):
            value = value[part]
        elif position == len(location) - 1 and isinstance(value, (Mapping, list)):
            value = None
        else:
            continue
        keys.append(str(part))
    return ".".join(keys), value


def _discriminator(schema: Schema) -> Schema:
    """Of a tagged union, also of one that may be empty."""
    unions = (schema, *schema.get("anyOf", ()))
    found: Schema = next((u["discriminator"] for u in unions if "discriminator" in u), {})
    return found


def _at(location: tuple[int | str, ...], root: Schema) -> Schema | None:
    """The schema of a place, or None where it cannot be told."""
    schema: Schema | None = _resolved(root, root)
    for part in location:
        if schema is None:
            return None
        schema = _step(schema, part, root)
    return schema


def _step(schema: Schema, part: int | str, root: Schema) -> Schema | None:
    members = schema.get("oneOf") or schema.get("anyOf")
    if members:
        return _member(schema, members, part, root)
    if isinstance(part, int):
        items = schema.get("prefixItems", ())
        entry = items[part] if part < len(items) else schema.get("items")
    else:
        entry = schema.get("properties", {}).get(part, schema.get("additionalProperties"))
    return _resolved(entry, root) if isinstance(entry, Mapping) else None


def _member(
    schema: Schema, members: Sequence[Schema], part: int | str, root: Schema
) -> Schema | None:
    """The member of a union that pydantic means: by tag, by title, or the one that has the key."""
    tagged = schema.get("discriminator", {}).get("mapping", {}).get(part)
    if tagged:
        return _resolved({"$ref": tagged}, root)
    resolved = [_resolved(member, root) for member in members]
    for member in resolved:
        if member.get("title") == part:
            return member
    steps = [step for step in (_step(member, part, root) for member in resolved) if step]
    return steps[0] if len(steps) == 1 else None


def _resolved(schema: Schema, root: Schema) -> Schema:
    while "$ref" in schema:
        name = str(schema["$ref"]).rpartition("/")[2]
        schema = root["$defs"][name]
    return schema
