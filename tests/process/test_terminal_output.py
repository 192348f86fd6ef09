"""Output of the commands: width, shipped files in --help, phases and result of `fly`."""

from __future__ import annotations

import io
import json
import os
import pty
import re
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

import pytest
import typer
import yaml
from processes import SHORT, Spawn
from rich.console import Console
from typer.testing import CliRunner

from offboard.analysis.score import METRICS, score_flight
from offboard.analysis.score_table import show
from offboard.cli.commands import app as offboard
from simulator.command import app as simulator

CONFIG = Path(__file__).parents[2] / "config"
RECORDING = Path(__file__).parents[1] / "wire" / "recordings" / "px4-1.16.1-offboard.tlog"
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


def test_list_describes_every_shipped_file_in_one_line() -> None:
    lines = CliRunner().invoke(offboard, ["list"]).output.splitlines()
    assert max(map(len, lines)) <= 80
    listed = [tuple(line.split(maxsplit=1)) for line in lines if line.startswith(" ")]
    files = [path for folder in FOLDERS for path in shipped(folder)]
    assert len(files) >= 44
    assert listed == [(p.stem, yaml.safe_load(p.read_text())["description"]) for p in files]


@pytest.mark.parametrize("columns", [60, 80])
def test_a_score_fits(columns: int) -> None:
    text = io.StringIO()
    show(Console(file=text, width=columns), *score_flight(RECORDING))
    lines = text.getvalue().splitlines()
    assert max(map(len, lines)) <= columns
    assert "…" not in text.getvalue()
    assert max(len(figure["meaning"]) for figure in METRICS.values()) <= 37  # that fit 80 columns
    assert columns < 80 or sum("setpoint_gap_wall_max_s" in line for line in lines) == 1


def test_a_piped_flight_prints_its_phases_once_as_they_happen(spawn: Spawn, tmp_path: Path) -> None:
    process = spawn(
        "offboard", "fly", "--sitl", "--scenario", "calm", "--out", "x", "--reference", "hover",
        "--set", "reference.duration_s=5", "--set", "reference.height_m=1",
        "--require", "rmse_position_m<0.5", COLUMNS="80", PYTHONUNBUFFERED="",
    )  # fmt: skip
    assert process.stdout is not None
    lines = []
    for line in process.stdout:
        lines.append(line)
        if " track: " in line:
            assert process.poll() is None
            assert not (tmp_path / "x" / "score.json").exists()
    assert (process.wait(), process.communicate()[1]) == (0, "")
    assert max(map(len, lines)) <= 81  # with the line break
    begin = lines.index("\n")
    words = [line.split() for line in lines[1:begin]]
    words = [each for each in words if each[1:2] == ["s"] and each[2] != "waiting:"]
    phases = {what: float(time_s) for time_s, _, what, *_ in words if what.endswith(":")}
    assert len(phases) == sum(what.endswith(":") for _, _, what, *_ in words) >= 10
    logged = json.loads((tmp_path / "x" / "score.json").read_text())["phases"]
    assert phases == pytest.approx({e["what"].split()[0]: e["time_s"] for e in logged}, abs=0.01)
    verdict, *rows = lines[begin + 1 :]
    assert verdict.startswith("flown and landed; requirement met: rmse_position_m is ")
    labels = [row[2:17].strip() for row in rows]
    assert labels == ["tracked error", "true error", "timing", "identified", "log", "all figures"]
    assert Path(tmp_path / rows[-2].split()[-1]).is_file()


def on_a_terminal(tmp_path: Path, *command: str) -> list[str]:
    """The lines that a command prints on a terminal of 80 columns."""
    terminal, theirs = pty.openpty()
    environment = {**os.environ, "COLUMNS": "80", "TERM": "dumb"}
    process = subprocess.Popen(
        [sys.executable, "-m", *command],
        cwd=tmp_path, env=environment, stdin=theirs, stdout=theirs, stderr=theirs,
    )  # fmt: skip
    os.close(theirs)
    printed = b""
    while True:
        try:
            printed += os.read(terminal, 65536)
        except OSError:  # all that was printed has been read, and nobody is left to print
            break
    process.wait()
    os.close(terminal)
    return printed.decode().splitlines()


@pytest.mark.parametrize(
    ("command", "says"),
    [
        ("offboard fly --reference spiral", "there is no reference named 'spiral'; known are"),
        (
            "simulator --duration 0.1 --connect udpout:127.0.0.1:59999 --gcs none",
            "px4_sih, system 1",
        ),
    ],
)
def test_on_a_terminal_long_lines_are_wrapped_at_words(
    command: str, says: str, tmp_path: Path
) -> None:
    lines = on_a_terminal(tmp_path, *command.split())
    assert len(lines) > 1
    assert max(map(len, lines)) <= 80
    assert says in " ".join(line.strip() for line in lines)


def test_a_terminal_stopped_by_ctrl_s_stops_no_flight(tmp_path: Path) -> None:
    terminal, theirs = pty.openpty()
    process = subprocess.Popen(
        [sys.executable, "-m", "offboard", "fly", "--sitl", "--out", "x", *SHORT],
        cwd=tmp_path, stdin=theirs, stdout=theirs, stderr=theirs,
    )  # fmt: skip
    os.close(theirs)
    printed = b""
    while b"health: " not in printed:
        printed += os.read(terminal, 65536)
    os.write(terminal, b"\x13")  # Ctrl-S
    log = tmp_path / "x" / "flight.tlog"
    deadline_s = time.monotonic() + 60.0
    while b"disarmed: " not in log.read_bytes():
        assert time.monotonic() < deadline_s, "the flight waits for the terminal"
        time.sleep(0.05)
    os.write(terminal, b"\x11")  # Ctrl-Q
    with suppress(OSError):  # nobody is left to print
        while True:
            printed += os.read(terminal, 65536)
    assert process.wait(timeout=30) == 0
    os.close(terminal)
    assert b"flown and landed" in printed
