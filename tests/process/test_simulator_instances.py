"""Several vehicles of one process, and the list of scenarios."""

from __future__ import annotations

import re
import socket
from contextlib import ExitStack

import pytest
from processes import Called
from sim_peer import simulator

from offboard.documents import shipped


def free_ports(count: int) -> int:
    """The first of so many free UDP ports in a row."""
    for first in range(23000, 30000, count):
        with ExitStack() as stack:
            try:
                for port in range(first, first + count):
                    sock = stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
                    sock.bind(("127.0.0.1", port))
            except OSError:
                continue
            return first
    raise AssertionError("no free ports")


def test_instances_have_ports_and_systems_of_their_own_and_keep_time() -> None:
    first = free_ports(3)
    heard: list[list[int]] = []
    with ExitStack() as stack:
        sockets = [stack.enter_context(socket.socket(type=socket.SOCK_DGRAM)) for _ in range(3)]
        for port, sock in enumerate(sockets, first):
            sock.bind(("127.0.0.1", port))
            sock.settimeout(20.0)
        options = ("--connect", f"udpout:127.0.0.1:{first}", "--gcs", "none", "--instances", "3")
        process = stack.enter_context(simulator(*options, "--instance", "4", "--duration", "2"))
        for sock in sockets:
            heard.append([datagram[5] for datagram in (sock.recv(2000) for _ in range(20))])
        output, errors = process.popen.communicate(timeout=20.0)
    assert heard == [[5] * 20, [6] * 20, [7] * 20]
    assert process.popen.returncode == 0
    assert errors == ""
    lines = output.splitlines()
    seeds = [re.findall(r"seed (\d+)", line)[0] for line in lines[:3]]
    assert seeds == ["7", "8", "9"]
    steps = re.fullmatch(
        r"3 vehicles: \d+ of (\d+) deadlines missed, at worst .* ms late", lines[3]
    )
    assert steps is not None
    assert int(steps[1]) == 500


WRONG = {
    ("--instances", "2", "--lockstep"): "--lockstep and --instances exclude each other",
    ("--instances", "20", "--instance", "240"): "system ids end at 250",
}


@pytest.mark.parametrize("options", WRONG, ids=" ".join)
def test_what_cannot_be_is_refused(options: tuple[str, ...], called: Called) -> None:
    code, _, errors = called("simulator", *options)
    assert code == 2
    assert WRONG[options] in errors


def test_scenarios_are_listed_with_what_they_are(called: Called) -> None:
    code, output, errors = called("simulator", "--list-scenarios")
    assert (code, errors) == (0, "")
    listed = dict(re.split(r"\s+", line, maxsplit=1) for line in output.splitlines())
    assert listed == shipped.descriptions("scenarios")
