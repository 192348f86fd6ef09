"""What the commands print: it names the shipped files and the exit codes."""

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
NAMED = {"fly": FOLDERS[:4], "compare": FOLDERS[:4], "simulator": FOLDERS[2:4]}


def shipped(folder: str) -> list[Path]:
    return sorted((CONFIG / folder).glob("*.yaml"))


def test_help_has_the_exit_codes_and_the_shipped_files() -> None:
    for command in (*COMMANDS, "simulator"):
        app, words = (simulator, []) if command == "simulator" else (offboard, [command])
        shown = CliRunner().invoke(app, [*words, "--help"], terminal_width=80).output
        codes = re.findall(r"(?:codes:|;)\s+(\d+)\s", shown.partition("Exit")[2])
        assert command == "simulator" or " ".join(codes) == CODES[command], command
        for folder in NAMED.get(command, ()):
            named = set(re.split(r"[\s,.]+", shown))
            assert {path.stem for path in shipped(folder)} <= named


def test_without_a_command_the_commands_are_shown(called: Called) -> None:
    code, shown, said = called("offboard")
    assert (code, said) == (2, "")
    assert all(f"\n  {command} " in shown for command in COMMANDS)


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
