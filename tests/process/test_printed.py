"""What the commands print of the shipped files: their names and descriptions, within the window."""

from __future__ import annotations

import re
from pathlib import Path

import yaml
from processes import CONFIG, Called
from typer.testing import CliRunner

from offboard.cli.commands import app as offboard
from offboard.documents import shipped as documents

FOLDERS = ("references", "controllers", "vehicles", "scenarios", "campaigns", "tunings", "")


def shipped(folder: str) -> list[Path]:
    return sorted((CONFIG / folder).glob("*.yaml"))


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
