"""`offboard daemon` as a process: lock, monitoring, signals, the unit of the service manager."""

from __future__ import annotations

import json
import resource
import shutil
import signal
import socket
import subprocess
import sys
import time
import urllib.error
import urllib.request
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
from processes import Called, Spawn, children, free_port, hovering, signing
from prometheus_client.parser import text_string_to_metric_families
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from offboard.analysis import tlog
from offboard.analysis.score import as_text, score_flight
from offboard.documents.signing_key import create_key, read_key

SET_MODE = 176  # MAV_CMD
LONG_S = 60.0
ENGAGED = ("excite", "join", "track")


class Pilot:
    """A ground station on the simulator's second link, which switches modes."""

    def __init__(self, key: bytes) -> None:
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.bind(("127.0.0.1", 0))
        self.socket.settimeout(2.0)
        self.port = self.socket.getsockname()[1]
        self._codec = signing(255, 190, key)

    def command(self, number: int, *params: float) -> None:
        filled = (*params, *(0.0,) * (7 - len(params)))
        message = mavlink.MAVLink_command_long_message(1, 1, number, 0, *filled)
        self.socket.sendto(message.pack(self._codec), self._peer)

    def until(self, done: Any, repeat: Any = None) -> None:
        """Read until `done(message)`; calls `repeat` about once a second."""
        deadline_s, repeated_s = time.monotonic() + LONG_S, 0.0
        parser = mavlink.MAVLink(None)
        parser.robust_parsing = True
        while time.monotonic() < deadline_s:
            data, self._peer = self.socket.recvfrom(65535)
            if repeat and time.monotonic() > repeated_s + 1.0:
                repeated_s = time.monotonic()
                repeat()
            if any(done(message) for message in parser.parse_buffer(data) or ()):
                return
        raise AssertionError("the vehicle did not do it")


def shows(mode: int) -> Any:
    return lambda m: m.get_type() == "HEARTBEAT" and m.custom_mode == mode


def scraped(port: int) -> dict[str, float]:
    with urllib.request.urlopen(f"http://127.0.0.1:{port}/metrics", timeout=5.0) as answer:
        text = answer.read().decode()
    return {
        sample.name: sample.value
        for family in text_string_to_metric_families(text)
        for sample in family.samples
    } | {"phase": _phase(text)}  # type: ignore[dict-item]


def _phase(text: str) -> str:
    (line,) = [each for each in text.splitlines() if each.startswith("offboard_state_info")]
    return line.partition('phase="')[2].partition('"')[0]


def health(port: int) -> tuple[int, dict[str, Any]]:
    try:
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/health", timeout=5.0) as answer:
            return answer.status, json.loads(answer.read())
    except urllib.error.HTTPError as error:
        return error.code, json.loads(error.read())


def await_phase(service: subprocess.Popen[str], port: int, *phases: str) -> None:
    deadline_s = time.monotonic() + LONG_S
    while True:
        assert service.poll() is None, service.communicate()
        try:
            if scraped(port)["phase"] in phases:
                return
        except (OSError, ValueError):
            pass  # not served yet
        assert time.monotonic() < deadline_s, f"never in {phases}"
        time.sleep(0.1)


def many_strangers(port: int, service: int) -> list[socket.socket]:
    """More connections than a process may have descriptors, which send half a request and wait.
    They stay until the server ends them."""
    for pid in (service, *children(service)):
        resource.prlimit(pid, resource.RLIMIT_NOFILE, (100, 100))
    strangers = [socket.create_connection(("127.0.0.1", port), timeout=20.0) for _ in range(250)]
    for stranger in strangers:
        with suppress(ConnectionError):
            stranger.send(b"GET /metrics HTTP/1.1\r\nHost:")
    return strangers


