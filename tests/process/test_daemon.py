"""`offboard daemon` as a process: lock, monitoring, signals, the unit of the service manager."""

from __future__ import annotations

import json
import os
import resource
import shutil
import signal
import socket
import subprocess
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
from processes import (
    RECORDING,
    TIMEOUT_S,
    Called,
    Spawn,
    children,
    ended,
    eventually,
    free_port,
    hovering,
    signing,
)
from prometheus_client.parser import text_string_to_metric_families
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from sim_peer import Peer

from offboard.analysis import tlog
from offboard.analysis.score import as_text, score_flight
from offboard.documents.signing_key import create_key, read_key
from offboard.link.after_flight import OneByOne

SET_MODE = 176  # MAV_CMD
OFFBOARD, HOLDING, RETURNING = 0x00060000, 0x03040000, 0x05040000
ACTIVE = 4  # MAV_STATE
ENGAGED = ("excite", "join", "track")


@pytest.fixture
def pilot() -> Iterator[Peer]:
    """A ground station on the simulator's second link, which switches modes."""
    with Peer() as peer:
        yield peer


def mode(pilot: Peer, number: int) -> Callable[[], bool]:
    """Whether the vehicle's newest heartbeat shows this mode."""
    return lambda: getattr(pilot.newest.get("HEARTBEAT"), "custom_mode", None) == number


def engage(pilot: Peer) -> None:
    """Switch to OFFBOARD, again at every HEARTBEAT until the vehicle shows it."""
    pilot.listen(mode(pilot, OFFBOARD), each=lambda: pilot.command(SET_MODE, 1, 6))


def scraped(port: int) -> dict[str, Any]:
    """The metrics by name, and the `phase`."""
    with urllib.request.urlopen(f"http://127.0.0.1:{port}/metrics", timeout=5.0) as answer:
        families = text_string_to_metric_families(answer.read().decode())
    samples = [sample for family in families for sample in family.samples]
    (phase,) = (each.labels["phase"] for each in samples if each.name == "offboard_state_info")
    return {sample.name: sample.value for sample in samples} | {"phase": phase}


def health(port: int) -> tuple[int, dict[str, Any]]:
    try:
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/health", timeout=5.0) as answer:
            return answer.status, json.loads(answer.read())
    except urllib.error.HTTPError as error:
        return error.code, json.loads(error.read())


def await_phase(service: subprocess.Popen[str], port: int, *phases: str) -> None:
    deadline_s = time.monotonic() + TIMEOUT_S
    while True:
        assert service.poll() is None, service.communicate()
        try:
            if scraped(port)["phase"] in phases:
                return
        except (OSError, ValueError):
            pass  # not served yet
        assert time.monotonic() < deadline_s, f"never in {phases}"
        time.sleep(0.1)


def many_clients(port: int, service: int) -> list[socket.socket]:
    """Open more connections than the service may have descriptors. Each sends half a request,
    waits, and stays until the server ends it."""
    for pid in (service, *children(service)):
        resource.prlimit(pid, resource.RLIMIT_NOFILE, (100, 100))
    clients = [socket.create_connection(("127.0.0.1", port), timeout=20.0) for _ in range(250)]
    for client in clients:
        with suppress(ConnectionError):
            client.send(b"GET /metrics HTTP/1.1\r\nHost:")
    return clients


def test_flights_are_scored_singly_even_after_the_service_ends(tmp_path: Path) -> None:
    before, flights = set(children(os.getpid())), [tmp_path / f"{n}\n" for n in range(2)]
    service = OneByOne("score")
    for flight in flights:
        flight.mkdir()
        shutil.copy(RECORDING, flight / "flight.tlog")
        service.add(flight)
    (scoring,) = set(children(os.getpid())) - before
    service.close()
    at_once = set()
    eventually(lambda: at_once.add(len(children(scoring))) or ended(scoring))
    assert at_once == {0, 1}
    assert all((flight / "score.json").exists() for flight in flights)


