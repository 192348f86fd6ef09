"""Bad input: one sentence (what, where, what to do), the right exit code, no traceback.

What ends before anything is sent is called in this process; the rest are real processes.
"""

from __future__ import annotations

import ctypes
import io
import json
import os
import resource
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from processes import SHORT, Called, Spawn, children, free_port
from pymavlink.dialects.v20 import ardupilotmega as dialect

from offboard.analysis import history, tlog
from offboard.analysis.score import keep_score, score_flight
from offboard.documents.signing_key import create_key
from offboard.flight import inputs
from offboard.flight.record import RECORD_COMPONENT_ID
from offboard.link.log import LogError
from offboard.run import flight as run

CONFIG = Path(__file__).parents[2] / "config"
RECORDING = Path(__file__).parents[1] / "wire" / "recordings" / "px4-1.16.1-offboard.tlog"
CAMPAIGN = CONFIG / "campaigns" / "quick.yaml"
NOW_US = 1_790_000_000_000_000  # of an entry of a log
Call = Callable[..., tuple[int, str]]


@pytest.fixture
def offboard(called: Called) -> Call:
    """`offboard("fly", ...)` -> (exit code, stderr)."""
    return lambda *arguments: called("offboard", *arguments)[::2]


def kept_out(north_m: float, east_m: float, height_m: float, radius_m: float) -> tuple[str, ...]:
    sphere = {"north_m": north_m, "east_m": east_m, "height_m": height_m, "radius_m": radius_m}
    volumes = json.dumps([{"shape": "sphere"} | sphere])
    return ("--controller", "horizon", "--set", f"controller.keep_out={volumes}")


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (("--firmware", "frog"), "--firmware frog: unknown; there is px4, ardupilot"),
        (("--sim-vehicle", "tank"), "there is no vehicle named 'tank'; known are arducopter"),
        (("--scenario", "no.yaml"), "no.yaml cannot be read: No such file"),
    ],
)
def test_what_the_simulator_cannot_fly_is_refused_before_anything_is_built(
    arguments: tuple[str, ...], expected: str, offboard: Call, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(run, "build", pytest.fail)
    code, output = offboard("fly", "--sitl", *arguments)
    assert (code, len(output.splitlines())) == (2, 1)
    assert expected in output


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (("--config", "nonsense"), "no configuration named 'nonsense'; known are flight, paper"),
        (("--reference", "spiral"), "no reference named 'spiral'; known are circle"),
        (("--reference", "missing.csv"), "missing.csv cannot be read: No such file"),
        (
            ("--set", "period_s=7"),
            "--set period_s=7: period_s: 7 should be less than or equal to 0.5",
        ),
        (("--set", "controller.seed=3"), "controller.seed is not a known key"),
        (
            ("--set", "controller.law=frog"),
            "--set controller.law=frog: controller: law: 'frog' is not one of pso, lqr,",
        ),
        (("--set", "controller=pid2"), "no controller named 'pid2'; known are"),
        (
            ("--set", "controller.bandwidth_radps=fast"),
            "--set controller.bandwidth_radps=fast: controller.bandwidth_radps: 'fast' should be "
            "a valid number",
        ),
        (("--seed", "-1"), "--seed -1: seed: -1 should be greater than or equal to 0"),
        (
            ("--set", "vehicle.drag_translation_npmps=[0, 0, 1e9]"),
            "vehicle: drag_translation_npmps must be at most 100 per kg of mass",
        ),
        (
            ("--require", "rmse<1"),
            "there is no metric 'rmse'; there are completed, touchdown_mps, rmse_position_m",
        ),
        (("--connect", "udpin:127.0.0.1:0"), "give the port that the vehicle sends to"),
        (("--connect", "udpin:127.0.0.1"), "is not understood; use udpin:HOST:PORT"),
        (("--connect", "udpin:::1:14540"), "an IPv6 address stands in brackets, as in udpin:[::1]"),
        (("--signing-key", "/dev/null"), "signing key /dev/null is not a file"),
        (("--out", "/proc/nowhere"), "choose a directory that can be written with --out"),
        (("--firmware", "px4"), "--firmware are options of --sitl: add it"),
        (("--vehicle", CAMPAIGN), "quick.yaml is a campaign file; a vehicle file is needed here"),
        (("--sitl",), "--sitl starts its own simulator: use --sitl or --connect, not both"),
        (kept_out(0, 0, 3, 0.5), "keep_out[0] (sphere) contains the start of the reference"),
        (
            (
                "--controller",
                "horizon",
                "--set",
                "controller.steps=40",
                "--set",
                "controller.swarm.particles=2000",
                "--set",
                "deadline_s=0.0006",
            ),
            "longer than deadline_s (0.6 ms); plan fewer steps or allow more time",
        ),
        (("--controller", "horizon", "--set", "controller.keep_out=[{shape: cone}]"), "keep_out"),
    ],
)
def test_usage_is_refused_before_anything_is_sent(
    arguments: tuple[object, ...], expected: str, offboard: Call, tmp_path: Path
) -> None:
    code, output = offboard("fly", "--connect", "udpin:127.0.0.1:PORT", *arguments)
    assert code == 2, output
    assert expected in output
    assert "Traceback" not in output
    assert len(output.strip().splitlines()) == 1
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("address", "expected"),
    [
        ("tcpin:192.0.2.1:14540", "cannot be opened: Cannot assign requested"),
        ("tcp:127.0.0.1:1", "cannot be opened: Connection refused"),
        ("serial:/dev/nonexistent:57600", "cannot be opened"),
    ],
)
def test_a_vehicle_that_cannot_be_reached_is_the_same_to_every_command(
    address: str, expected: str, offboard: Call, called: Called
) -> None:
    code, output = offboard("fly", "--connect", address)
    assert (code, output.count("\n")) == (3, 1)
    assert expected in output
    code, told, _ = called("offboard doctor port", "--connect", address)
    assert code == 3
    assert expected in " ".join(told.split())
    assert told.endswith("\n1 blocks: port\n")


