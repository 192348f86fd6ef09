"""The README is executable: its commands are the ones that work, and every command is named."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path
from textwrap import dedent

import numpy as np
import pytest

from offboard import cli

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text()
SCRIPTS = Path(sys.executable).parent
LINES_MAX = 180


def _examples() -> dict[str, list[str]]:
    """The Python blocks of every README that has some."""
    folders = (ROOT / "offboard", ROOT / "simulator", ROOT / "config")
    paths = [path for folder in folders for path in folder.rglob("README.md")]
    found = {
        str(path.relative_to(ROOT)): re.findall(r"```python\n(.*?)```", path.read_text(), re.DOTALL)
        for path in (ROOT / "README.md", *sorted(paths))
    }
    return {name: blocks for name, blocks in found.items() if blocks}


def _commands() -> list[str]:
    """The lines of all shell blocks, in order."""
    blocks = re.findall(r"```sh\n(.*?)```", README, re.DOTALL)
    return [line for block in blocks for line in block.strip().splitlines()]


def test_the_readme_is_short() -> None:
    assert len(README.splitlines()) <= LINES_MAX


def test_ci_runs_the_test_command_unchanged() -> None:
    command = _commands()[1]
    assert command.endswith("pytest -n auto")
    assert command in (ROOT / ".ci" / "run").read_text().splitlines()


def test_the_workflow_leaves_out_only_tests_that_exist() -> None:
    workflow = (ROOT / ".github" / "workflows" / "ci.yml").read_text()
    left_out = re.findall(r"--(?:ignore|deselect)=([\w/.]+)(?:::(\w+))?", workflow)
    assert left_out
    for file, test in left_out:
        wanted = f"def {test}(" if test else "def test_"
        assert wanted in (ROOT / file).read_text(), f"{file}::{test}"


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
    assert "tracked error" in done.stdout
    (flight,) = (tmp_path / "flights").iterdir()
    assert {path.name for path in flight.iterdir()} >= {"flight.tlog", "flight.yaml", "score.json"}
    assert json.loads((flight / "score.json").read_text())["rmse_position_m"] < 0.05
    _compare_with_picture(flight)


def _compare_with_picture(flight: Path) -> None:
    """The README's picture shows the path of this flight, to within a pixel (1 cm)."""
    script = ROOT / ".github" / "flight_picture.py"
    drawn = subprocess.run(
        (sys.executable, script, flight), capture_output=True, text=True, check=True, timeout=60
    ).stdout
    shown = (ROOT / ".github" / "flight.svg").read_text()
    assert _path(drawn).shape[0] > 200
    np.testing.assert_allclose(_path(drawn), _path(shown), atol=1.0)


def _path(picture: str) -> np.ndarray:
    """Pixels of the first flight's path, (N, 2)."""
    (points,) = re.findall(r'id="flight-1" points="([^"]+)"', picture)
    return np.array([pair.split(",") for pair in points.split()], dtype=float)


@pytest.mark.parametrize(
    "readme",
    [
        pytest.param(name, marks=[] if name == "README.md" else pytest.mark.slow)
        for name in _examples()
    ],
)
def test_python_examples_run(readme: str, tmp_path: Path) -> None:
    blocks = _examples()[readme]
    for number, block in enumerate(blocks):
        (tmp_path / f"test_{number}.py").write_text(block)
    tests = sum(len(re.findall(r"^def test_", block, re.MULTILINE)) for block in blocks)
    done = subprocess.run(
        (sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "--rootdir", "."),
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=170,
    )
    expected = f"{tests} passed" if tests else "no tests ran"
    assert expected in done.stdout, f"{readme}: {done.stdout}{done.stderr}"


def _subcommands() -> list[str]:
    from offboard.cli.commands import app

    return sorted(info.name or info.callback.__name__ for info in app.registered_commands)


@pytest.mark.parametrize("command", _subcommands())
def test_every_command_is_described(command: str) -> None:
    assert f"offboard {command}" in README


def test_links_lead_to_files() -> None:
    for readme in (
        ROOT / "README.md",
        ROOT / "CONTRIBUTING.md",
        *ROOT.glob("*/README.md"),
        *ROOT.glob("offboard/*/README.md"),
    ):
        for target in re.findall(r"\]\(([^)#:]+)\)", readme.read_text()):
            assert (readme.parent / target).exists(), f"{readme.relative_to(ROOT)}: {target}"


def test_scenario_example_is_valid(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    text = (ROOT / "config" / "README.md").read_text()
    (block,) = re.findall(r"```yaml\n(.*?)```", text, re.DOTALL)
    (tmp_path / "example.yaml").write_text(dedent(block))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["offboard", "check", "example.yaml"])
    with pytest.raises(SystemExit) as ended:
        cli.main()
    assert not ended.value.code
    assert capsys.readouterr().out.endswith("example.yaml: scenario, valid\n")