def test_a_pilot_engages_and_a_stop_hands_back(spawn: Spawn, tmp_path: Path) -> None:
    """In real time over UDP, signed, with monitoring and strangers that use up connections, a
    second service, another vehicle, SIGTERM in flight, and SIGKILL in the next one."""
    create_key(tmp_path / "key")
    key = read_key(tmp_path / "key")
    port, web, pilot = free_port(), free_port(), Pilot(key)
    link = f"udpin:127.0.0.1:{port}"
    command = ("offboard", "daemon", "--connect", link, "--out", "out", "--log-json",
               "--metrics", f"127.0.0.1:{web}", "--reference", "hover", "--system", "1",
               "--signing-key", "key", "--set", "reference.duration_s=600")  # fmt: skip
    variables = {"OFFBOARD_REPORT": "1", "XDG_STATE_HOME": str(tmp_path)}
    service = spawn(*command, **variables)
    await_phase(service, web, "connect")
    assert health(web)[0] == 503
    second = spawn("offboard", "daemon", "--connect", link, "--out", "other")
    assert second.wait(LONG_S) == 3
    assert second.stderr is not None
    assert f"process {service.pid}" in second.stderr.read()
    busy = spawn("offboard", "daemon", "--connect", f"udpin:127.0.0.1:{free_port()}",
                 "--out", "third", "--metrics", f"127.0.0.1:{web}")  # fmt: skip
    assert busy.wait(LONG_S) == 3
    other = mavlink.MAVLink_heartbeat_message(2, 12, 0, 0, 3, 3).pack(signing(9, 1, key))
    pilot.socket.sendto(other, ("127.0.0.1", port))
    spawn("simulator", "--signing-key", "key", "--connect", f"udpout:127.0.0.1:{port}",
          "--gcs", f"udpout:127.0.0.1:{pilot.port}", *hovering(tmp_path, 3.0),
          "--param", "COM_OF_LOSS_T=4")  # fmt: skip
    await_phase(service, web, "standby")
    strangers = many_strangers(web, service.pid)
    pilot.until(shows(0x03040000))
    pilot.until(shows(0x00060000), lambda: pilot.command(SET_MODE, 1, 6, 0))
    await_phase(service, web, *ENGAGED)
    for stranger in strangers:  # all were left or refused before a client was served
        stranger.close()
    assert scraped(web)["offboard_flights_total"] == 1.0
    scraped_s = time.time()
    while time.time() < scraped_s + 2.0:  # a client that scrapes more than any real one
        values = scraped(web)
    assert values["offboard_armed"] == 1.0
    status, state = health(web)
    assert (status, state["mode"]) == (200, "OFFBOARD")
    service.send_signal(signal.SIGTERM)
    pilot.until(shows(0x03040000))
    out, error = service.communicate(timeout=LONG_S)
    assert (service.returncode, error) == (0, "")
    lines = [json.loads(line) for line in out.splitlines()]
    assert all({"time", "level", "event", "phase"} <= line.keys() for line in lines)
    assert any("engaged: OFFBOARD in the air" in line["event"] for line in lines)
    assert sum("stop requested" in line["event"] for line in lines) == 1
    (flight,) = [path for path in (tmp_path / "out").iterdir() if (path / "flight.tlog").exists()]
    deadline_s = time.monotonic() + LONG_S
    while not (flight / "report.html").exists() and time.monotonic() < deadline_s:
        time.sleep(0.1)
    assert (flight / "report.html").read_text(encoding="utf-8").endswith("</html>")
    kept = (flight / "score.json").read_text()
    assert json.loads(kept)["phases"]
    assert kept == as_text(*score_flight(flight / "flight.tlog"))
    assert not (flight / "engaged").exists()
    log = tlog.read(flight / "flight.tlog")
    sent_s = [1e-6 * each.unix_us for each in log if each.name == "SET_ATTITUDE_TARGET"]
    assert sum(0.0 < each_s - scraped_s < 2.0 for each_s in sent_s) >= 16  # 10 Hz, on any machine
    names = {entry.name for entry in log}
    assert {"TUNNEL", "HEARTBEAT", "PARAM_VALUE", "SET_ATTITUDE_TARGET", "STATUSTEXT"} <= names
    killed = spawn(*command, **variables)
    await_phase(killed, web, "standby")
    pilot.until(shows(0x00060000), lambda: pilot.command(SET_MODE, 1, 6, 0))
    await_phase(killed, web, *ENGAGED)
    killed.kill()
    held = shows(0x03040000)
    pilot.until(lambda m: held(m) and m.system_status == 4)  # asked by the supervisor: no failsafe
    pilot.command(SET_MODE, 1, 4, 5)  # RTL, which ends the supervisor, too
    pilot.until(shows(0x05040000))


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (("--config", "missing.yaml"), "missing.yaml cannot be read: No such file or directory"),
        (("--signing-key", "missing.key"), "signing key missing.key"),
        (("--out", "here"), "--out here: the unit can write below /var/lib/offboard alone"),
    ],
)
def test_a_unit_that_could_not_start_is_not_printed(
    arguments: tuple[str, ...], sentence: str, called: Called
) -> None:
    code, unit, errors = called("offboard daemon", "--print-unit", *arguments)
    assert (code, unit) == (2, "")
    assert sentence in " ".join(errors.split())


@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="needs systemd-analyze")
def test_the_unit_is_valid(tmp_path: Path) -> None:
    (tmp_path / "my $ %.yaml").write_text("vehicle: neutral\ncontroller: lqr\nreference: hover\n")
    create_key(tmp_path / "my %.key")
    told = subprocess.run(
        [sys.executable, "-P", "-m", "offboard", "daemon", "--connect", "serial:/dev/ttyACM0:57600",
         "--config", "./my $ %.yaml", "--signing-key", "my %.key", "--print-unit"],
        capture_output=True, text=True, check=True, cwd=tmp_path,
    )  # fmt: skip
    printed = told.stdout
    assert f"the unit cannot see {tmp_path / 'my $ %.yaml'}: it has a tmp of its own" in (
        " ".join(told.stderr.split())
    )
    unit = tmp_path / "offboard.service"
    unit.write_text(printed)
    done = subprocess.run(["systemd-analyze", "verify", unit], capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")
    (line,) = [each for each in printed.splitlines() if each.startswith("ExecStart=")]
    escaped = str(tmp_path / "my $ %.yaml").replace("%", "%%").replace("$", "$$")
    assert f'--config "{escaped}" --out %S/offboard --signing-key %d/signing-key' in line
    assert f"LoadCredential=signing-key:{tmp_path}/my %%.key" in printed
    assert "Type=notify" in printed
    assert "SupplementaryGroups=dialout" in printed
