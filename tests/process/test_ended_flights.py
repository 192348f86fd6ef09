"""Flights that do not end as planned: signals, terminals, pipes, disks. Not only the sentence but
also the log says that the vehicle landed."""

from __future__ import annotations

import ctypes
import errno
import json
import os
import pty
import signal
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path
from unittest.mock import Mock

import pytest
from processes import (
    NO_VEHICLE,
    RECORDING,
    SHORT,
    Called,
    Spawn,
    children,
    ended,
    eventually,
    free_port,
    full_disk,
    hovering,
)

from offboard.analysis import history, tlog
from offboard.analysis.score import score
from offboard.flight.phases import Outcome
from offboard.link import after_flight
from offboard.link.stop import StopRequests
from offboard.mavlink.outgoing import Outgoing
from offboard.run import flight as run
from offboard.run.configuration import load
from offboard.run.sitl import InMemorySimulator


def flown(directory: Path) -> history.History:
    return history.gather(tlog.read(directory / "x" / "flight.tlog"))


def test_ctrl_c_lands_while_ctrl_s_blocks_the_terminal(spawn: Spawn, tmp_path: Path) -> None:
    terminal, theirs = pty.openpty()
    process = spawn(
        "offboard", "fly", "--sitl", "--scenario", "calm", "--out", "x", *SHORT,
        "--set", "reference.duration_s=3600", terminal=theirs, COLUMNS="80", TERM="dumb",
    )  # fmt: skip
    os.close(theirs)
    printed = b""
    while b"track: " not in printed:
        printed += os.read(terminal, 65536)
    os.write(terminal, b"\x13")  # Ctrl-S
    os.killpg(process.pid, signal.SIGINT)  # Ctrl-C reaches all processes of a terminal
    eventually(lambda: b"disarmed: " in (tmp_path / "x" / "flight.tlog").read_bytes())
    assert process.poll() is None
    os.write(terminal, b"\x11")  # Ctrl-Q
    with suppress(OSError):  # nobody is left to print
        while True:
            printed += os.read(terminal, 65536)
    os.close(terminal)
    assert process.wait(timeout=30) == 4
    lines = printed.decode().replace("\r", "\n").splitlines()
    assert max(map(len, lines)) <= 80
    sentence = "stop requested by the operator (log: x/flight.tlog)"
    assert " ".join(line.strip() for line in lines).count(sentence) == 1
    assert "AUTO.LAND" in [mode.what for mode in flown(tmp_path).modes]
    assert flown(tmp_path).phases[-1].what.startswith("disarmed")


def test_interrupt_before_the_flight_leaves_no_simulator(spawn: Spawn, tmp_path: Path) -> None:
    """It is obeyed at once, although compiling takes longer than the timeout."""
    process = spawn("offboard", "fly", "--sitl", "--out", "x", XDG_CACHE_HOME=str(tmp_path / "c"))
    while process.poll() is None and not children(process.pid):
        time.sleep(0.01)
    (simulator,) = children(process.pid)
    process.send_signal(signal.SIGTERM)
    _, said = process.communicate(timeout=5)
    assert (process.returncode, said) == (130, "interrupted before anything was sent\n")
    eventually(lambda: ended(simulator))  # it was still starting and ends by itself
    assert not (tmp_path / "x").exists()


def interrupted_while_compiling(*_: object, **__: object) -> float:
    """A rehearsal with a signal in a callback of the compiler, which lets no exception through."""
    ctypes.CFUNCTYPE(None)(lambda: signal.raise_signal(signal.SIGINT))()
    return 0.0


