"""Before any test: compile once what the workers of a parallel run would each compile at once."""

from __future__ import annotations

import subprocess
import sys
import tempfile

import pytest

FLIGHT = (
    "offboard", "fly", "--sitl", "--reference", "hover", "--set", "reference.duration_s=1",
)  # fmt: skip


def pytest_sessionstart(session: pytest.Session) -> None:
    if hasattr(session.config, "workerinput") or session.config.option.collectonly:
        return
    with tempfile.TemporaryDirectory() as directory:
        command = (sys.executable, "-m", *FLIGHT, "--out", f"{directory}/flight")
        subprocess.run(command, capture_output=True, timeout=600, check=False)
