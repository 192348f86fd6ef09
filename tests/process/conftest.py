"""Fixtures of the tests of commands, as processes or called in this one."""

from __future__ import annotations

import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import nullcontext
from pathlib import Path

import pytest
from processes import Called, Spawn, free_port, spawning

from offboard import cli
from offboard.cli.shared import out
from offboard.run import sitl
from simulator import cli as simulator_cli

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)  # which commands handle


@pytest.fixture
def spawn(tmp_path: Path) -> Iterator[Spawn]:
    with spawning(tmp_path) as spawn:
        yield spawn


@pytest.fixture
def called(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> Called:
    """`called("offboard fly", ...)`, in this process -> exit code, stdout, stderr. The word PORT
    in an argument becomes the number of a free port."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))

    def call(command: str, *arguments: object) -> tuple[int, str, str]:
        main = simulator_cli.main if command.startswith("simulator") else cli.main
        words = [*command.split(), *map(str, arguments)]
        words = [word.replace(":PORT", f":{free_port()}") for word in words]
        monkeypatch.setattr(sys, "argv", words)
        with out.capture():  # drops what an earlier call could not write
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
    """`refused("offboard fly", ...)` -> its one sentence: the exit code is 2, and no file in the
    working directory was made or changed."""

    def files() -> dict[Path, tuple[int, int]]:
        found = {path: path.lstat() for path in tmp_path.rglob("*")}
        return {path: (stat.st_size, stat.st_mtime_ns) for path, stat in found.items()}

    def refuse(command: str, *arguments: object) -> str:
        before = files()
        code, _, said = called(command, *arguments)
        assert (code, said.count("\n"), "Traceback" in said) == (2, 1, False), said
        assert files() == before
        return said

    return refuse


@pytest.fixture
def in_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    """`fly --sitl` flies the same vehicle without a process of its own."""
    monkeypatch.setattr(sitl, "SimulatorProcess", lambda: nullcontext(sitl.InMemorySimulator()))
