"""`offboard doctor` over UDP: what it says about a good vehicle, and about a port in use."""

from __future__ import annotations

import json
import socket
import subprocess
import sys
import threading
from pathlib import Path

import pytest
from processes import Called, free_port, signing
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from sim_peer import simulator

from offboard.doctor import listening
from offboard.documents.signing_key import create_key, read_key

GOOD_PX4 = ("--param", "COM_OBL_RC_ACT=4", "--param", "COM_RCL_EXCEPT=4")
OF_THIS_MACHINE = {"compiled", "computer", "delay", "disk"}  # which is busy with other tests


def test_doctor_finds_no_fault_on_a_good_vehicle(called: Called, tmp_path: Path) -> None:
    """The simulated PX4 signs; its signing time begins with that of the key, which is years old.
    Another vehicle is on the link, too."""
    port, path = free_port(), tmp_path / "key"
    create_key(path)
    heartbeat = mavlink.MAVLink_heartbeat_message(2, 12, 0, 0, 3, 3)
    other, listened = signing(9, 1, read_key(path)), threading.Event()
    quick = tmp_path / "quick.yaml"
    quick.write_text("name: quick\ndescription: It boots fast.\nconditions: {boot_scale: 0.1}\n")
    options = ("--gcs", "none", "--signing-key", str(path), "--scenario", str(quick), *GOOD_PX4)

    def fly_beside() -> None:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as beside:
            while not listened.wait(0.2):
                beside.sendto(heartbeat.pack(other), ("127.0.0.1", port))

    with simulator("--connect", f"udpout:127.0.0.1:{port}", *options) as process:
        assert process.stdout is not None
        process.stdout.readline()
        thread = threading.Thread(target=fly_beside)
        thread.start()
        try:
            link = ("--connect", f"udpin:127.0.0.1:{port}", "--signing-key", path)
            _, output, errors = called("offboard doctor --json --system 1", *link)
        finally:
            listened.set()
            thread.join()
    assert errors == ""
    report = json.loads(output)
    rows = {row["check"]: row for row in report["rows"]}
    wrong = {name: row for name, row in rows.items() if row["level"] != "ok"}
    assert wrong.keys() <= OF_THIS_MACHINE, wrong
    assert "autopilot 9/1" in str(rows["senders"])
    assert report["vehicle"] == {"autopilot": "px4", "system_id": 1}
    assert report["version"] == [1, 16, 1]
    assert {"level", "found", "hint"} <= rows["gps"]["findings"][0].keys()
    assert report["verdict"].startswith(("ready to fly", "not ready yet: delay"))
    assert report["listened_s"] < 10.5


PORT_HOLDER = """import socket, sys
held = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
held.bind(("127.0.0.1", 0))
print(held.getsockname()[1], flush=True)
sys.stdin.read()"""


def test_doctor_names_the_process_that_holds_the_port(
    called: Called, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(listening, "NOTHING_S", 0.1)  # where no vehicle is awaited
    with subprocess.Popen(
        [sys.executable, "-S", "-c", PORT_HOLDER],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    ) as holder:
        assert holder.stdout
        check = f"offboard doctor port --connect udpin:127.0.0.1:{holder.stdout.readline().strip()}"
        code, output, errors = called(check)
        holder.communicate()
    assert (code, errors) == (3, "")
    assert output.startswith("blocks  port  connection 'udpin:")
    assert f"(pid {holder.pid})" in output
    assert f"fix: stop {Path(sys.executable).resolve().name[:6]}" in output
    code, output, _ = called(check)
    assert (code, output.startswith("ok      port")) == (0, True)
