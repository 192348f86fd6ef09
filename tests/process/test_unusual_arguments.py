"""Arguments, files and processes that no user means: one sentence, exit code 2, no file changed.

What ends before anything is sent is called in this process; the rest are real processes.
"""

from __future__ import annotations

import os
import resource
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from processes import Called

from offboard.campaign.results import Record
from offboard.cli import fly

RECORDING = Path(__file__).parents[1] / "wire" / "recordings" / "px4-1.16.1-offboard.tlog"
SURROGATE = os.fsdecode(b"caf\xe9")
LONG = 300 * "n"
Call = Callable[..., tuple[int, str]]
LINK = ("--connect", "udpin:127.0.0.1:PORT", "--set", "limits.connect_s=0.1")


@pytest.fixture
def call(called: Called) -> Call:
    """`call("offboard fly", ...)` -> (exit code, stderr)."""
    return lambda *arguments: called(*arguments)[::2]


def refused(answer: tuple[int, str]) -> str:
    """The one sentence of a refusal."""
    code, said = answer
    assert (code, said.count("\n"), "Traceback" in said) == (2, 1, False), said
    return said


@pytest.mark.parametrize(
    ("command", "options"),
    [
        ("offboard fly", ("--connect", "--config", "--out", "--require", "--set", "--firmware")),
        ("offboard compare", ("--controllers", "--scenario")),
        ("offboard identify", ("--page", "FLIGHT")),
        ("offboard report", ("FLIGHT...", "--output")),
        ("offboard paper", ("--figure", "--initial-q")),
        ("simulator", ("--connect", "--param", "--log", "--check")),
    ],
)
def test_a_value_that_is_no_text_is_refused(
    command: str, options: tuple[str, ...], call: Call, tmp_path: Path
) -> None:
    refusals = {
        "": "the value is empty; is a variable unset?",
        " \t": "the value is empty; is a variable unset?",
        SURROGATE: r"'caf\udce9' is not UTF-8",
    }
    for option in options:
        for value, says in refusals.items():
            given = (option, value) if option.startswith("-") else (value,)
            assert refused(call(command, *given)) == f"{option}: {says}\n"
    assert not list(tmp_path.iterdir())


def test_an_option_is_no_value_of_the_one_before_it(call: Call, tmp_path: Path) -> None:
    said = refused(call("offboard fly", "--out", "--sitl"))
    assert said == "--out: '--sitl' is an option, not a value; is a variable unset?\n"
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("command", "arguments"),
    [
        ("offboard fly", (*LINK, "--config", LONG)),
        ("offboard fly", (*LINK, "--reference", f"{LONG}.csv")),
        ("offboard fly", (*LINK, "--out", LONG)),
        ("offboard fly", (*LINK, "--set", 'vehicle="a\\0/b"')),
        ("offboard fly", (*LINK, "--set", 'vehicle.name="\\ud800"')),
        ("offboard fly", (*LINK, "--set", f"controller.{5000 * '9'}=1")),
        ("offboard fly", (*LINK, "--seed", 5000 * "9")),
        ("offboard fly", ("--connect", f"udpin:127.0.0.1:{5000 * '9'}")),
        ("offboard fly", ("--connect", "udpin:127.0.0.1:²")),
        ("offboard fly", ("--connect", "udpin:a..b:14540")),
        ("offboard fly", ("--connect", "serial:/dev/null:9999999999")),
        ("offboard compare", ("--controllers", "lqr", "--scenario", "calm", "--out", LONG)),
        ("offboard score", (LONG,)),
        ("offboard identify", (RECORDING, "-o", f"nowhere/{LONG}")),
        ("offboard report", (RECORDING, "-o", LONG)),
        ("simulator", ("--scenario", f"{LONG}.yaml")),
        ("simulator", ("--log", "/dev/full", "--duration", "0.1", "--gcs", "none")),
        ("simulator", ("--connect", "udpin:a..b:14540")),
        ("simulator", ("--duration", "nan")),
    ],
)
def test_a_name_or_number_beyond_every_limit_is_refused(
    command: str, arguments: tuple[object, ...], call: Call, tmp_path: Path
) -> None:
    code, said = call(command, *arguments)
    assert (code, "Traceback" in said) == (2, False), said
    assert len(said) < 600 or "--seed" in said
    assert said.count("\n") == 1
    assert not list(tmp_path.iterdir())


