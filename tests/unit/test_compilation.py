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


def answer(
    code: str, package_root: Path = ROOT, umask: int = 0o022, **environment: str
) -> tuple[str, str]:
    """What a fresh interpreter that has this package says, and on standard error."""
    clean = {key: value for key, value in os.environ.items() if not key.startswith("NUMBA")}
    done = subprocess.run(
        [sys.executable, "-B", "-c", code],
        cwd=package_root,
        env=clean | {"PYTHONPATH": str(package_root)} | environment,
        capture_output=True,
        text=True,
        check=True,
        timeout=60,
        umask=umask,
    )
    return done.stdout.strip(), done.stderr.strip()


def cache_directory(package_root: Path, **environment: str) -> Path:
    """Where a fresh interpreter importing the copy has numba put its cache."""
    code = "import offboard, numba; print(numba.config.CACHE_DIR)"
    return Path(answer(code, package_root, **environment)[0])


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


KEPT = """
from offboard.model.machine_code import keep, kept
from offboard.model.compilation import prepare_cache
keep("f", b"code")
print(kept("f"), prepare_cache())
"""


@pytest.mark.parametrize("variable", ["XDG_CACHE_HOME", "NUMBA_CACHE_DIR"])
def test_in_a_group_that_shares_its_files_machine_code_is_kept(
    tmp_path: Path, variable: str
) -> None:
    said, complaint = answer(KEPT, umask=0o002, **{variable: str(tmp_path / "new" / "cache")})
    directory = Path(said.removeprefix("b'code' "))
    assert not complaint
    assert tmp_path / "new" / "cache" in (directory, directory.parent.parent)
    made = [path for path in (directory, *directory.parents) if tmp_path in path.parents]
    assert {path.stat().st_mode & 0o777 for path in made} == {0o700}


def test_a_digest_directory_others_can_write_to_is_not_used(tmp_path: Path) -> None:
    directory = Path(answer(KEPT, XDG_CACHE_HOME=str(tmp_path))[0].removeprefix("b'code' "))
    directory.chmod(0o775)
    said, _ = answer(KEPT, XDG_CACHE_HOME=str(tmp_path), TMPDIR=str(tmp_path))
    assert said == f"b'code' {tmp_path / f'pso-offboard-{os.getuid()}' / directory.name}"


@pytest.mark.parametrize(
    ("mode", "trouble"), [(0o777, "others can write to it"), (None, "it cannot be written")]
)
def test_an_unusable_choice_is_said_once_and_replaced(
    tmp_path: Path, mode: int | None, trouble: str
) -> None:
    chosen = tmp_path / "chosen"
    if mode is None:
        chosen.write_text("not a directory")
    else:
        chosen.mkdir()
        chosen.chmod(mode)
    home = str(tmp_path / "home")
    said, complaint = answer(KEPT, NUMBA_CACHE_DIR=str(chosen), XDG_CACHE_HOME=home)
    assert said.startswith(f"b'code' {home}")
    assert len(complaint.splitlines()) == 1
    assert complaint.startswith(f"NUMBA_CACHE_DIR={chosen} is not used: {trouble}")
