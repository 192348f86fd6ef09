"""What the commands print: it fits the window, and names the shipped files and the exit codes."""

from __future__ import annotations

import io
import os
import pty
import re
import sys
from pathlib import Path

import pytest
import typer
import yaml
from processes import CONFIG, RECORDING, Called
from rich.console import Console
from typer.testing import CliRunner

from offboard.analysis.score import METRICS, score_flight
from offboard.analysis.score_table import show
from offboard.cli.commands import app as offboard
from offboard.documents import shipped as documents
from simulator.command import app as simulator

FOLDERS = ("references", "controllers", "vehicles", "scenarios", "campaigns", "tunings", "")
COMMANDS = tuple(typer.main.get_command(offboard).commands)  # type: ignore[attr-defined]
CODES = {"fly": "0 1 2 3 4 130 141", "daemon": "0 2 3 4", "doctor": "0 2 3", "list": "",
         **dict.fromkeys(("check", "report", "export", "key", "paper"), "0 2"),
         **dict.fromkeys(("score", "identify", "replay"), "0 1 2"),
         **dict.fromkeys(("campaign", "compare", "tune"), "0 1 2 4")}  # fmt: skip
NAMED = {("fly",): FOLDERS[:4], ("compare",): FOLDERS[:4], "simulator": FOLDERS[2:4]}
HELP = [(offboard, ()), *((offboard, (command,)) for command in COMMANDS), (simulator, ())]


def shipped(folder: str) -> list[Path]:
    return sorted((CONFIG / folder).glob("*.yaml"))


def test_help_fits_and_has_the_exit_codes_and_the_shipped_files() -> None:
    for app, arguments in HELP:
        for columns in (60, 80):
            answer = CliRunner().invoke(app, [*arguments, "--help"], terminal_width=columns)
            assert answer.exit_code == 0
            assert max(map(len, answer.output.splitlines())) <= columns
        cut_off = [line for line in answer.output.splitlines()[1:] if line.endswith("...")]
        assert not cut_off
        if arguments:
            codes = re.findall(r"(?:codes:|;)\s+(\d+)\s", answer.output.partition("Exit")[2])
            assert " ".join(codes) == CODES[arguments[0]], arguments
        words = set(re.split(r"[\s,.]+", answer.output))
        for folder in NAMED.get(arguments[:1] if app is offboard else "simulator", ()):
            assert {path.stem for path in shipped(folder)} <= words


def test_every_shipped_file_is_listed_with_what_it_is(called: Called) -> None:
    lines = CliRunner().invoke(offboard, ["list"]).output.splitlines()
    assert max(map(len, lines)) <= 80
    listed = [tuple(line.split(maxsplit=1)) for line in lines if line.startswith(" ")]
    files = [path for folder in FOLDERS for path in shipped(folder)]
    assert len(files) >= 44
    assert listed == [(p.stem, yaml.safe_load(p.read_text())["description"]) for p in files]
    code, output, errors = called("simulator --list-scenarios")
    assert (code, errors) == (0, "")
    scenarios = dict(re.split(r"\s+", line, maxsplit=1) for line in output.splitlines())
    assert scenarios == documents.descriptions("scenario")
    code, output, _ = called("offboard doctor --list gps")
    assert (code, output.startswith("gps  GPS fix.")) == (0, True)


@pytest.mark.parametrize("columns", [60, 80])
def test_a_score_fits(columns: int) -> None:
    text = io.StringIO()
    show(Console(file=text, width=columns), *score_flight(RECORDING))
    lines = text.getvalue().splitlines()
    assert max(map(len, lines)) <= columns
    assert "…" not in text.getvalue()
    assert max(len(figure["meaning"]) for figure in METRICS.values()) <= 37  # that fit 80 columns
    assert columns < 80 or sum("setpoint_gap_wall_max_s" in line for line in lines) == 1


@pytest.mark.parametrize(
    ("command", "stream", "says"),
    [
        ("offboard fly --reference snail", "stderr", "no reference named 'snail'; known are"),
        (
            "simulator --duration 0.1 --gcs none --connect udpout:127.0.0.1:59999",
            "stdout",
            "system 1",
        ),
    ],
)
def test_on_a_terminal_long_lines_are_wrapped_at_words(
    command: str, stream: str, says: str, called: Called, monkeypatch: pytest.MonkeyPatch
) -> None:
    terminal, theirs = pty.openpty()
    monkeypatch.setenv("COLUMNS", "80")
    with os.fdopen(theirs, "w") as file:
        monkeypatch.setattr(sys, stream, file)
        called(command)
    lines = os.read(terminal, 65536).decode().splitlines()
    os.close(terminal)
    assert len(lines) > 1
    assert max(map(len, lines)) <= 80
    assert says in " ".join(line.strip() for line in lines)
