"""The README is tested: its commands and examples work, and it names every command."""

from __future__ import annotations

import json
import os
import re
import runpy
import subprocess
import sys
from pathlib import Path
from textwrap import dedent
from typing import Any

import numpy as np
import pytest
from processes import eventually

from offboard import cli
from offboard.cli.commands import app

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text()
SCRIPTS = Path(sys.executable).parent


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


def test_ci_runs_the_test_command_of_the_readme() -> None:
    command = _commands()[1]
    assert command.endswith("pytest -n auto")
    assert command in (ROOT / ".ci" / "run").read_text().splitlines()


def test_ci_workflow_excludes_only_existing_tests() -> None:
    workflow = (ROOT / ".github" / "workflows" / "ci.yml").read_text()
    left_out = re.findall(r"--(?:ignore|deselect)=([\w/.]+)(?:::(\w+))?", workflow)
    assert left_out
    for file, test in left_out:
        wanted = f"def {test}(" if test else "def test_"
        assert wanted in (ROOT / file).read_text(), f"{file}::{test}"


def test_first_readme_command_flies_scores_and_writes_a_report(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    install, _, fly = _commands()[0].rpartition(" && ")
    assert "pip install ." in install
    program, *arguments = fly.split()
    process = subprocess.Popen(
        (SCRIPTS / Path(program).name, *arguments),
        cwd=tmp_path, env={**os.environ, "COLUMNS": "80", "OFFBOARD_REPORT": "1"},
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    assert process.stdout is not None
    lines = []
    for line in process.stdout:
        lines.append(line)
        if " track: " in line:  # each phase is printed when it begins
            assert process.poll() is None
            assert not list(tmp_path.rglob("score.json"))
    assert (process.wait(), process.communicate()[1]) == (0, "")
    (flight,) = (tmp_path / "flights").iterdir()
    score = json.loads((flight / "score.json").read_text())
    assert score["rmse_position_m"] < 0.05
    _check_phases(lines, score["phases"])
    verdict, *rows = lines[lines.index("\n") + 1 :]
    assert verdict == "flown and landed\n"
    labels = [row[2:17].strip() for row in rows if row[2] != " "]
    assert labels == ["tracked error", "true error", "timing", "identified", "log", "all metrics",
                      "report"]  # fmt: skip

    monkeypatch.setattr(sys, "argv", ["", str(flight)])
    capsys.readouterr()
    runpy.run_path(str(ROOT / ".github" / "flight_picture.py"), run_name="__main__")
    drawn, shown = capsys.readouterr().out, (ROOT / ".github" / "flight.svg").read_text()
    assert _path(drawn).shape[0] > 200
    np.testing.assert_allclose(_path(drawn), _path(shown), atol=1.0)  # a pixel is 1 cm

    report = flight / "report.html"
    eventually(report.exists)
    assert report.read_text(encoding="utf-8").endswith("</html>")
    names = {path.name for path in flight.iterdir() if not path.name.startswith(".")}
    assert names == {"flight.tlog", "flight.yaml", "score.json", "report.html"}


def _check_phases(lines: list[str], logged: list[dict[str, Any]]) -> None:
    """Each phase of the log is printed once, with its time, in lines of 80 columns."""
    assert max(map(len, lines)) <= 81  # with the line break
    words = [line.split() for line in lines[1 : lines.index("\n")]]
    words = [each for each in words if each[1:2] == ["s"] and each[2] != "waiting:"]
    phases = {what: float(time_s) for time_s, _, what, *_ in words if what.endswith(":")}
    assert len(phases) == sum(what.endswith(":") for _, _, what, *_ in words) >= 10
    assert phases == pytest.approx({e["what"].split()[0]: e["time_s"] for e in logged}, abs=0.01)


def _path(picture: str) -> np.ndarray:
    """Pixels of the first flight's path, (N, 2)."""
    (points,) = re.findall(r'id="flight-1" points="([^"]+)"', picture)
    return np.array([pair.split(",") for pair in points.split()], dtype=float)


@pytest.mark.slow  # README.md itself: tests/process/test_pytest_plugins.py
@pytest.mark.parametrize("readme", sorted(_examples().keys() - {"README.md"}))
def test_readme_python_examples_run(readme: str, tmp_path: Path) -> None:
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


def test_readme_names_every_command() -> None:
    named = {info.name or info.callback.__name__ for info in app.registered_commands}
    assert {name for name in named if f"offboard {name}" not in README} == set()


def test_readme_links_lead_to_files() -> None:
    for readme in (
        ROOT / "README.md",
        ROOT / "CONTRIBUTING.md",
        *ROOT.glob("*/README.md"),
        *ROOT.glob("offboard/*/README.md"),
    ):
        text = readme.read_text()
        targets = [readme.parent / each for each in re.findall(r"\]\(([^)#:]+)\)", text)]
        targets += [ROOT / each for each in re.findall(r"`(tests/[\w/]+\.py)`", text)]
        assert [each for each in targets if not each.exists()] == []


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