def test_interrupt_while_compiling_prevents_the_flight(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(run, "rehearse", interrupted_while_compiling)
    vehicle = run.Connection(f"udpin:127.0.0.1:{free_port()}")
    with pytest.raises(KeyboardInterrupt):
        run.fly(load("flight"), tmp_path / "x", vehicle)
    assert not list(tmp_path.iterdir())


def test_interrupt_once_the_log_exists_ends_the_flight_with_an_outcome(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(_: str) -> list[Outgoing]:
        signal.raise_signal(signal.SIGINT)
        return []

    monkeypatch.setattr(run, "configuration_pieces", interrupted)
    with StopRequests(lambda: pytest.fail("the program has ended")) as stops:
        simulator = InMemorySimulator()
        outcome = run.fly(
            load("flight"), tmp_path / "x", run.Simulated(), simulator=simulator, stops=stops
        )
    assert outcome.exit_code == 3
    assert "stop requested by the operator" in outcome.sentence


def test_missing_vehicle_ends_fly_with_code_3(called: Called, tmp_path: Path) -> None:
    code, _, said = called(NO_VEHICLE)
    assert (code, said.count("\n")) == (3, 1)
    assert said.startswith("no vehicle heard in 0 s; is it running, and sending to this port?")
    log = tlog.read(tmp_path / "x" / "flight.tlog")
    assert history.configuration(log) == (tmp_path / "x" / "flight.yaml").read_text()
    logged = flown(tmp_path)
    assert logged.phases[-1].phase == "failed"
    assert score(logged).ended_by == "link"


@pytest.mark.usefixtures("in_memory")
def test_full_disk_in_flight_begins_a_landing(
    called: Called, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(after_flight, "begin_report", lambda _: None)
    with full_disk(380_000):
        code, shown, said = called("offboard fly --sitl --report --out x", *SHORT)
    assert (code, said.count("\n")) == (4, 1), said
    assert "flight.tlog cannot be written (File too large)" in said
    assert "land: the log x/flight.tlog cannot be written (File too large)" in shown
    assert "by the operator" not in shown
    assert "report.html" not in shown  # the full disk has no room for it
    assert sum(1 for _ in tlog.read(tmp_path / "x" / "flight.tlog")) > 1000


def test_deleted_log_begins_a_landing(tmp_path: Path) -> None:
    config, log = load("flight", known_vehicle="px4_sih"), tmp_path / "x" / "flight.tlog"
    outcome = run.fly(
        config, log.parent, run.Simulated(), simulator=InMemorySimulator(),
        progress=lambda flight: log.unlink(missing_ok=True) if flight.time_s > 20.0 else None,
    )  # fmt: skip
    assert outcome.exit_code == 4
    assert outcome.sentence.startswith(f"the log {log} cannot be written (it was deleted): ")


UNSCORED = {
    "interrupted": KeyboardInterrupt,
    "not enough memory": MemoryError,
    "ValueError: axes do not match": ValueError("axes do not match"),
    "x: Input/output error": OSError(errno.EIO, os.strerror(errno.EIO), "x"),
}


@pytest.mark.usefixtures("in_memory")
@pytest.mark.parametrize("why", ["deleted", "replaced", *UNSCORED])
@pytest.mark.parametrize(
    ("outcome", "options", "code"),
    [
        (Outcome(0, "flown and landed"), (), 0),
        (Outcome(0, "flown and landed"), ("--require", "rmse_position_m<9"), 1),
        (Outcome(4, "not disarmed"), ("--require", "rmse_position_m<9"), 4),
    ],
)
def test_a_flight_that_cannot_be_scored_keeps_its_outcome(
    called: Called, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    why: str, outcome: Outcome, options: tuple[str, ...], code: int,
) -> None:  # fmt: skip
    """Its log is gone, or scoring fails; 2 or 130 would say that nothing was sent."""
    if why == "replaced":
        (tmp_path / "x").mkdir()
        (tmp_path / "x" / "flight.tlog").write_text("of another")
    elif why in UNSCORED:
        monkeypatch.setattr("offboard.cli.fly.scored", Mock(side_effect=UNSCORED[why]))
    monkeypatch.setattr(run, "fly", lambda *_, **__: outcome)
    reason = why if why in UNSCORED else "x"
    says = f"{outcome.sentence}; it cannot be scored: {reason}"
    found, *printed = called("offboard fly --sitl --out x", *options)
    text = " ".join("".join(printed).split())
    assert (found, says in text) == (code, True), text
    assert ("requirement missed: rmse_position_m is not in this log" in text) == (code == 1)
    found, shown, _ = called("offboard fly --sitl --json-lines --out x", *options)
    result = json.loads(shown.splitlines()[-1])
    assert (found, result["exit_code"], result["completed"]) == (code, code, False)


@pytest.mark.usefixtures("in_memory")
def test_json_lines_announce_live_page_and_end_with_result(called: Called, tmp_path: Path) -> None:
    shows = ("--json-lines", "--live", "127.0.0.1:0", "--require", "rmse_position_m<0")
    code, shown, said = called("offboard fly --sitl --scenario calm --out x", *SHORT, *shows)
    assert (code, said) == (1, "")
    *others, result = (json.loads(line) for line in shown.splitlines())
    assert others[0]["text"].startswith("live: http://127.0.0.1:")
    assert {each["type"] for each in others} == {"preparation", "announcement", "snapshot"}
    assert (result["type"], result["exit_code"], result["completed"]) == ("result", 1, True)
    assert result["requirements"].startswith("rmse_position_m is ")
    score = json.loads((tmp_path / "x" / "score.json").read_text())
    assert result["figures"]["rmse_position_m"] == float(f"{score['rmse_position_m']:.9g}")
    times = [each["time_s"] for each in others if each["type"] == "snapshot"]
    assert times[1:] == [float(second) for second in range(1, len(times))]


@pytest.mark.usefixtures("in_memory")
@pytest.mark.parametrize(
    ("scenario", "sentence"),
    [
        ("pilot_disarms", "the vehicle accepted arming, but its HEARTBEAT shows it disarmed"),
        ("clock_jump_35s", "the clock of the vehicle jumped by 35.0 s"),
        ("link_saturates", "telemetry is 1.10 s old"),
    ],
)
def test_lockstep_flights_report_the_true_cause(
    called: Called, scenario: str, sentence: str
) -> None:
    """The sentence does not say that the vehicle did not arm, or that its mode was not reported for
    36 s: answers come at the same vehicle time, and only the clock has jumped. A link that becomes
    late is noticed as soon as in real time."""
    code, _, said = called(
        "offboard fly --sitl --reference lemniscate --set reference.laps=2 --controller lqr "
        "--set identify.online=false --out x --no-report --scenario", scenario,
    )  # fmt: skip
    assert (code, said.startswith(sentence)) == (3 if "pilot" in scenario else 4, True), said


# --- a process that ends as its console script does ---

IMPORTS = """
import builtins, signal
signal.signal(signal.SIGINT, signal.default_int_handler)
import offboard.cli
count, real = 0, builtins.__import__
def imported(*arguments, **named):
    global count
    count += 1
    if count == 100:
        signal.raise_signal(signal.SIGINT)
    return real(*arguments, **named)
builtins.__import__ = imported
"""
CLOSED = "import os; r, w = os.pipe(); os.close(r); os.dup2(w, 1)"
NONE_OPEN = """
import atexit, os
atexit.register(lambda: os._exit(os.open(os.devnull, os.O_RDONLY)))  # the lowest free descriptor
os.closerange(0, 3)
sys.stdin = sys.stdout = sys.stderr = None
"""


@pytest.mark.parametrize(
    ("begin", "command", "code", "said"),
    [
        (IMPORTS, ["--help"], 130, "interrupted\n"),  # by the 100th import of `main`
        (CLOSED, ["score", str(RECORDING)], 141, ""),  # nobody reads it: as SIGPIPE
        (f"{CLOSED}; os.dup2(w, 2)", ["check", "nothere.yaml"], 2, ""),
        (NONE_OPEN, ["check", "nothere.yaml"], 3, ""),  # a log or socket must not become stderr
    ],
    ids=["interrupted import", "closed pipe", "closed pipe of both", "closed output"],
)
def test_interrupts_and_closed_outputs_set_the_exit_code(
    begin: str, command: list[str], code: int, said: str
) -> None:
    script = f"import sys; sys.argv = {['offboard', *command]!r}\n{begin}\n"
    script += "from offboard.cli import main\nsys.exit(main())"
    answer = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert (answer.returncode, answer.stderr) == (code, said)


# --- a controller that is killed: the supervisor lands the vehicle ---
#
# Real processes in real time. The log shows what was asked of the vehicle, and that the simulated
# autopilot, another program, obeyed and landed. `flight/test_supervisor.py` tests a controller that
# is stopped and continues, and other links.

HOLD, LAND = 176, 21  # MAV_CMD
ARMED = 128  # MAV_MODE_FLAG_SAFETY_ARMED
# a long COM_OF_LOSS_T: on a busy machine PX4's failsafe would act before the supervisor
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
    """What was asked at the take-over ("hold", "land"), and "disarmed", in order, each once."""
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


def test_supervisor_lands_after_the_controller_is_killed(spawn: Spawn, tmp_path: Path) -> None:
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
    kept = tmp_path / "x" / "score.json"  # written by a process that the supervisor starts
    eventually(kept.exists)
    score = json.loads(kept.read_text())
    assert (score["completed"], score["ended_by"]) == (0.0, "supervisor")
    assert score["reason"] == "supervisor: taking over: the controller ended in flight"
