"""The compilation cache: private, writable, and never older than the sources."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from offboard.model import compilation

ROOT = Path(__file__).parents[2]


def copy_of_the_package(where: Path) -> Path:
    shutil.copytree(
        ROOT / "offboard", where / "offboard", ignore=shutil.ignore_patterns("__pycache__")
    )
    return where


def cache_directory(package_root: Path, **environment: str) -> Path:
    """Where a fresh interpreter importing the copy has numba put its cache."""
    code = "import offboard, numba; print(numba.config.CACHE_DIR)"
    clean = {key: value for key, value in os.environ.items() if not key.startswith("NUMBA")}
    done = subprocess.run(
        [sys.executable, "-B", "-c", code],
        cwd=package_root,
        env=clean | {"PYTHONPATH": str(package_root)} | environment,
        capture_output=True,
        text=True,
        check=True,
        timeout=60,
    )
    return Path(done.stdout.strip())


@pytest.mark.parametrize("changed", ["rigid_body.py", "state.py"])  # its sizes are compiled in
def test_a_changed_compiled_source_gets_a_new_cache(tmp_path: Path, changed: str) -> None:
    root = copy_of_the_package(tmp_path)
    home = str(tmp_path / "cache")
    first = cache_directory(root, XDG_CACHE_HOME=home)
    assert first.parent == tmp_path / "cache" / "pso-offboard"
    assert first == cache_directory(root, XDG_CACHE_HOME=home)
    with (root / "offboard" / "model" / changed).open("a") as source:
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


def test_the_users_choice_has_precedence(tmp_path: Path) -> None:
    assert cache_directory(ROOT, NUMBA_CACHE_DIR=str(tmp_path)) == tmp_path


def test_numba_imported_first_is_told_as_well(monkeypatch: pytest.MonkeyPatch) -> None:
    import numba

    monkeypatch.setattr(numba.config, "CACHE_DIR", "")
    assert str(compilation.prepare_cache()) == numba.config.CACHE_DIR


def test_a_directory_others_can_write_to_is_not_used(tmp_path: Path) -> None:
    shared = tmp_path / "pso-offboard"
    shared.mkdir()
    shared.chmod(0o777)
    directory = cache_directory(ROOT, XDG_CACHE_HOME=str(tmp_path), TMPDIR=str(tmp_path))
    assert shared not in directory.parents
