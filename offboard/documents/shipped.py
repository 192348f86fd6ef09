"""Names and paths of the shipped configuration files.

The directory `config/` is inside an installed package; in a checkout it is beside the package.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from offboard.documents.errors import DocumentError, abridged, meant, shown

SIZE_MOST = 500_000  # characters of a file: a table of 10,000 rows, or 5 s to parse as YAML

PARTS = ("vehicle", "controller", "reference")  # parts of a flight configuration, one file each
# kind of file -> its folder, and keys that show the kind unless a kind above has matched
KINDS = {
    "reference": ("references", {"shape"}),
    "controller": ("controllers", {"law"}),
    "vehicle": ("vehicles", {"mass_kg"}),
    "scenario": ("scenarios", {"conditions", "faults"}),
    "campaign": (
        "campaigns",
        {
            "controllers", "references", "vehicles", "sim_vehicles", "firmwares", "scenarios",
            "parameters", "sample", "search", "seeds", "require", "promises", "keep",
        },
    ),
    "tuning": ("tunings", {"training", "validation"}),
    "configuration": ("", set(PARTS)),
}  # fmt: skip

NAMING = ("campaign", "tuning")  # the kinds whose texts are names of files


def directory() -> Path:
    """The folder of the shipped configuration."""
    package = Path(__file__).parents[1]
    inside = package / "_config"
    return inside if inside.is_dir() else package.parent / "config"


def folder(kind: str) -> Path:
    """The folder of the files of one kind, for example `scenario`."""
    return directory() / KINDS[kind][0]


def names(kind: str) -> list[str]:
    """The names of the files of one kind, sorted."""
    return sorted(path.stem for path in folder(kind).glob("*.yaml"))


def overview(*kinds: str) -> str:
    """The names of the shipped files, one paragraph for each kind, for the end of `--help`."""
    return "\n\n".join(f"Shipped {kind}s: {', '.join(names(kind))}." for kind in kinds)


def is_file(name: str) -> bool:
    """Whether `name` is the path of a file, and not the name of a shipped file."""
    return "/" in name or name.lower().endswith((".yaml", ".yml", ".csv"))


def absolute(name: str) -> str:
    """The absolute path if `name` is a path; a shipped name unchanged."""
    return str(Path(name).absolute()) if is_file(name) else name


def locate(name: str, kind: str, others: Sequence[str] = ()) -> Path:
    """The path of the shipped file called `name`, or `name` itself if it is a path. Raises
    DocumentError, which lists the known names and `others`."""
    if is_file(name):
        return Path(name)
    if name in names(kind):
        return folder(kind) / f"{name}.yaml"
    known = sorted({*names(kind), *others})
    near = meant(name, known) or ";"
    raise DocumentError(
        f"there is no {kind} named {shown(name)}{near} known are {', '.join(known)}"
    )


def beside(named: Any, path: Path) -> Any:
    """What the file `path` names, a value of any kind, with its paths relative to that file."""
    if isinstance(named, dict):
        named.update({key: beside(value, path) for key, value in named.items()})
    elif isinstance(named, list):
        return [beside(value, path) for value in named]
    elif isinstance(named, str) and is_file(named):
        return str(path.parent / named)
    return named


def read_text(path: Path) -> str:
    """The content of a UTF-8 file of at most SIZE_MOST characters. Raises DocumentError."""
    try:
        if not path.is_file():
            path.stat()  # raises an OSError with the reason if there is no file
            raise DocumentError(f"{path} cannot be read: not a regular file")
        with path.open(encoding="utf-8") as file:
            text = file.read(SIZE_MOST + 1)
        if len(text) > SIZE_MOST:
            raise DocumentError(f"{path} cannot be read: larger than {SIZE_MOST // 1000} kB")
        return text
    except OSError as error:
        raise DocumentError(f"{abridged(path)} cannot be read: {error.strerror}") from None
    except ValueError:  # also raised for a path that contains a NUL character
        raise DocumentError(f"{abridged(path)} cannot be read: not UTF-8 text") from None
