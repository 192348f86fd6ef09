"""The sources that machine code is made of: which they are, and a digest of their content."""

from __future__ import annotations

import functools
import hashlib
import re
from pathlib import Path

_ENTRY = re.compile(rb"^@entry", re.M)
_COMPILES = re.compile(rb"njit|llvmlite|^@(?:kernel|entry)", re.M)
_IMPORT = re.compile(rb"^from ((?:offboard|simulator)[.\w]*) import (\([^)]*\)|.*)", re.M)
_CONSTANT = re.compile(rb"\b[A-Z][A-Z0-9_]+\b")


@functools.cache
def digest() -> str:
    """Hash of every module that compiles something, and of those whose constants it takes: their
    machine code stands or falls as one."""
    sources = _contents()
    pending = [name for name, content in sources.items() if _COMPILES.search(content)]
    taken: set[str] = set()
    while pending:
        taken.add(name := pending.pop())
        for module, names in _IMPORT.findall(sources[name]):
            source = module.decode().replace(".", "/") + ".py"
            if _CONSTANT.search(names) and source in sources and source not in taken:
                pending.append(source)
    hashed = hashlib.sha256()
    for name in sorted(taken):
        hashed.update(name.encode() + b"\0" + sources[name])
    return hashed.hexdigest()[:16]


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
