"""The README is executable: its commands are the ones that work, and every command is named."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text()
SCRIPTS = Path(sys.executable).parent


def _commands() -> list[str]:
    """The lines of all shell blocks, in order."""
    blocks = re.findall(r"```sh\n(.*?)```", README, re.DOTALL)
    return [line for block in blocks for line in block.strip().splitlines()]


def test_ci_runs_exactly_the_test_command() -> None:
    command = _commands()[1]
    assert command.endswith("pytest -n auto")
    assert (ROOT / ".ci" / "run").read_text().splitlines()[-1] == command


def test_first_command_flies_and_scores(tmp_path: Path) -> None:
    install, _, fly = _commands()[0].rpartition(" && ")
    assert "pip install ." in install
    program, *arguments = fly.split()
    done = subprocess.run(
        (str(SCRIPTS / Path(program).name), *arguments),
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert done.returncode == 0, done.stderr
    assert "rmse_position_m" in done.stdout
    (flight,) = (tmp_path / "flights").iterdir()
    assert {path.name for path in flight.iterdir()} >= {"flight.tlog", "flight.yaml", "score.json"}


def test_its_own_tests_pass(tmp_path: Path) -> None:
    for number, block in enumerate(re.findall(r"```python\n(.*?)```", README, re.DOTALL)):
        (tmp_path / f"test_{number}.py").write_text(block)
    done = subprocess.run(
        (sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "--rootdir", "."),
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=170,
    )
    assert "3 passed" in done.stdout, done.stdout + done.stderr


def _subcommands() -> list[str]:
    from offboard.cli import app

    return sorted(info.name or info.callback.__name__ for info in app.registered_commands)


@pytest.mark.parametrize("command", _subcommands())
def test_every_command_is_described(command: str) -> None:
    assert f"offboard {command}" in README
