"""The `simulator` process: its links, how it ends, several vehicles.

A companion that is late or silent in lockstep: `wire/test_sim_sockets.py`, `test_same_bytes.py`.
Several clients of a link: `wire/test_sim_sockets.py`, `wire/test_sim_link.py`.
"""

from __future__ import annotations

import re
import signal
import socket
from contextlib import ExitStack

from processes import Called, free_port
from sim_peer import Peer, simulator

QUIET = ("--gcs", "none")


def test_it_waits_to_be_spoken_to_shifts_its_system_and_ends_at_an_interrupt() -> None:
    port = free_port()
    options = ("--connect", f"udpin:127.0.0.1:{port}", "--instance", "6", "--lockstep")
    with Peer() as peer, simulator(*options, *QUIET) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == (
            "px4 vehicle px4_sih, system 7, scenario px4_like, seed 7:"
            f" waiting at 127.0.0.1:{port}\n"
        )
        peer.vehicle = ("127.0.0.1", port)
        peer.heartbeat()
        peer.listen(lambda: "HEARTBEAT" in peer.newest)
        process.send_signal(signal.SIGINT)
        _, errors = process.communicate(timeout=10.0)
    assert peer.newest["HEARTBEAT"].get_srcSystem() == 7
    assert (process.returncode, errors) == (0, "")


def test_the_duration_ends_it_though_nobody_listens(called: Called) -> None:
    for link, does in (("udpout:127.0.0.1:9", "sending to"), ("tcpin:127.0.0.1:{}", "waiting at")):
        link = link.format(free_port())
        options = ("--connect", link, "--duration", "2", "--speed", "20")
        code, said, errors = called("simulator", *QUIET, *options)
        assert (code, errors) == (0, "")
        assert f"{does} {link.partition(':')[2]}" in said


def test_instances_have_ports_and_systems_of_their_own_and_keep_time() -> None:
    ports = [free_port() for _ in range(3)]
    while ports[2] - ports[0] != 2:  # in a row
        ports = [*ports[1:], free_port()]
    heard: list[list[int]] = []
    with ExitStack() as stack:
        sockets = [stack.enter_context(socket.socket(type=socket.SOCK_DGRAM)) for _ in range(3)]
        for port, sock in zip(ports, sockets, strict=True):
            sock.bind(("127.0.0.1", port))
            sock.settimeout(20.0)
        options = ("--connect", f"udpout:127.0.0.1:{ports[0]}", "--gcs", "none", "--instances", "3")
        process = stack.enter_context(simulator(*options, "--instance", "4", "--duration", "1"))
        for sock in sockets:
            heard.append([datagram[5] for datagram in (sock.recv(2000) for _ in range(20))])
        output, errors = process.communicate(timeout=20.0)
    assert heard == [[5] * 20, [6] * 20, [7] * 20]
    assert (process.returncode, errors) == (0, "")
    assert re.findall(r"seed (\d+)", output) == ["7", "8", "9"]
    assert re.search(r"3 vehicles: \d+ of 250 deadlines missed, at worst .* ms late", output)