def test_pilot_engages_the_service_and_sigterm_hands_back(
    spawn: Spawn, called: Called, pilot: Peer, tmp_path: Path
) -> None:
    """The flight is in real time over UDP and signed, with monitoring, clients that use up
    connections, a second service and another vehicle. SIGTERM ends it, and SIGKILL the next one."""
    create_key(tmp_path / "key")
    key = read_key(tmp_path / "key")
    (early := tmp_path / "out" / "early").mkdir(parents=True)
    (early / "flight.tlog").touch()  # its service was killed
    port, web = free_port(), free_port()
    pilot.codec = signing(255, 190, key)
    link, page = f"udpin:127.0.0.1:{port}", f"127.0.0.1:{web}"
    command = ("offboard", "daemon", "--connect", link, "--out", "out", "--log-json",
               "--metrics", page, "--reference", "hover", "--system", "1",
               "--signing-key", "key", "--set", "reference.duration_s=600")  # fmt: skip
    variables = {"XDG_STATE_HOME": str(tmp_path)}
    service = spawn(*command, **variables)
    await_phase(service, web, "connect")
    assert health(web)[0] == 503
    code, _, said = called("offboard daemon --out other --connect", link)
    assert (code, f"process {service.pid}" in said) == (3, True)
    code, _, said = called("offboard daemon --out third --connect udpin::PORT --metrics", page)
    assert (code, f"{page} cannot be listened on" in said) == (3, True)
    other = mavlink.MAVLink_heartbeat_message(2, 12, 0, 0, 3, 3).pack(signing(9, 1, key))
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as beside:
        beside.sendto(other, ("127.0.0.1", port))
    spawn("simulator", "--signing-key", "key", "--connect", f"udpout:127.0.0.1:{port}",
          "--gcs", f"udpout:127.0.0.1:{pilot.port}", *hovering(tmp_path, 3.0),
          "--param", "COM_OF_LOSS_T=4")  # fmt: skip
    await_phase(service, web, "standby")
    clients = many_clients(web, service.pid)
    pilot.listen(mode(pilot, HOLDING))
    engage(pilot)
    await_phase(service, web, *ENGAGED)
    for client in clients:  # the server had to drop or refuse all to serve a later one
        client.close()
    begun = scraped(web)
    assert begun["offboard_flights_total"] == 1.0
    end_s = time.monotonic() + 2.0
    while time.monotonic() < end_s:  # scrapes more often than any real client
        values = scraped(web)
    assert values["offboard_armed"] == 1.0
    status, state = health(web)
    assert (status, state["mode"]) == (200, "OFFBOARD")
    service.send_signal(signal.SIGTERM)
    pilot.listen(mode(pilot, HOLDING))
    out, error = service.communicate(timeout=TIMEOUT_S)
    assert (service.returncode, error) == (0, "")
    lines = [json.loads(line) for line in out.splitlines()]
    assert all({"time", "level", "event", "phase"} <= line.keys() for line in lines)
    assert any("engaged: OFFBOARD in the air" in line["event"] for line in lines)
    assert sum("stop requested" in line["event"] for line in lines) == 1
    (flight,) = {path.parent for path in (tmp_path / "out").glob("*/flight.tlog")} - {early}
    unscored = "1 of the earlier flights without a score: `offboard score out/early` makes it"
    assert [line["event"] for line in lines].count(unscored) == 1
    eventually((flight / "score.json").exists)
    kept = (flight / "score.json").read_text()
    assert json.loads(kept)["phases"]
    assert kept == as_text(*score_flight(flight / "flight.tlog"))
    assert not (flight / "engaged").exists()
    log = tlog.read(flight / "flight.tlog")
    sent_s = [1e-3 * e.message.time_boot_ms for e in log if e.name == "SET_ATTITUDE_TARGET"]
    ticks_s = [each_s for each_s in sent_s if 0.0 < each_s - begun["offboard_time_s"] < 2.0]
    assert len(ticks_s) >= 16  # of 20 at 10 Hz: a busy machine may skip some
    names = {entry.name for entry in log}
    assert {"TUNNEL", "HEARTBEAT", "PARAM_VALUE", "SET_ATTITUDE_TARGET", "STATUSTEXT"} <= names
    killed = spawn(*command, **variables)
    await_phase(killed, web, "standby")
    engage(pilot)
    await_phase(killed, web, *ENGAGED)
    killed.kill()
    pilot.listen(mode(pilot, HOLDING))
    assert pilot.newest["HEARTBEAT"].system_status == ACTIVE  # by the supervisor, not a failsafe
    pilot.command(SET_MODE, 1, 4, 5)  # RTL, which ends the supervisor, too
    pilot.listen(mode(pilot, RETURNING))
    eventually(lambda: len(list((tmp_path / "out").glob("*/score.json"))) == 2)  # by the supervisor


@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="needs systemd-analyze")
def test_printed_systemd_unit_is_valid(called: Called, tmp_path: Path) -> None:
    (tmp_path / "my $ %.yaml").write_text("vehicle: neutral\ncontroller: lqr\nreference: hover\n")
    create_key(tmp_path / "my %.key")
    link = ("--connect", "serial:/dev/ttyACM0:57600")
    files = ("--config", "./my $ %.yaml", "--signing-key", "my %.key")
    code, printed, said = called("offboard daemon --print-unit", *link, *files)
    assert code == 0
    assert (
        f"the unit cannot see {tmp_path / 'my $ %.yaml'}: it has its own /tmp and /var/tmp; put"
        in (" ".join(said.split()))
    )
    unit = tmp_path / "offboard.service"
    unit.write_text(printed)
    done = subprocess.run(["systemd-analyze", "verify", unit], capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")
    (line,) = [each for each in printed.splitlines() if each.startswith("ExecStart=")]
    escaped = str(tmp_path / "my $ %.yaml").replace("%", "%%").replace("$", "$$")
    key = "${CREDENTIALS_DIRECTORY}/signing-key"
    assert f'--config "{escaped}" --out %S/offboard --signing-key {key}' in line
    assert f"LoadCredential=signing-key:{tmp_path}/my %%.key" in printed
    assert "Type=notify" in printed
    assert "SupplementaryGroups=dialout" in printed
