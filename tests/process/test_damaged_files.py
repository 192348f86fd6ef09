"""Foreign and damaged logs, full disks, outputs that nobody reads: one sentence, the right exit
code, and no file that is incomplete. The log of a flight holds what was flown."""

from __future__ import annotations

import errno
import io
import os
import subprocess
import sys
from pathlib import Path

import pytest
import yaml
from processes import NO_VEHICLE, RECORDING, Called, full_disk
from pymavlink.dialects.v20 import ardupilotmega as dialect

from offboard.analysis import history, tlog
from offboard.analysis.score import keep_score, score_flight
from offboard.cli import fly
from offboard.flight.record import configuration_pieces
from offboard.link.log import FlightLog, LogError, entry
from offboard.mavlink.session import RECORD_COMPONENT_ID
from offboard.report.flight import read
from offboard.run import configuration as config

NOW_US = 1_790_000_000_000_000  # time stamp of the entries of a log


def gigabytes() -> bytes:
    """A log whose configuration unpacks to a thousand times its bytes, here to 40 MB."""
    codec = dialect.MAVLink(None, srcSystem=1, srcComponent=RECORD_COMPONENT_ID)
    log = io.BytesIO()
    for piece in configuration_pieces(40_000_000 * " "):
        data = list(piece.data.ljust(128, b"\0"))
        message = codec.tunnel_encode(0, 0, piece.payload_type, len(piece.data), data)
        log.write(NOW_US.to_bytes(8, "big") + message.pack(codec))
    return log.getvalue() + RECORDING.read_bytes()


def damaged() -> bytes:
    data = bytearray(RECORDING.read_bytes())
    data[8 + 12] ^= 0x40  # payload of the first frame
    return bytes(data)


DAMAGE = "x.tlog: 1 damaged entry was skipped, the first at byte 0\n"


@pytest.mark.parametrize(
    ("content", "command", "code", "says"),
    [
        (b"", "score", 2, "is empty or not a .tlog"),
        (b"PK\3\4" + bytes(500), "score", 2, "is empty or not a .tlog"),
        (None, "score", 2, "x.tlog is not a regular file; name a flight directory or a .tlog file"),
        (gigabytes(), "report", 2, "x.tlog: its configuration unpacks to more than 4000 kB\n"),
        (RECORDING.read_bytes()[:-7], "score", 0, ""),
        (damaged(), "score", 0, DAMAGE),
        (damaged(), "identify", 0, DAMAGE),
    ],
    ids=["empty", "foreign", "a FIFO", "gigabytes", "cut off", "damaged", "damaged, identified"],
)
def test_damaged_logs_are_read_and_foreign_files_refused(
    content: bytes | None, command: str, code: int, says: str, called: Called, tmp_path: Path
) -> None:
    if content is None:
        os.mkfifo(tmp_path / "x.tlog")
    else:
        (tmp_path / "x.tlog").write_bytes(content)
    ended, _, said = called(f"offboard {command} x.tlog")
    assert (ended, said.count("\n")) == (code, 1 if says else 0)
    assert says in said


def test_identify_writes_no_vehicle_file_without_a_result(called: Called, tmp_path: Path) -> None:
    kept = [each for each in tlog.read(RECORDING) if each.name != "SET_ATTITUDE_TARGET"]
    (tmp_path / "x.tlog").write_bytes(b"".join(entry(e.unix_us, e.frame.raw) for e in kept))
    code, _, said = called("offboard identify -o mine.yaml x.tlog")
    assert code == 1
    assert said == "nothing could be identified from this flight; identify.html says why\n"
    assert sorted(each.name for each in tmp_path.iterdir()) == ["identify.html", "x.tlog"]
    assert (tmp_path / "identify.html").read_text().count("not identified: ") > 3


def test_identify_reads_logs_with_euler_angles(called: Called, tmp_path: Path) -> None:
    """An existing page is kept. The title of the new one is the name of the flight directory, also
    if that is the working directory."""
    log = RECORDING.with_name("arducopter-4.6.3-guided.tlog")  # has no ATTITUDE_QUATERNION
    (tmp_path / "flight.tlog").write_bytes(log.read_bytes())
    (tmp_path / "identify.html").write_text("precious")
    assert called("offboard identify -o mine.yaml .")[::2] == (0, "")
    found = yaml.safe_load((tmp_path / "mine.yaml").read_text())
    assert found["name"] == "mine"
    assert found["hover_thrust"] == pytest.approx(0.365, abs=0.01)
    assert found["tilt"]["natural_frequency_radps"] == pytest.approx(10.2, abs=1.0)
    assert (tmp_path / "identify.html").read_text() == "precious"
    page = (tmp_path / "identify-2.html").read_text()
    assert f"<title>Flight {tmp_path.name}</title>" in page
    assert page.count(' id="fit_') == 2 * 2  # tilt and heading, with their data


