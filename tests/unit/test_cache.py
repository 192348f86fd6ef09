"""Where machine code is kept: private, writable, and never older than the sources."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


def copy_of_the_package(where: Path) -> Path:
    for package in ("offboard", "simulator"):
        shutil.copytree(
            ROOT / package, where / package, ignore=shutil.ignore_patterns("__pycache__")
        )
    return where


def answer(code: str, package_root: Path = ROOT, umask: int = 0o022, **environment: str) -> str:
    """What a fresh interpreter that has this package says."""
    done = subprocess.run(
        [sys.executable, "-B", "-c", code],
        cwd=package_root,
        env={**os.environ, "PYTHONPATH": str(package_root), **environment},
        capture_output=True,
        text=True,
        check=True,
        timeout=60,
        umask=umask,
    )
    assert not done.stderr
    return done.stdout.strip()


def cache_directory(package_root: Path, **environment: str) -> Path:
    """Where a fresh interpreter that imports the copy keeps machine code."""
    code = "from offboard.model import cache; print(cache.directory())"
    return Path(answer(code, package_root, **environment))


@pytest.mark.parametrize(
    "changed",
    [
        "offboard/model/rigid_body.py",
        "offboard/model/state.py",  # its sizes are compiled in
        "simulator/vehicle/dynamics.py",  # and this one's record, by the module's name
    ],
)
def test_a_changed_compiled_source_gets_a_new_cache(tmp_path: Path, changed: str) -> None:
    root = copy_of_the_package(tmp_path)
    home = str(tmp_path / "cache")
    first = cache_directory(root, XDG_CACHE_HOME=home)
    assert first.parent == tmp_path / "cache" / "pso-offboard"
    assert first == cache_directory(root, XDG_CACHE_HOME=home)
    with (root / changed).open("a") as source:
        source.write("\n# changed\n")
    assert cache_directory(root, XDG_CACHE_HOME=home) != first


def test_a_changed_source_that_compiles_nothing_keeps_the_cache(tmp_path: Path) -> None:
    root = copy_of_the_package(tmp_path)
    home = str(tmp_path / "cache")
    first = cache_directory(root, XDG_CACHE_HOME=home)
    with (root / "offboard" / "model" / "document.py").open("a") as source:
        source.write("\n# changed\n")
    assert cache_directory(root, XDG_CACHE_HOME=home) == first


def test_without_a_writable_home_the_cache_is_temporary(tmp_path: Path) -> None:
    nowhere = tmp_path / "file"
    nowhere.write_text("not a directory")
    directory = cache_directory(ROOT, XDG_CACHE_HOME=str(nowhere), TMPDIR=str(tmp_path))
    assert directory.is_dir()
    assert tmp_path in directory.parents


def test_with_nothing_writable_at_all_nothing_is_kept() -> None:
    nowhere = """
import tempfile
from pathlib import Path
from offboard.model import cache
from offboard.model.machine_code import keep, kept
cache._bases = lambda: iter((Path("/proc/none"),))
tempfile.tempdir = "/proc/none"
keep("f", b"code")
print(kept("f"))
"""
    assert answer(nowhere) == "None"


def test_a_directory_others_can_write_to_is_not_used(tmp_path: Path) -> None:
    shared = tmp_path / "pso-offboard"
    shared.mkdir()
    shared.chmod(0o777)
    directory = cache_directory(ROOT, XDG_CACHE_HOME=str(tmp_path), TMPDIR=str(tmp_path))
    assert shared not in directory.parents


KEPT = """
from offboard.model.machine_code import keep, kept
from offboard.model import cache
keep("f", b"code")
print(kept("f"), cache.directory())
"""


def test_in_a_group_that_shares_its_files_machine_code_is_kept(tmp_path: Path) -> None:
    home = tmp_path / "new" / "cache"
    directory = Path(answer(KEPT, umask=0o002, XDG_CACHE_HOME=str(home)).removeprefix("b'code' "))
    assert directory.parent == home / "pso-offboard"
    made = [path for path in (directory, *directory.parents) if tmp_path in path.parents]
    assert {path.stat().st_mode & 0o777 for path in made} == {0o700}


def test_a_digest_directory_others_can_write_to_is_not_used(tmp_path: Path) -> None:
    directory = Path(answer(KEPT, XDG_CACHE_HOME=str(tmp_path)).removeprefix("b'code' "))
    directory.chmod(0o775)
    said = answer(KEPT, XDG_CACHE_HOME=str(tmp_path), TMPDIR=str(tmp_path))
    assert said == f"b'code' {tmp_path / f'pso-offboard-{os.getuid()}' / directory.name}"
