"""Fixtures of the tests of commands, as processes or called in this one."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from processes import Called, Spawn, free_port, spawning

from offboard import cli
from simulator import cli as simulator_cli


@pytest.fixture
def port() -> int:
    return free_port()


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

    def call(command: str, *arguments: object) -> tuple[int, str, str]:
        main = simulator_cli.main if command.startswith("simulator") else cli.main
        words = [str(each).replace(":PORT", f":{free_port()}") for each in arguments]
        monkeypatch.setattr(sys, "argv", [*command.split(), *words])
        with pytest.raises(SystemExit) as ended:
            main()
        printed = capsys.readouterr()
        return int(ended.value.code or 0), printed.out, printed.err

    return call
