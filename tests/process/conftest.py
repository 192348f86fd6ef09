"""Fixtures for tests of commands, which run as processes or in the process of pytest."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path

import pytest
from processes import Called, Spawn, children, free_port

from offboard import cli
from offboard.cli.shared import out
from offboard.run import flight
from offboard.run.sitl import InMemorySimulator
from simulator import cli as simulator_cli

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)  # signals that commands handle


@pytest.fixture
def spawn(tmp_path: Path) -> Iterator[Spawn]:
    """`spawn("offboard", ...)` starts a command in `tmp_path`, with `more` in its environment. That
    directory has modules `json` and `pickle`, which end a process that imports them from there."""
    running: list[subprocess.Popen[str]] = []
    for module in ("json", "pickle"):
        (tmp_path / f"{module}.py").write_text("import os\nos._exit(99)\n")

    def spawn(
        program: str, *arguments: object, terminal: int | None = None, **more: str
    ) -> subprocess.Popen[str]:
        process = subprocess.Popen(
            [sys.executable, "-P", "-m", program, *map(str, arguments)],
            cwd=tmp_path,
            env={**os.environ, "PYTHONUNBUFFERED": "1", "COLUMNS": "200", **more},
            stdin=subprocess.DEVNULL if terminal is None else terminal,
            stdout=subprocess.PIPE if terminal is None else terminal,
            stderr=subprocess.PIPE if terminal is None else terminal,
            text=True,
            start_new_session=True,
        )
        running.append(process)
        return process

    try:
        yield spawn
    finally:
        for process in running:
            if process.poll() is None:
                for pid in (*children(process.pid), process.pid):
                    with suppress(ProcessLookupError):
                        os.kill(pid, signal.SIGKILL)
            process.communicate()


@pytest.fixture
def called(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> Called:
    """`called("offboard fly", ...)` runs a command in this process and returns exit code, stdout
    and stderr. The word PORT in an argument becomes the number of a free port."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))

    def call(command: str, *arguments: object) -> tuple[int, str, str]:
        main = simulator_cli.main if command.startswith("simulator") else cli.main
        words = [*command.split(), *map(str, arguments)]
        words = [word.replace(":PORT", f":{free_port()}") for word in words]
        monkeypatch.setattr(sys, "argv", words)
        with out.capture():  # discards what an earlier call could not write
            pass
        handlers = {number: signal.getsignal(number) for number in SIGNALS}
        try:
            with pytest.raises(SystemExit) as ended:
                main()
        finally:
            for number, handler in handlers.items():
                signal.signal(number, handler)
        printed = capsys.readouterr()
        return int(ended.value.code or 0), printed.out, printed.err

    return call


@pytest.fixture
def refused(called: Called, tmp_path: Path) -> Callable[..., str]:
    """`refused("offboard fly", ...)` runs a command and returns the one sentence that it says. Its
    exit code must be 2, and no file in the working directory may be made or changed."""

    def files() -> dict[Path, tuple[int, int]]:
        found = {path: path.lstat() for path in tmp_path.rglob("*")}
        return {path: (stat.st_size, stat.st_mtime_ns) for path, stat in found.items()}

    def refuse(command: str, *arguments: object) -> str:
        before = files()
        code, _, said = called(command, *arguments)
        # a PX4 may run on this computer
        said = re.sub(r"simulator: port \d+ is in use: .*\n", "", said)
        assert (code, said.count("\n"), "Traceback" in said) == (2, 1, False), said
        assert files() == before
        return said

    return refuse


@pytest.fixture
def in_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    """`fly --sitl` flies its simulated vehicle in this process."""
    monkeypatch.setattr(flight, "SimulatorProcess", InMemorySimulator)