def test_a_directory_with_a_flight_is_left_as_it_is(call: Call, tmp_path: Path) -> None:
    for name in ("flight.yaml", "flight.tlog", "score.json"):
        (tmp_path / name).mkdir()
        (tmp_path / name / name).write_text("precious")
        said = refused(call("offboard fly", *LINK, "--out", name))
        assert said.startswith(f"{name}/{name} exists: the directory already holds a flight;")
        assert [path.read_text() for path in (tmp_path / name).iterdir()] == ["precious"]


@pytest.mark.parametrize(
    ("command", "says"),
    [
        ("offboard paper --quick --table 2 --out x", "is not empty; choose another"),
        (f"offboard identify {RECORDING} --page x/old", "x/old exists already; choose another"),
        (f"offboard identify {RECORDING} -o new --page new", "-o and --page are both new"),
        (f"offboard identify {RECORDING} -o y/new", "-o y/new: there is no directory y"),
        (f"offboard identify {RECORDING} --out x", "a log needs no --system, --out or other"),
        ("simulator --log x/old --duration 0.1 --gcs none", "--log x/old cannot be written: File"),
    ],
)
def test_no_command_overwrites_a_file(command: str, says: str, call: Call, tmp_path: Path) -> None:
    (tmp_path / "x").mkdir()
    old = tmp_path / "x" / "old"
    old.write_text("precious")
    before = old.stat().st_mtime_ns
    assert says in refused(call(command.split()[0], *command.split()[1:]))
    assert [path.name for path in tmp_path.rglob("*")] == ["x", "old"]
    assert (old.read_text(), old.stat().st_mtime_ns) == ("precious", before)


def test_the_page_of_a_second_identification_has_a_name_of_its_own(
    call: Call, tmp_path: Path
) -> None:
    """Its title is the name of the flight directory, also of the working directory."""
    (tmp_path / "flight.tlog").write_bytes(RECORDING.read_bytes())
    (tmp_path / "identify.html").write_text("precious")
    assert call("offboard identify", ".") == (0, "")
    assert (tmp_path / "identify.html").read_text() == "precious"
    assert f"<title>Flight {tmp_path.name}</title>" in (tmp_path / "identify-2.html").read_text()


FILES: dict[str, Callable[[Path], object]] = {
    "a FIFO": os.mkfifo,
    "/dev/zero": lambda path: path.symlink_to("/dev/zero"),
    "a directory": Path.mkdir,
    "larger than 500 kB": lambda path: path.write_text("# comment\n" * 60_000),
}


@pytest.mark.parametrize("kind", FILES)
@pytest.mark.parametrize("command", ["offboard check", "simulator --vehicle"])
def test_only_regular_files_of_a_bounded_size_are_read(
    kind: str, command: str, call: Call, tmp_path: Path
) -> None:
    FILES[kind](tmp_path / "x.yaml")
    said = refused(call(*command.split(), "x.yaml"))
    reason = kind if kind.startswith("larger") else "not a regular file"
    assert f"x.yaml cannot be read: {reason}" in said


def test_only_a_regular_file_is_a_log(call: Call, tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "x.tlog")
    assert "x.tlog is not a regular file; name a flight directory or a .tlog file" in refused(
        call("offboard score", "x.tlog")
    )


@pytest.mark.parametrize("command", ["score", "identify"])
def test_a_damaged_log_is_read_and_named(command: str, call: Call, tmp_path: Path) -> None:
    data = bytearray(RECORDING.read_bytes())
    data[8 + 12] ^= 0x40  # payload of the first frame
    (tmp_path / "x.tlog").write_bytes(data)
    said = "x.tlog: 1 damaged entry was skipped, the first at byte 0\n"
    assert call(f"offboard {command}", "x.tlog") == (0, said)


def test_of_many_errors_the_first_ten_are_printed(call: Call, tmp_path: Path) -> None:
    keys = "".join(f"key_{number}: 1\n" for number in range(5000))
    (tmp_path / "x.yaml").write_text(f"law: pid\n{keys}")
    code, said = call("offboard check", "x.yaml")
    assert code == 2
    lines = said.splitlines()
    assert len(lines) == 11
    assert lines[0].startswith("x.yaml, line 2, column 1: key_0 is not a known key")
    assert lines[-1] == "x.yaml: and 4990 more problems"


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (
            ("--set", "reference.height_m=100"),
            "reference lemniscate: landing from 100 m takes 200 s at 0.5 m/s, longer than "
            "limits.land_s (90 s); fly lower or allow more time",
        ),
        (
            ("--set", "limits.radius_m=1.5"),
            "reference lemniscate: it goes 2 m away from the take-off point, beyond "
            "limits.radius_m (1.5 m); fly nearer or raise the limit",
        ),
        (
            ("--set", "vehicle.hover_thrust=0.92"),
            "vehicle neutral: hover_thrust 0.92 exceeds limits.hover_thrust (0.9), beyond "
            "which a flight is ended; carry less or raise the limit",
        ),
        (
            ("--set", "controller.swarm={particles: 10000, iterations: 100000}"),
            "controller.swarm: particles x iterations must be at most 500000, not 1000000000",
        ),
    ],
)
def test_what_cannot_be_flown_to_its_end_is_refused(
    arguments: tuple[str, ...], says: str, call: Call, tmp_path: Path
) -> None:
    assert says in refused(call("offboard fly", *LINK, *arguments))
    assert not list(tmp_path.iterdir())


