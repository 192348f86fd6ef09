"""A controller that is killed or stopped in flight: the supervisor lands the vehicle.

Real processes in real time, each over another kind of link; one that is stopped also in
`flight/test_supervisor.py`. The log says what was asked of the
vehicle; the simulated autopilot, which is another program, that it obeyed and landed.
"""

from __future__ import annotations

import json
import signal
import subprocess
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from processes import SHORT, Spawn, children, free_port, hovering

from offboard.analysis import tlog

HOLD, LAND = 176, 21  # MAV_CMD
ARMED = 128  # MAV_MODE_FLAG_SAFETY_ARMED
LONG_S = 60.0
QUICK_LANDING = ("--param", "MPC_LAND_CRWL=0.7", "--param", "COM_DISARM_LAND=0.5")
HOVER = (*SHORT, "--set", "reference.duration_s=600")


def connections(spawn: Spawn, kind: str, directory: Path) -> str:
    """Start a simulator, whose vehicle hovers; the address at which it can be flown."""
    port = free_port()
    link, ours = {"udp": ("udpout", "udpin"), "tcp": ("tcpin", "tcp")}[kind]
    # with the longest timeout of its own: on a busy machine its failsafe would come first
    own_failsafe = ("--param", "COM_OF_LOSS_T=5", *QUICK_LANDING)
    place = ("--connect", f"{link}:127.0.0.1:{port}", "--gcs", "none")
    simulator = spawn("simulator", *place, *own_failsafe, *hovering(directory, 1.0))
    assert simulator.stdout is not None
    assert simulator.stdout.readline()
    return f"{ours}:127.0.0.1:{port}"


def tracking(spawn: Spawn, connection: str) -> subprocess.Popen[str]:
    """A flight that has just begun to track."""
    flight = spawn("offboard", "fly", "--connect", connection, "--out", "x", *HOVER)
    assert flight.stdout is not None
    for line in flight.stdout:
        if "track: " in line:
            return flight
    raise AssertionError(flight.communicate()[1])


def eventually(holds: Callable[[], object]) -> None:
    deadline_s = time.monotonic() + LONG_S
    while not holds():
        assert time.monotonic() < deadline_s
        time.sleep(0.02)


def ended(pid: int) -> bool:
    """Whether a process has ended; one that nobody waits for has too."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] == "Z"
    except OSError:
        return True


def story(log: tlog.Tlog) -> list[str]:
    """What was asked about the take-over, and that the vehicle disarmed, in order, each once."""
    told: list[str] = []
    for entry in log:
        if entry.name == "COMMAND_LONG" and entry.message.command in (HOLD, LAND):
            told.append("hold" if entry.message.command == HOLD else "land")
        elif entry.name == "STATUSTEXT":
            told.append(entry.message.text.strip())
        elif entry.name == "HEARTBEAT" and entry.frame.component_id == 1:
            told += [] if entry.message.base_mode & ARMED else ["disarmed"]
    begun = next(i for i, text in enumerate(told) if text.startswith("supervisor: taking over"))
    kept = [text for text in told[begun - 1 :] if text in ("hold", "land", "disarmed")]
    return [text for text, before in zip(kept, ["", *kept], strict=False) if text != before]


def test_a_killed_controller_is_survived(spawn: Spawn, tmp_path: Path) -> None:
    flight = tracking(spawn, connections(spawn, "udp", tmp_path))
    (supervisor,) = children(flight.pid)
    flight.kill()
    eventually(lambda: ended(supervisor))
    _, said = flight.communicate()
    assert said.splitlines()[0] == (
        "offboard supervisor: taking over: the controller ended in flight"
    )
    assert said.splitlines()[-1] == "offboard supervisor: the vehicle is disarmed"
    log = tlog.read(tmp_path / "x" / "flight.tlog")
    assert story(log) == ["hold", "land", "disarmed"]
    kept = tmp_path / "x" / "score.json"  # by a process that the supervisor begins
    eventually(kept.exists)
    score = json.loads(kept.read_text())
    assert (score["completed"], score["ended_by"]) == (0.0, "supervisor")
    assert score["reason"] == "supervisor: taking over: the controller ended in flight"


@pytest.mark.slow
def test_a_stopped_controller_that_continues_sends_nothing(spawn: Spawn, tmp_path: Path) -> None:
    flight = tracking(spawn, connections(spawn, "tcp", tmp_path))
    flight.send_signal(signal.SIGSTOP)
    path = tmp_path / "x" / "flight.tlog"
    eventually(lambda: b"hold requested" in path.read_bytes())
    flight.send_signal(signal.SIGCONT)
    _, said = flight.communicate(timeout=LONG_S)
    assert flight.returncode == 4
    assert said.startswith("supervisor: taking over: the controller has not answered for 0.9 s; ")
    assert "; land requested; the vehicle is disarmed" in said
    assert "Traceback" not in said
    log = tlog.read(path)
    assert story(log) == ["hold", "land", "disarmed"]
    texts = [entry for entry in log if entry.name == "STATUSTEXT"]
    taken_us = next(e.unix_us for e in texts if "hold requested" in e.message.text)
    setpoints_us = [e.unix_us for e in log if e.name == "SET_ATTITUDE_TARGET"]
    assert max(setpoints_us) < taken_us
