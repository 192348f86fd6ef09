"""What the commands print: it fits the window, and names the shipped files and the exit codes."""

from __future__ import annotations

import re
from pathlib import Path

import typer
import yaml
from processes import CONFIG, Called
from typer.testing import CliRunner

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