def test_a_comparison_on_a_full_disk_says_what_cannot_be_written(
    call: Call, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def flown(*_: object) -> Record:
        limit = resource.getrlimit(resource.RLIMIT_FSIZE)[1]
        resource.setrlimit(resource.RLIMIT_FSIZE, (10, limit))
        return Record(4, "no vehicle", -1.0, "completed")

    monkeypatch.setattr("offboard.campaign.workers.recorded", flown)
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    try:
        code, said = call(
            "offboard compare", *LINK, "--controllers", "lqr", "--seeds", 1, "--out", "x"
        )
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert (code, said.count("\n")) == (4, 1)
    assert said.startswith("x cannot be written (File too large); ")


def process(command: str, directory: Path, begin: str) -> subprocess.CompletedProcess[str]:
    """A command as its console script runs it, after `begin`."""
    module, *arguments = command.split()
    script = (
        f"import sys; sys.argv = {[module, *arguments]!r}\n{begin}\n"
        f"from {module}.cli import main\nsys.exit(main())"
    )
    return subprocess.run(
        [sys.executable, "-c", script], cwd=directory, capture_output=True, text=True, timeout=60
    )


CLOSED = "import os; r, w = os.pipe(); os.close(r); os.dup2(w, 1)"
SCORE = f"offboard score {RECORDING}"


@pytest.mark.parametrize("command", ["offboard list", f"{SCORE} --json"])
def test_a_full_disk_behind_the_output_is_one_sentence(
    command: str, call: Call, monkeypatch: pytest.MonkeyPatch
) -> None:
    full = Path("/dev/full").open("w", encoding="utf-8")  # noqa: SIM115
    monkeypatch.setattr(sys, "stdout", full)
    words = command.split()
    said = refused(call(words[0], *words[1:]))
    assert said == "the output cannot be written: No space left on device\n"


def test_a_pipe_that_nobody_reads_is_no_missed_requirement(tmp_path: Path) -> None:
    ended = process(SCORE, tmp_path, CLOSED)
    assert (ended.returncode, ended.stderr) == (141, "")


def test_a_page_on_a_full_disk_leaves_no_file(call: Call, tmp_path: Path) -> None:
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100, limits[1]))
    try:
        answer = call("offboard identify", RECORDING, "--page", "x.html", "-o", "x.yaml")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert refused(answer).startswith("x.html cannot be written (File")
    assert not list(tmp_path.iterdir())


def test_an_interrupt_during_the_imports_is_one_sentence(tmp_path: Path) -> None:
    """The signal is raised by an import, the first once `main` has been called."""
    begin = """
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
    ended = process("offboard --help", tmp_path, begin)
    assert (ended.returncode, ended.stderr) == (130, "interrupted\n")


def test_an_interrupted_score_is_one_sentence(tmp_path: Path) -> None:
    begin = """
import signal
signal.signal(signal.SIGINT, signal.default_int_handler)
from offboard.analysis import score
score.score_flight = lambda flight: signal.raise_signal(signal.SIGINT)
"""
    ended = process(SCORE, tmp_path, begin)
    assert (ended.returncode, ended.stderr) == (130, "interrupted\n")


def test_a_flight_whose_result_cannot_be_printed_keeps_its_exit_code(
    call: Call, monkeypatch: pytest.MonkeyPatch
) -> None:
    full = Path("/dev/full").open("w", encoding="utf-8")  # noqa: SIM115

    def printed(text: str, indent: int = 0) -> None:
        monkeypatch.setattr(sys, "stdout", full)
        print(text, flush="preparing" not in text)

    monkeypatch.setattr(fly, "say", printed)
    code, said = call("offboard fly", *LINK, "--out", "x")
    assert code == 3
    assert said.endswith("; the output cannot be written: No space left on device\n")
