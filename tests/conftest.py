"""Before any test: compile once what the workers of a parallel run would each compile at once."""

from __future__ import annotations

import signal
import subprocess
import sys
import tempfile

import pytest

FLIGHT = (
    "offboard", "fly", "--sitl", "--reference", "hover", "--set", "reference.duration_s=1",
)  # fmt: skip


# Ignored signals are inherited: started in the background or under nohup, the processes of the
# tests would not hear the Ctrl-C that they are sent
for _number, _handler in (
    (signal.SIGINT, signal.default_int_handler),
    (signal.SIGHUP, signal.SIG_DFL),
    (signal.SIGTERM, signal.SIG_DFL),
):
    if signal.getsignal(_number) is signal.SIG_IGN:
        signal.signal(_number, _handler)


def pytest_sessionstart(session: pytest.Session) -> None:
    if hasattr(session.config, "workerinput") or session.config.option.collectonly:
        return
    with tempfile.TemporaryDirectory() as directory:
        command = (sys.executable, "-m", *FLIGHT, "--out", f"{directory}/flight")
        subprocess.run(command, capture_output=True, timeout=600, check=False)
