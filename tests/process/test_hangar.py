"""The bundled simulator's process: vehicle after vehicle, each gone when it is to be."""

from __future__ import annotations

import os
import signal
import socket
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from processes import children

from offboard.flight.sitl import Hangar

HELLO = 65535


@pytest.fixture(scope="module")
def hangar() -> Iterator[Hangar]:
    with Hangar() as hangar:
        yield hangar


@contextmanager
def flying(hangar: Hangar, *options: str) -> Iterator[bytes]:
    """A vehicle in lockstep, and the first datagram that it sent."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as ours:
        ours.bind(("127.0.0.1", 0))
        ours.settimeout(30.0)
        port = ours.getsockname()[1]
        hangar.launch(
            ["--connect", f"udpout:127.0.0.1:{port}", "--gcs", "none", "--lockstep", *options]
        )
        yield ours.recv(HELLO)


def vehicles(hangar: Hangar) -> list[int]:
    return children(hangar.pid)


def gone(pid: int) -> bool:
    """Within ten seconds, for whoever is not ours to wait for."""
    for _ in range(1000):
        if not Path(f"/proc/{pid}/exe").exists():
            return True
        time.sleep(0.01)
    return False


def test_a_hangar_that_dies_unnoticed_takes_its_vehicle_along() -> None:
    with Hangar() as hangar, flying(hangar):
        (orphan,) = vehicles(hangar)
        os.kill(hangar.pid, signal.SIGKILL)
        assert gone(hangar.pid)
    assert gone(orphan)


def test_one_after_the_other_and_the_same_seed_says_the_same(hangar: Hangar) -> None:
    said, pid = [], hangar.pid
    for seed in ("1", "1", "2"):
        with flying(hangar, "--scenario", "px4_like", "--seed", seed) as hello:
            said.append(hello)
            assert len(vehicles(hangar)) == 1
            assert hangar.ended() is None
        hangar.recall()
        assert (vehicles(hangar), hangar.pid) == ([], pid)
    assert said[0] == said[1] != said[2]


def test_a_vehicle_that_dies_says_how_and_the_next_one_flies(hangar: Hangar) -> None:
    with flying(hangar):
        os.kill(vehicles(hangar)[0], signal.SIGKILL)
        ending = hangar.ended(10.0)
        assert ending is not None
        assert (ending.sentence, ending.unusable) == (
            "the bundled simulator ended (signal 9)",
            False,
        )
    hangar.recall()
    with flying(hangar):
        assert hangar.ended() is None
    hangar.recall()


def test_wrong_options_are_told_in_the_simulators_words(hangar: Hangar) -> None:
    hangar.launch(["--scenario", "storm"])
    ending = hangar.ended(10.0)
    assert ending is not None
    assert ending.unusable
    assert ending.sentence.startswith("scenario storm not found: give a file or one of")
    hangar.launch(["--firmware", "betaflight"])
    again = hangar.ended(10.0)
    assert again is not None
    assert again.sentence.startswith("--firmware betaflight: unknown")
    with flying(hangar):
        os.kill(vehicles(hangar)[0], signal.SIGKILL)
        last = hangar.ended(10.0)
        assert last is not None
        assert last.sentence == "the bundled simulator ended (signal 9)"  # not the words before


def test_a_hangar_that_was_lost_is_replaced() -> None:
    with Hangar() as hangar:
        with flying(hangar):
            lost, (orphan,) = hangar.pid, vehicles(hangar)
            os.kill(lost, signal.SIGKILL)
            ending = hangar.ended(10.0)
            assert ending is not None
            assert ending.sentence == "the bundled simulator ended (signal 9)"
        hangar.recall()
        assert gone(orphan)
        with flying(hangar):
            assert hangar.pid != lost
    assert not Path(f"/proc/{hangar.pid}").exists()


def test_leaving_it_ends_what_still_flies() -> None:
    with Hangar() as hangar, flying(hangar):
        (vehicle,) = vehicles(hangar)
    assert not Path(f"/proc/{vehicle}/exe").exists()