CSV = "time_s,north_m,east_m,altitude_m\n0,0,0,3\n3,2,0,3\n6,2,{east},4\n9,0,0,3\n"


@pytest.mark.parametrize(
    ("name", "content", "expected"),
    [
        ("flight.yaml", "vehicle: px4_sih", "flight.yaml: controller is missing"),
        ("flight.yaml", "seed: 3", "flight.yaml: reference is missing; give a name, a file or a"),
        ("flight.yaml", "controler: pso", "controller is missing (is it meant by controler?)"),
        ("flight.yaml", "# nothing yet", "flight.yaml is empty"),
        ("path.csv", "", "path.csv is empty: it needs a header and at least 4 rows"),
        ("mine.yaml", "mas_kg: 1", "mas_kg is not a known key, did you mean mass_kg?"),
        ("mine.yaml", "hover_thrust: 0.5", "mine.yaml: mass_kg is missing"),
        ("law.yaml", "bandwidth_radps: 5", "law.yaml: law is missing; known are pso, lqr,"),
        ("path.csv", CSV.format(east="two"), "path.csv, row 4, column east_m: 'two' is not a"),
        ("path.csv", CSV.format(east=90), "reference path.csv: the reference asks for"),
        ("path.csv", CSV.format(east=1e300), "a distance of inf m at"),
        (
            "circle.yaml",
            "shape: circle\nperiod_s: 0",
            "circle.yaml, line 2, column 1: period_s: 0 should be",
        ),
        (
            "storm.yaml",
            "name: storm\nconditions: {thrust_scale: 9}",
            "storm.yaml, line 2, column 14: conditions.thrust_scale: 9 should be less",
        ),
        (
            "storm.yaml",
            "name: s\nfaults: [{kind: frogs}]",
            "storm.yaml, line 2, column 1: faults.0",
        ),
        ("c.yaml", "parameters: {seed: [1]}\nrequire: [x<1]", "require.0: there is no metric 'x'"),
    ],
)
def test_every_kind_of_file_is_checked(
    name: str, content: str, expected: str, offboard: Call, tmp_path: Path
) -> None:
    (tmp_path / name).write_text(content)
    code, output = offboard("check", name)
    assert (code, "Traceback" in output) == (2, False)
    assert expected in output


def test_all_shipped_files_are_valid(offboard: Call) -> None:
    files = [path for path in CONFIG.rglob("*.yaml") if "scenarios" not in path.parts]
    assert len(files) > 25
    scenario = CONFIG / "scenarios" / "all_together.yaml"
    assert offboard("check", scenario, *files) == (0, "")


def test_port_in_use(offboard: Call) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind(("127.0.0.1", 0))
        port = other.getsockname()[1]
        code, output = offboard("fly", "--connect", f"udpin:127.0.0.1:{port}")
    assert code == 3
    assert f"'udpin:127.0.0.1:{port}' cannot be opened" in output
    assert "another program uses the port" in output


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        (b"", "is not a .tlog, or empty"),
        (b"PK\3\4" + bytes(500), "is not a .tlog"),
    ],
)
def test_foreign_log(content: bytes, expected: str, offboard: Call, tmp_path: Path) -> None:
    (tmp_path / "x.tlog").write_bytes(content)
    code, output = offboard("score", "x.tlog")
    assert (code, "Traceback" in output) == (2, False)
    assert expected in output


