"""The files of the shipped configuration, by name. This module and `reading` open no other file.

An installed package has `config/` inside it; a checkout has it beside the packages.
"""

from __future__ import annotations

from collections.abc import Sequence
from importlib import resources
from pathlib import Path

from offboard.documents.reading import DocumentError


def directory() -> Path:
    """The folder of the shipped configuration."""
    package = Path(str(resources.files("offboard")))
    inside = package / "_config"
    return inside if inside.is_dir() else package.parent / "config"


def names(folder: str) -> list[str]:
    """The names in one folder, for example `scenarios`, sorted."""
    return sorted(path.stem for path in (directory() / folder).glob("*.yaml"))


def locate(name: str, folder: str, kind: str, others: Sequence[str] = ()) -> Path:
    """The file with a shipped name, or the file named: a name with a `/` or that ends in .yaml or
    .yml. Raises DocumentError with the known names, `others` among them."""
    if name.endswith((".yaml", ".yml")) or "/" in name:
        return Path(name)
    candidate = directory() / folder / f"{name}.yaml"
    if candidate.is_file():
        return candidate
    known = sorted((*names(folder), *others))
    raise DocumentError(f"there is no {kind} named {name!r}; known are {', '.join(known)}")


def read_text(path: Path) -> str:
    """The content of a UTF-8 file. Raises DocumentError."""
    try:
        return path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or "not UTF-8 text"
        raise DocumentError(f"{path} cannot be read: {reason}") from None
