"""`offboard doctor` as a process: ports, exit codes, output."""

from __future__ import annotations

import json
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest
from processes import Called, Spawn, free_port, signing
from pymavlink.dialects.v20 import ardupilotmega as mavlink
from sim_peer import simulator

from offboard.documents.signing_key import create_key, read_key

GOOD_PX4 = ("--param", "COM_OBL_RC_ACT=4", "--param", "COM_RCL_EXCEPT=4")


def test_good_vehicle_over_udp(spawn: Spawn, tmp_path: Path) -> None:
    """PX4 as it is shipped, but with signed messages: its signing time begins with that of the key,
    which is years old. Another vehicle is on the link, too."""
    port, path = free_port(), tmp_path / "key"
    link = f"udpin:127.0.0.1:{port}"
    create_key(path)
    other = signing(9, 1, read_key(path))
    quick = tmp_path / "quick.yaml"
    quick.write_text("name: quick\ndescription: It boots fast.\nconditions: {boot_scale: 0.1}\n")
    options = ("--gcs", "none", "--signing-key", str(path), "--scenario", str(quick), *GOOD_PX4)
    with (
        simulator("--connect", f"udpout:127.0.0.1:{port}", *options) as process,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as beside,
    ):
        process.ready_line()
        doctor = spawn("offboard", "doctor", "--connect", link, "--json", "--system", "1",
                       "--signing-key", str(path), XDG_STATE_HOME=str(tmp_path))  # fmt: skip
        while doctor.poll() is None:
            heartbeat = mavlink.MAVLink_heartbeat_message(2, 12, 0, 0, 3, 3)
            beside.sendto(heartbeat.pack(other), ("127.0.0.1", port))
            time.sleep(0.2)
        output, errors = doctor.communicate(timeout=60)
    assert errors == ""
    report = json.loads(output)
    rows = {row["check"]: row for row in report["rows"]}
    of_this_machine = {"compiled", "computer", "delay", "disk"}  # which is busy with other tests
    wrong = {name: row for name, row in rows.items() if row["level"] != "ok"}
    assert wrong.keys() <= of_this_machine, wrong
    assert "autopilot 9/1" in str(rows["senders"])
    assert report["vehicle"] == {"autopilot": "px4", "system_id": 1}
    assert report["verdict"].startswith(("ready to fly", "not ready yet: delay"))
    assert report["listened_s"] < 10.5


def test_taken_port_names_its_holder(called: Called) -> None:
    holding = (
        "import socket, sys; s = socket.socket(socket.AF_INET, socket.SOCK_DGRAM); "
        "s.bind(('127.0.0.1', 0)); print(s.getsockname()[1], flush=True); sys.stdin.read()"
    )
    with subprocess.Popen(
        [sys.executable, "-c", holding], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as holder:
        assert holder.stdout
        port = holder.stdout.readline().strip()
        check = ("offboard doctor port", "--connect", f"udpin:127.0.0.1:{port}")
        code, output, errors = called(*check)
        assert (code, errors) == (3, "")
        assert output.startswith("blocks  port  connection 'udpin:")
        assert f"(pid {holder.pid})" in output
        assert f"fix: stop {Path(sys.executable).resolve().name[:6]}" in output
        assert holder.stdin
        holder.stdin.close()
    code, output, _ = called(*check)
    assert code == 0
    assert output.startswith("ok      port")


@pytest.mark.parametrize(
    ("arguments", "code", "says"),
    [
        (("--list", "gps"), 0, "gps  GPS fix. "),
        (("gsp",), 2, "there is no check named 'gsp'; known are port, vehicle,"),
        (("--connect", "nowhere"), 2, "connection 'nowhere' is not understood; use udpin:"),
        (("port", "--connect", "tcp:127.0.0.1:1"), 3, "cannot be opened: Connection refused"),
    ],
)
def test_exit_codes(arguments: tuple[str, ...], code: int, says: str, called: Called) -> None:
    ended, output, errors = called("offboard doctor", *arguments)
    assert ended == code
    assert says in (output + errors).replace("\n", " ")
    assert "Traceback" not in errors
    assert code < 3 or "fix: start the vehicle, or the router, that " in output.replace("\n", " ")