@pytest.mark.usefixtures("in_memory")
def test_identify_with_sitl_flies_and_identifies(called: Called, tmp_path: Path) -> None:
    command = "offboard identify --sitl --scenario calm --set reference.laps=1 --out x -o mine.yaml"
    assert called(command)[::2] == (0, "")
    assert read(tmp_path / "x").facts["reference"] == "lemniscate"  # it has no name but its shape
    found = yaml.safe_load((tmp_path / "mine.yaml").read_text())
    assert found["hover_thrust"] == pytest.approx(0.5, abs=0.02)
    assert (tmp_path / "identify.html").exists()


def test_a_score_that_cannot_be_written_is_reported(called: Called, tmp_path: Path) -> None:
    (tmp_path / "x" / "score.json").mkdir(parents=True)
    (tmp_path / "x" / "flight.tlog").write_bytes(RECORDING.read_bytes())
    said = "x/score.json cannot be written (Is a directory)\n"
    assert called("offboard score x")[::2] == (0, said)


# --- a full disk ---


def test_an_incomplete_score_is_not_kept(tmp_path: Path) -> None:
    score, flown = score_flight(RECORDING)
    with full_disk(100), pytest.raises(LogError, match=r"score\.json cannot be written"):
        keep_score(tmp_path, score, flown)
    assert not list(tmp_path.iterdir())


LINK = "--connect udpin:127.0.0.1:PORT --signing-key key --out x"


@pytest.mark.parametrize(
    ("command", "holds_bytes", "code", "kept"),
    [
        (f"fly {LINK}", 0, 2, {"key", "state"}),
        ("fly --sitl --out x", 100, 2, {"key", "x"}),
        # the service manager starts it again, and it waits for room
        (f"daemon {LINK}", 10, 3, {"key", "state", "x"}),
        (f"identify -o x.yaml {RECORDING}", 100, 2, {"key"}),
    ],
)
def test_commands_on_a_full_disk_leave_no_partial_file(
    command: str, holds_bytes: int, code: int, kept: set[str], called: Called, tmp_path: Path
) -> None:
    called("offboard key key")
    with full_disk(holds_bytes):
        ended, _, said = called(f"offboard {command}")
    assert (ended, said.count("\n")) == (code, 1)
    assert "File too large" in said
    assert {path.name for path in tmp_path.iterdir()} == kept
    assert not list(tmp_path.glob("x/flight.*"))


def test_a_log_whose_configuration_cannot_be_created_names_the_reason(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object, **__: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(Path, "open", full)
    with pytest.raises(LogError, match="No space left"):
        FlightLog(tmp_path / "x", "").__enter__()
    assert not list(tmp_path.glob("x/*"))


# --- an output that takes nothing ---


@pytest.mark.parametrize("command", [("list",), ("score", str(RECORDING), "--json")])
def test_output_to_a_full_disk_is_reported_in_one_sentence(command: tuple[str, ...]) -> None:
    with Path("/dev/full").open("w") as full:
        process = [sys.executable, "-P", "-m", "offboard", *command]
        ended = subprocess.run(process, stdout=full, stderr=subprocess.PIPE, text=True, check=False)
    said = "the output cannot be written: No space left on device\n"
    assert (ended.returncode, ended.stderr) == (2, said)


def test_exit_code_is_kept_if_the_result_cannot_be_printed(
    called: Called, monkeypatch: pytest.MonkeyPatch
) -> None:
    full = Path("/dev/full").open("w", encoding="utf-8")  # noqa: SIM115

    def printed(text: str, indent: int = 0) -> None:
        monkeypatch.setattr(sys, "stdout", full)
        print(text, flush="preparing" not in text)

    monkeypatch.setattr(fly, "say", printed)
    code, _, said = called(NO_VEHICLE)
    assert code == 3
    assert said.endswith("; the output cannot be written: No space left on device\n")


# --- what a log holds ---


@pytest.mark.usefixtures("in_memory")
def test_log_contains_configuration_and_reference_table(
    called: Called, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The flight follows a table whose file is then deleted. The closed output does not end it."""
    reads, writes = os.pipe()
    os.close(reads)
    monkeypatch.setattr(sys, "stdout", os.fdopen(writes, "w"))
    rows = "".join(f"{t},{0.5 * t},0,-1\n" for t in range(9))
    (tmp_path / "line.csv").write_text("time_s,north_m,east_m,down_m\n" + rows)
    command = "offboard fly --sitl --controller lqr --reference line.csv --seed 7 --out x"
    assert called(command)[0] == 0
    (tmp_path / "line.csv").unlink()
    log = tlog.read(tmp_path / "x" / "flight.tlog")
    assert history.gather(log).phases[-1].what.startswith("disarmed")
    text = history.configuration(log)
    assert text is not None
    flown = config.flown(text)
    assert flown == config.load(str(tmp_path / "x" / "flight.yaml"))
    assert flown.seed == 7
    track = config.build_track(flown)
    assert track.sample(track.track_start_s).position_ned_m[0] > 0.2
    facts = read(tmp_path / "x").facts  # the report names the table by its file
    assert (facts["reference"], facts["controller"]) == ("line.csv", "lqr")