def test_a_configuration_that_unpacks_to_gigabytes_is_refused(
    offboard: Call, tmp_path: Path
) -> None:
    """Here to 40 MB, by a thousand times as many as its bytes."""
    packed = inputs.pieces(40_000_000 * " ")
    codec = dialect.MAVLink(None, srcSystem=1, srcComponent=RECORD_COMPONENT_ID)
    log = io.BytesIO()
    for piece in packed:
        data = piece.data.ljust(128, b"\0")
        message = codec.tunnel_encode(0, 0, piece.payload_type, len(piece.data), list(data))
        log.write(NOW_US.to_bytes(8, "big") + message.pack(codec))
    (tmp_path / "x.tlog").write_bytes(log.getvalue() + RECORDING.read_bytes())
    code, output = offboard("report", "x.tlog")
    assert (code, output) == (2, "x.tlog: its configuration unpacks to more than 4000 kB\n")


def test_nothing_identified_is_no_vehicle_file(offboard: Call, tmp_path: Path) -> None:
    still = RECORDING.with_name("arducopter-4.6.3-guided.tlog")
    code, output = offboard("identify", still, "-o", "mine.yaml", "--page", "page.html")
    assert code == 1
    assert output == "nothing could be identified from this flight; page.html says why\n"
    assert [path.name for path in tmp_path.iterdir()] == ["page.html"]


def test_truncated_log_is_scored_up_to_there(offboard: Call, tmp_path: Path) -> None:
    (tmp_path / "cut.tlog").write_bytes(RECORDING.read_bytes()[:-7])
    code, output = offboard("score", "cut.tlog")
    assert (code, output) == (0, "")


def test_no_vehicle(offboard: Call, tmp_path: Path) -> None:
    code, output = offboard(
        "fly", "--connect", "udpin:127.0.0.1:PORT", "--set", "limits.connect_s=0.3", "--out", "x"
    )
    assert code == 3
    assert output.startswith("no vehicle heard in 0 s; is it running, and sending to this port?")
    assert len(output.strip().splitlines()) == 1
    log = tlog.read(tmp_path / "x" / "flight.tlog")
    assert history.configuration(log) == (tmp_path / "x" / "flight.yaml").read_text()
    assert history.gather(log).phases[-1].phase == "failed"


def in_flight(spawn: Spawn, *arguments: str) -> subprocess.Popen[str]:
    """A bundled flight that hovers for an hour and has just begun to."""
    process = spawn(
        "offboard", "fly", "--sitl", "--scenario", "calm", "--out", "x", *SHORT,
        "--set", "reference.duration_s=3600", *arguments,
    )  # fmt: skip
    assert process.stdout is not None
    for line in process.stdout:
        if "track: " in line:
            return process
    raise AssertionError(process.communicate()[1])


def test_interrupt_lands(spawn: Spawn, tmp_path: Path) -> None:
    process = in_flight(spawn)
    process.send_signal(signal.SIGINT)
    _, output = process.communicate(timeout=60)
    assert process.returncode == 4
    assert output.startswith("stop requested by the operator (log: x/flight.tlog)")
    assert len(output.strip().splitlines()) == 1
    flown = history.gather(tlog.read(tmp_path / "x" / "flight.tlog"))
    assert "AUTO.LAND" in [mode.what for mode in flown.modes]
    assert flown.phases[-1].what.startswith("disarmed")


def interrupted_while_compiling(*_: object, **__: object) -> float:
    """A rehearsal: what is raised in a callback of the compiler goes no further than that."""
    ctypes.CFUNCTYPE(None)(lambda: signal.raise_signal(signal.SIGINT))()
    return 0.0


