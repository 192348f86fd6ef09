"""Rules of the sources that no tool checks: one clock, sockets at the edges, layout. `.ci/check`
checks format, lint, strict types and import rules."""

from __future__ import annotations

import ast
import subprocess
from functools import cache
from pathlib import Path

ROOT = Path(__file__).parents[1]
SHARED = ("offboard.compiled", "offboard.documents", "offboard.link.clock", "offboard.model")
SOURCES = sorted(path for name in ("offboard", "simulator") for path in (ROOT / name).rglob("*.py"))


@cache
def _tree(path: Path) -> ast.Module:
    return ast.parse(path.read_text())


@cache
def _names(path: Path) -> set[str]:
    """Modules imported by a file, as dotted names."""
    names: set[str] = set()
    for node in ast.walk(_tree(path)):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            names |= {node.module} | {f"{node.module}.{alias.name}" for alias in node.names}
    return names


def _importers(*modules: str) -> set[str]:
    return {
        str(path.relative_to(ROOT))
        for path in SOURCES
        if any(name.split(".")[0] in modules for name in _names(path))
    }


def test_only_the_clock_reads_the_time() -> None:
    assert _importers("time", "datetime") == {"offboard/link/clock.py"}


def test_only_listed_modules_import_socket() -> None:
    edges = {f"offboard/link/{name}.py" for name in ("connection", "lock", "stream", "udp")}
    edges |= {f"offboard/supervisor/{name}.py" for name in ("supervisor", "process")}
    edges |= {"simulator/link/sockets.py"}
    assert _importers("select", "socket", "serial") <= edges


def test_flight_package_does_no_io() -> None:
    outside = {"os", "pathlib", "select", "signal", "socket", "subprocess", "threading"}
    for path in (ROOT / "offboard" / "flight").glob("*.py"):
        names = _names(path)
        assert not {name.split(".")[0] for name in names} & outside, path.name
        links = {name for name in names if name.startswith("offboard.link")}
        pure = {f"offboard.link.interface.{name}" for name in ("Chunk", "peer_name")}
        assert links <= pure | {"offboard.link.interface"}, path.name


def test_the_simulator_imports_only_four_parts_of_offboard() -> None:
    imported = {name for path in (ROOT / "simulator").rglob("*.py") for name in _names(path)}
    ours = {name for name in imported if name.split(".")[0] == "offboard"}
    allowed = {"offboard", "offboard.link"}
    assert {name for name in ours - allowed if not name.startswith(SHARED)} == set()


def test_only_the_outbox_creates_setpoints() -> None:
    makers = {
        str(path.relative_to(ROOT))
        for path in SOURCES
        for node in ast.walk(_tree(path))
        if isinstance(node, ast.Call)
        and isinstance(node.func, ast.Name)
        and node.func.id in ("AttitudeTarget", "PositionTarget")
    }
    assert makers == {"offboard/flight/outbox.py"}


def test_repository_root_has_only_listed_entries() -> None:
    listed = subprocess.run(
        ("git", "ls-files"), cwd=ROOT, capture_output=True, text=True, check=True
    ).stdout.split()
    top = {name.split("/")[0] for name in listed if not name.startswith(".")}
    pages = {"README.md", "LICENSE", "CHANGELOG.md", "CONTRIBUTING.md"}
    assert top <= {"pyproject.toml", "offboard", "simulator", "config", "tests"} | pages
