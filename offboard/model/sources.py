"""The sources that machine code is made of: which they are, and a digest of their content."""

from __future__ import annotations

import functools
import hashlib
import re
from pathlib import Path

_ENTRY = re.compile(rb"^@entry", re.M)
_COMPILES = re.compile(rb"llvmlite|^@(?:kernel|entry)", re.M)
_IMPORT = re.compile(rb"^from ((?:offboard|simulator)[.\w]*) import (\([^)]*\)|.*)", re.M)
_NAME = re.compile(rb"\w+")
_CONSTANT = re.compile(rb"[A-Z][A-Z0-9_]*")


@functools.cache
def digest() -> str:
    """Hash of every module that compiles something, and of those whose constants it takes, by name
    or with the whole module: their machine code stands or falls as one."""
    sources = _contents()
    pending = [name for name, content in sources.items() if _COMPILES.search(content)]
    taken: set[str] = set()
    while pending:
        taken.add(name := pending.pop())
        pending += (_taken_from(sources[name]) & sources.keys()) - taken
    hashed = hashlib.sha256()
    for name in sorted(taken):
        hashed.update(name.encode() + b"\0" + sources[name])
    return hashed.hexdigest()[:16]


def _taken_from(content: bytes) -> set[str]:
    """The sources, some of which there are, of what a module takes constants from."""
    found: set[str] = set()
    for package, imported in _IMPORT.findall(content):
        place = package.decode().replace(".", "/")
        for name in _NAME.findall(imported):
            found.add(f"{place}.py" if _CONSTANT.fullmatch(name) else f"{place}/{name.decode()}.py")
    return found


def entry_modules() -> list[str]:
    """The modules with functions that are compiled for Python to call."""
    return sorted(
        name.removesuffix(".py").replace("/", ".")
        for name, content in _contents().items()
        if _ENTRY.search(content)
    )


def _contents() -> dict[str, bytes]:
    root = Path(__file__).resolve().parents[2]
    return {
        path.relative_to(root).as_posix(): path.read_bytes()
        for package in ("offboard", "simulator")
        for path in (root / package).rglob("*.py")
    }
