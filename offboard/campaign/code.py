"""The hash of the code that flies: results of other code are never mixed with ours."""

from __future__ import annotations

import hashlib
import platform
from functools import cache
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path

from offboard.campaign.document import FOLDER
from offboard.documents import shipped
from offboard.run.in_memory import registered

PACKAGES = ("numpy", "scipy", "numba", "pymavlink", "daqp")


@cache
def code_hash() -> str:
    """Hash of the sources of controller and simulator, of the shipped configuration and of the
    versions of what computes; 12 hexadecimal digits."""
    digest = hashlib.sha256(platform.python_version().encode())
    for package in PACKAGES:
        digest.update(f" {package} {version(package)}".encode())
    for folder, pattern in _sources():
        for path in sorted(folder.rglob(pattern)):
            if FOLDER not in path.relative_to(folder).parts:  # they are hashed case by case
                digest.update(str(path.relative_to(folder)).encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()[:12]


def _sources() -> list[tuple[Path, str]]:
    packages = ("offboard", registered().module.partition(".")[0])
    specs = [find_spec(package) for package in packages]
    folders = [Path(spec.origin).parent for spec in specs if spec and spec.origin]
    return [*((folder, "*.py") for folder in folders), (shipped.directory(), "*.yaml")]