def test_interrupted_while_it_compiles_it_does_not_fly(
    offboard: Call, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(run, "rehearse", interrupted_while_compiling)
    code, output = offboard(
        "fly", "--connect", "udpin:127.0.0.1:PORT", "--set", "limits.connect_s=0.3"
    )
    assert (code, output) == (130, "interrupted before anything was sent\n")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("signals", [[signal.SIGTERM], [signal.SIGINT, signal.SIGINT]])
def test_ended_before_flight_it_leaves_no_simulator(
    signals: list[int], spawn: Spawn, tmp_path: Path
) -> None:
    process = spawn("offboard", "fly", "--sitl", "--out", "x")
    while process.poll() is None and not children(process.pid):
        time.sleep(0.01)
    (simulator,) = children(process.pid)
    for number in signals:
        process.send_signal(number)
        time.sleep(1.05)  # a second one within a second is the same request
    _, output = process.communicate(timeout=60)
    assert (process.returncode, output) == (130, "interrupted before anything was sent\n")
    deadline_s = time.monotonic() + 10.0  # hit while it started: it ends by itself, alone
    while Path(f"/proc/{simulator}").exists() and time.monotonic() < deadline_s:
        time.sleep(0.01)
    assert not Path(f"/proc/{simulator}").exists()


def test_a_pipe_that_closes_ends_no_flight(spawn: Spawn, tmp_path: Path) -> None:
    process = spawn("offboard", "fly", "--sitl", "--out", "x", *SHORT)
    assert process.stdout is not None
    assert process.stdout.readline()
    process.stdout.close()
    assert process.wait(timeout=60) == 0
    flown = history.gather(tlog.read(tmp_path / "x" / "flight.tlog"))
    assert flown.phases[-1].what.startswith("disarmed")


def test_a_score_that_cannot_be_written_is_reported(offboard: Call, tmp_path: Path) -> None:
    (tmp_path / "x" / "score.json").mkdir(parents=True)
    (tmp_path / "x" / "flight.tlog").write_bytes(RECORDING.read_bytes())
    assert offboard("score", "x") == (0, "x/score.json cannot be written (Is a directory)\n")


def test_an_incomplete_score_is_not_kept(tmp_path: Path) -> None:
    score, flown = score_flight(RECORDING)
    limit = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100, limit[1]))
    try:
        with pytest.raises(LogError, match=r"score\.json cannot be written"):
            keep_score(tmp_path, score, flown)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limit)
    assert not list(tmp_path.iterdir())


def test_simulator_killed_in_flight(spawn: Spawn, tmp_path: Path) -> None:
    process = in_flight(spawn)
    (simulator,) = children(process.pid)
    os.kill(simulator, signal.SIGKILL)
    _, output = process.communicate(timeout=30)
    assert process.returncode == 4
    assert output.startswith("the bundled simulator ended (signal 9) (log: x/flight.tlog)")
    assert len(output.strip().splitlines()) == 1
    flown = history.gather(tlog.read(tmp_path / "x" / "flight.tlog"))
    assert len(flown.setpoint) > 50


def with_full_disk(
    tmp_path: Path, holds_bytes: int, *arguments: str
) -> subprocess.CompletedProcess[str]:
    """Run `offboard`. A file size limit stands for the full disk."""
    limited = "import resource, signal, runpy, sys; signal.signal(signal.SIGXFSZ, signal.SIG_IGN);"
    limited += f"resource.setrlimit(resource.RLIMIT_FSIZE, ({holds_bytes}, {holds_bytes}));"
    limited += "sys.argv[0] = 'offboard'; runpy.run_module('offboard', run_name='__main__')"
    return subprocess.run(
        [sys.executable, "-c", limited, *arguments],
        cwd=tmp_path, capture_output=True, text=True, timeout=60,
        env=os.environ | {"XDG_STATE_HOME": str(tmp_path)},
    )  # fmt: skip


@pytest.mark.parametrize(
    ("command", "holds_bytes", "code"),
    [("fly", 0, 2), ("daemon", 10, 3)],
    ids=["fly", "daemon's signing time"],
)
def test_full_disk_before_a_flight(
    command: str, holds_bytes: int, code: int, tmp_path: Path
) -> None:
    """Nothing was sent. The service manager starts a daemon again, which waits for room."""
    create_key(tmp_path / "key")
    connection = f"udpin:127.0.0.1:{free_port()}"
    process = with_full_disk(tmp_path, holds_bytes, command, "--connect", connection, "--out", "x",
                             "--signing-key", "key")  # fmt: skip
    assert process.returncode == code
    assert "File too large" in process.stderr
    assert len(process.stderr.splitlines()) == 1


def test_full_disk_lands(tmp_path: Path) -> None:
    process = with_full_disk(tmp_path, 380_000, "fly", "--sitl", "--out", "x", *SHORT)
    assert process.returncode == 4, process.stderr
    assert "flight.tlog cannot be written (File too large)" in process.stderr
    assert "Traceback" not in process.stderr
    assert "land: the log x/flight.tlog cannot be written (File too large)" in process.stdout
    assert "by the operator" not in process.stdout
    assert sum(1 for _ in tlog.read(tmp_path / "x" / "flight.tlog")) > 1000
