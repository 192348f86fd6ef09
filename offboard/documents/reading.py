"""Reads configuration files: converts YAML text to a validated value, or reports what is wrong.

`read` and `validate` convert the text of every configuration file to a frozen pydantic value.
Scalars follow YAML 1.2 (`1e-3` is a number, `no` and `12:30` are text) and are checked strictly (no
text for numbers, no true for 1); duplicate keys, aliases and tags are refused. The sentence for a
problem has the line and column of the key, the value, and what is allowed, as pydantic words it:

    flight.yaml, line 4, column 1: period_s: 7 should be less than or equal to 0.5
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Literal, TypeVar

import yaml
from pydantic import BaseModel, ValidationError
from yaml.representer import SafeRepresenter

from offboard.documents.errors import DocumentError, abridged, counted, meant, shown
from offboard.documents.shipped import KINDS, NAMING, beside, folder, locate, read_text

if TYPE_CHECKING:
    from pydantic_core import ErrorDetails

M = TypeVar("M", bound=BaseModel)
DESCRIPTION_SIZE = 200
PROBLEMS_MOST = 10
# words in messages of pydantic -> the terms of YAML that replace them
WORDS = {
    " after validation": "",
    "an object": "a mapping of keys to values",
    "a valid array": "a list",
}


class Section(dict[str, Any]):
    """A mapping in a file. `places` has, for error messages, file, line and column of each key, or
    the option that set it; `description` is that of the whole file."""

    description = ""

    def __init__(self, values: Mapping[str, Any]) -> None:
        super().__init__(values)
        self.places: dict[str, str] = dict(getattr(values, "places", {}))


yaml.add_representer(Section, SafeRepresenter.represent_dict, Dumper=yaml.SafeDumper)


def descriptions(kind: str) -> dict[str, str]:
    """The description of each shipped file of one kind, by name."""
    paths = sorted(folder(kind).glob("*.yaml"))
    return {path.stem: read(read_text(path), str(path)).description for path in paths}


def load_document(name: str, kind: str, model: type[M]) -> tuple[M, str]:
    """Load and validate a file, given by shipped name or path; paths in it are relative to it.
    Returns the value, and the path for error messages. Raises DocumentError."""
    path = locate(name, kind)
    raw = read(read_text(path), str(path), kind)
    named = beside(raw, path) if kind in NAMING else raw
    return validate(named, model, str(path)), str(path)


def parse(text: str, model: type[M], source: str, kind: str = "") -> M:
    """Convert YAML `text` to an instance of `model`. `source` names the text in errors (a file
    name), for `kind` see `read`. Raises DocumentError with the problems found."""
    return validate(read(text, source, kind), model, source)


def read(text: str, source: str, kind: str = "") -> Section:
    """Convert YAML `text` to a raw mapping, which is not validated yet. An empty document is an
    empty mapping. `kind`, one of KINDS, is the kind of file that is expected; empty: any. Raises
    DocumentError, also if a key shows that the file is of another kind.

    Every file may have a `description`, a line that `offboard list` prints. It describes the file
    and not the value: it is removed here, so that it is not recorded beside values that --set has
    changed.
    """
    value = _loaded(text, source)
    value = Section({}) if value is None else value
    if not isinstance(value, Section):
        raise DocumentError(f"{source}: expected a mapping of keys to values, not {shown(value)}")
    line = value.description = value.pop("description", "")
    if not isinstance(line, str) or len(line) > DESCRIPTION_SIZE:
        raise DocumentError(
            f"{source}: description: {shown(line)} should be text of at most {DESCRIPTION_SIZE} "
            "characters"
        )
    found = kind_of(value)
    if kind and found and found != kind:
        raise DocumentError(f"{source} is a {found} file; a {kind} file is needed here")
    return value


def kind_of(raw: Mapping[str, Any]) -> str:
    """The kind of a file, recognised by a key that only this kind has; empty if there is none."""
    return next((kind for kind, (_, keys) in KINDS.items() if keys & raw.keys()), "")


def override(mapping: Mapping[str, Any], assignment: str) -> Section:
    """Return a copy of the raw `mapping` with one `key.path=value` of --set applied.

    The value is YAML; a number in the path indexes a list. `validate` checks the keys, and its
    errors name the option. Raises DocumentError as `assigned` does, and for an index that the list
    does not have.
    """
    path, value = assigned(assignment)
    changed: Section = _with(mapping, path.split("."), value, _option(assignment))
    return changed


def assigned(assignment: str) -> tuple[str, Any]:
    """Split `key.path=value` into path and parsed value. Raises DocumentError if the path or the
    `=` is missing, or if the value is not YAML."""
    path, separator, text = assignment.partition("=")
    keys = [key.strip() for key in path.split(".")]
    if not separator or not all(keys):
        raise DocumentError(f"{_option(assignment)}: expected key.path=value")
    return ".".join(keys), _loaded(text, _option(assignment))


def _option(assignment: str) -> str:
    return f"--set {abridged(assignment)}"


def validate(
    mapping: Mapping[str, Any], model: type[M], source: str, extra: Literal["ignore"] | None = None
) -> M:
    """Convert a raw mapping to an instance of `model`. Raises DocumentError with the problems
    found, at most PROBLEMS_MOST of them.

    `source` names the file in errors about values whose place in it is not known. With `extra`,
    keys that `model` does not have are ignored.
    """
    try:
        # JSON mode is strict about scalars, but allows a list for a tuple and text for an enum
        return model.model_validate_json(json.dumps(mapping), strict=True, extra=extra)
    except ValidationError as error:
        details = error.errors(include_url=False)
        # pydantic does not count refused items: drop the "too short" error that follows from them
        outer = {each["loc"][:n] for each in details for n in range(len(each["loc"]))}
        details = [d for d in details if d["type"] != "too_short" or d["loc"] not in outer]
        problems = []
        for detail in details[:PROBLEMS_MOST]:
            path, origin = _key_path(detail, mapping, source)
            problems.append(f"{origin}: {_sentence(detail, abridged(path), model)}")
        if len(details) > PROBLEMS_MOST:
            problems.append(f"{source}: and {len(details) - PROBLEMS_MOST} more problems")
        raise DocumentError(*problems) from None


def _sentence(detail: ErrorDetails, path: str, model: type[BaseModel]) -> str:
    """The sentence for one error of pydantic."""
    kind, context = detail["type"], detail.get("ctx", {})
    if kind == "extra_forbidden":
        return _unknown_key(path, model)
    if kind == "missing":
        return f"{path} is missing"
    if kind.startswith("union_tag"):
        key = f"{path}.{context['discriminator'].strip(chr(39))}"
        if "tag" not in context:
            return f"{key} is missing"
        return f"{key}: {context['tag']!r} is not one of {context['expected_tags']}"
    _, separator, allowed = detail["msg"].partition(" should ")
    where = f"{path}: " if path else ""
    if separator:
        value = shown(detail["input"])
        for words, ours in WORDS.items():
            allowed = allowed.replace(words, ours)
        return f"{where}{value} should {allowed}"
    return f"{where}{detail['msg'].removeprefix('Value error, ')}"


def _unknown_key(path: str, model: type[BaseModel]) -> str:
    """The sentence for an unknown key. It lists the known keys if the section has one class."""
    *sections, key = path.split(".")
    section: Any = model
    for name in sections:
        field = getattr(section, "model_fields", {}).get(name)
        section = field and field.annotation
    known = sorted(getattr(section, "model_fields", ()))
    all_known = f" (known keys: {', '.join(known)})" if known else ""
    return f"{path} is not a known key{meant(key, known)}{all_known}"


def _key_path(detail: ErrorDetails, document: Any, source: str) -> tuple[str, str]:
    """The dotted path of the key that an error of pydantic is about, and its origin: the place of
    the key in a file, or the option that set it.

    The location that pydantic gives also has names of union members, which are no keys of
    `document`.
    """
    keys: list[str] = []
    value = document
    for part in detail["loc"]:
        has_key = isinstance(value, Mapping) and part in value
        has_index = isinstance(value, list) and isinstance(part, int) and part < len(value)
        if has_key or has_index:
            source = getattr(value, "places", {}).get(part, source)
            value = value[part]
            keys.append(str(part))
    if detail["type"] == "missing":
        keys.append(str(detail["loc"][-1]))
    return ".".join(keys), source


class _Loader(yaml.SafeLoader):
    """Loads YAML with the scalars of YAML 1.2. Mappings become Sections; aliases, tags and
    duplicate keys are errors."""

    def compose_node(self, parent: Any, index: Any) -> Any:
        event: Any = self.peek_event()  # type: ignore[no-untyped-call]
        if isinstance(event, yaml.AliasEvent) or event.tag is not None:
            raise _refusal("aliases and tags are not allowed", event)
        return super().compose_node(parent, index)

    def section(self, node: yaml.MappingNode) -> Section:
        section = Section({})
        for key, value in node.value:
            if not isinstance(key, yaml.ScalarNode):
                raise _refusal("a key must be a single word", key)
            if key.value in section:
                raise _refusal(f"the key {key.value!r} is given twice", key)
            section[key.value] = self.construct_object(value, deep=True)
            section.places[key.value] = _place(key.start_mark)
        return section

    def integer(self, node: yaml.ScalarNode) -> int:
        return int(node.value, 16 if "x" in node.value else 10)


_TAG = "tag:yaml.org,2002:"
_Loader.yaml_implicit_resolvers = {}  # remove those of YAML 1.1
for _kind, _pattern in {
    "null": "(~|null|Null|NULL|)$",
    "bool": "(true|True|TRUE|false|False|FALSE)$",
    "int": "([-+]?[0-9]{1,400}|0x[0-9a-fA-F]{1,300})$",
    "float": r"([-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?|[-+]?\.inf|\.nan)$",
}.items():
    _Loader.add_implicit_resolver(_TAG + _kind, re.compile(_pattern), None)
_Loader.add_constructor(f"{_TAG}map", _Loader.section)
_Loader.add_constructor(f"{_TAG}int", _Loader.integer)


def _loaded(text: str, source: str) -> Any:
    try:
        loader = _Loader(text)
        loader.name = source
        return loader.get_single_data()
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        place = _place(mark) if mark else source
        problem = getattr(error, "problem", None) or " ".join(str(error).split())
        if problem.startswith("but "):  # the second half of a sentence
            problem = f"{getattr(error, 'context', '')}, {problem}"
        wrong = isinstance(error, yaml.scanner.ScannerError | yaml.parser.ParserError)
        hint = "; check indentation, colons and quotes" if wrong else ""
        raise DocumentError(f"{place}: {problem}{hint}") from None
    except RecursionError:
        raise DocumentError(f"{source}: nested too deeply") from None


def _place(mark: yaml.Mark) -> str:
    return f"{mark.name}, line {mark.line + 1}, column {mark.column + 1}"


def _refusal(problem: str, where: Any) -> yaml.YAMLError:
    return yaml.MarkedYAMLError(problem=problem, problem_mark=where.start_mark)


def _with(value: Any, keys: list[str], new: Any, option: str) -> Any:
    """Return a copy of `value` in which the entry at the path `keys` is `new`; missing sections are
    created. `option` is recorded as the origin of the entry."""
    if not keys:
        return new
    key, rest = keys[0], keys[1:]
    if isinstance(value, list):
        if key not in map(str, range(len(value))):
            entries = f"a list of {counted(len(value), 'value')}, counted from 0"
            raise DocumentError(f"{option}: {shown(key)} is no index of {entries}")
        index = int(key)
        changed = _with(value[index], rest, new, option)
        return [*value[:index], changed, *value[index + 1 :]]
    section = Section(value if isinstance(value, Mapping) else {})
    before = section.get(key)
    section[key] = _with(before, rest, new, option)
    if not rest or not isinstance(before, Mapping):  # the value no longer comes from the file
        section.places[key] = option
    return section
