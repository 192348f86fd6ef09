"""A controller that is killed in flight: the supervisor lands the vehicle.

Real processes in real time. The log says what was asked of the vehicle; the simulated autopilot,
which is another program, that it obeyed and landed. A controller that is stopped and continues, and
other links: `flight/test_supervisor.py`.
"""

from __future__ import annotations

import json
import subprocess
from pathlib import Path

from processes import SHORT, Spawn, children, ended, eventually, free_port, hovering

from offboard.analysis import tlog

HOLD, LAND = 176, 21  # MAV_CMD
ARMED = 128  # MAV_MODE_FLAG_SAFETY_ARMED
# with the longest timeout of its own: on a busy machine its failsafe would come first
PARAMETERS = ("COM_OF_LOSS_T=5", "MPC_LAND_CRWL=0.7", "COM_DISARM_LAND=0.5")


def tracking(spawn: Spawn, directory: Path) -> subprocess.Popen[str]:
    """A flight that has just begun to track: its vehicle hovers when its link opens."""
    port = free_port()
    link = ("--connect", f"udpout:127.0.0.1:{port}", "--gcs", "none")
    spawn("simulator", *link, *hovering(directory, 1.0), *(f"--param={p}" for p in PARAMETERS))
    flight = spawn(
        "offboard", "fly", "--connect", f"udpin:127.0.0.1:{port}", "--out", "x", *SHORT,
        "--set", "reference.duration_s=600",
    )  # fmt: skip
    assert flight.stdout is not None
    for line in flight.stdout:
        if "track: " in line:
            return flight
    raise AssertionError(flight.communicate()[1])


def take_over(log: tlog.Tlog) -> list[str]:
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
    flight = tracking(spawn, tmp_path)
    (supervisor,) = children(flight.pid)
    flight.kill()
    eventually(lambda: ended(supervisor))
    _, said = flight.communicate()
    assert said.splitlines()[0] == (
        "offboard supervisor: taking over: the controller ended in flight"
    )
    assert said.splitlines()[-1] == "offboard supervisor: the vehicle is disarmed"
    log = tlog.read(tmp_path / "x" / "flight.tlog")
    assert take_over(log) == ["hold", "land", "disarmed"]
    kept = tmp_path / "x" / "score.json"  # by a process that the supervisor begins
    eventually(kept.exists)
    score = json.loads(kept.read_text())
    assert (score["completed"], score["ended_by"]) == (0.0, "supervisor")
    assert score["reason"] == "supervisor: taking over: the controller ended in flight"
