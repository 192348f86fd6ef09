"""Files of the shipped configuration: where they are, their names and descriptions.

In an installed package `config/` lies inside the package, in a checkout beside it.
"""

from __future__ import annotations

from collections.abc import Sequence
from importlib import resources
from pathlib import Path

from offboard.documents.errors import DocumentError

# kind of file -> its folder
FOLDERS = {
    "reference": "references",
    "controller": "controllers",
    "vehicle": "vehicles",
    "scenario": "scenarios",
    "configuration": "",
}


def directory() -> Path:
    """The folder of the shipped configuration."""
    package = Path(str(resources.files("offboard")))
    inside = package / "_config"
    return inside if inside.is_dir() else package.parent / "config"


def names(folder: str) -> list[str]:
    """The names of the files in one folder, for example `scenarios`, sorted."""
    return sorted(path.stem for path in (directory() / folder).glob("*.yaml"))


def descriptions(folder: str) -> dict[str, str]:
    """Name -> description of the files in one folder."""
    from offboard.documents.reading import description  # late: --help needs no YAML

    paths = {name: directory() / folder / f"{name}.yaml" for name in names(folder)}
    return {name: description(read_text(path), str(path)) for name, path in paths.items()}


def overview(*kinds: str) -> str:
    """The names of the shipped files, a paragraph for each kind: for the end of `--help`."""
    return "\n\n".join(f"Shipped {kind}s: {', '.join(names(FOLDERS[kind]))}." for kind in kinds)


def locate(name: str, folder: str, kind: str, others: Sequence[str] = ()) -> Path:
    """The file with a shipped name, or the file itself where `name` contains a `/` or ends in .yaml
    or .yml. Raises DocumentError with the known names, `others` among them."""
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
