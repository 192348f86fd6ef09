"""The controller's side of the supervisor, a process that outlives the controller.

From the moment when the supervisor takes over, the controller must not send. The controller sends
beats as JSON lines on a socket pair, and with them the descriptors of link and log when these
change. The answers are JSON lines, too; an empty one means that the supervisor has read the beats.
"""

from __future__ import annotations

import json
import math
import select
import socket
import subprocess
import sys
from collections.abc import Hashable
from contextlib import suppress
from dataclasses import asdict

from offboard.documents.errors import Unavailable
from offboard.link import clock
from offboard.link.interface import Link
from offboard.mavlink.signing import Signing
from offboard.supervisor.recovery import Supervised

START_S = 20.0  # longest time to start, on a busy machine
END_S = 1.0
ANSWER_S = 1.0  # a supervisor that has not answered a beat for this time does not run
READY = "ready"
NOT_STARTED = "the supervisor, which lands the vehicle if this process dies, does not start"


class Supervisor:
    """Context manager around the process. With `signing` the process continues our signatures.

    `lost`: whether the process has ended although the flight goes on: nobody will take over.
    """

    def __init__(self, signing: Signing | None = None) -> None:
        self.lost = False
        self._signing = signing

    def __enter__(self) -> Supervisor:
        self._received = b""
        self._lines: list[str] = []  # first READY, then why it took over and what it did
        self._passed: object = None  # the descriptors that the process has
        self._unanswered_s = math.inf  # time of the first beat since the newest answer
        self._channel, theirs = socket.socketpair()
        self._channel.setblocking(False)
        with theirs:
            try:
                self.process = subprocess.Popen(
                    [sys.executable, "-P", "-m", "offboard.supervisor.process"],
                    stdin=theirs.fileno(),
                    stdout=subprocess.DEVNULL,
                    start_new_session=True,  # signals of the terminal reach only the controller
                )
            except OSError as error:  # for example no memory, or too many processes
                self._channel.close()
                raise Unavailable(f"{NOT_STARTED}: {error.strerror}") from None
        self.lost = False
        return self

    @property
    def said(self) -> list[str]:
        """The sentences of the process: why it took over, and what it did."""
        return self._lines[1:]

    @property
    def loaded(self) -> bool:
        """Whether the process has begun to watch."""
        return bool(self._lines)

    @property
    def guards(self) -> bool:
        """Whether the process would take over: it runs, and has answered within the last second."""
        waited_s = clock.monotonic_s() - self._unanswered_s
        return bool(self._lines) and not self.lost and waited_s < ANSWER_S

    def restart(self) -> None:
        """Start another process in place of one that has ended. Raises Unavailable."""
        self._channel.close()
        self.process.poll()
        self.__enter__()

    def await_ready(self) -> None:
        """Wait until the process has loaded. Raises Unavailable."""
        while not self._lines:
            select.select([self._channel], [], [], START_S)
            if not self._receive():
                raise Unavailable(NOT_STARTED)

    def beat(self, vehicle: Supervised, peer: Hashable, link: Link, log_descriptor: int) -> None:
        """Send a beat, which shows that the controller runs. `peer` is the address that the vehicle
        sends from. Never waits."""
        if not self._lines:  # it has not loaded yet
            return
        beat = {
            "known": asdict(vehicle),
            "peer": peer,
            "stream": link.is_stream,
            "listens": link.listens,
            # has the key: others could read it in the arguments or the environment of the process
            "signing": self._signing.state() if self._signing else None,
        }
        line = json.dumps(beat).encode() + b"\n"
        self._unanswered_s = min(self._unanswered_s, clock.monotonic_s())
        descriptors = [*link.descriptors(), log_descriptor]
        passed = (link.opened, descriptors)
        try:
            socket.send_fds(self._channel, [line], [] if passed == self._passed else descriptors)
            self._passed = passed
        except BlockingIOError:
            pass  # the process is stopped or very late; the next beat says the same
        except OSError:
            self.lost = not self.has_taken_over()

    def has_taken_over(self) -> bool:
        """Whether the process sends in our place. From then on we must neither send nor receive."""
        self._receive()
        return len(self._lines) > 1

    def _receive(self) -> bool:
        """Read the answers of the process. Returns False if there are none, or if it has ended."""
        try:
            data = self._channel.recv(65536)
        except OSError:
            return False
        *lines, self._received = (self._received + data).split(b"\n")
        said = [json.loads(line) for line in lines]
        if said:
            self._unanswered_s = math.inf
        self._lines += filter(None, said)
        self.lost = not data and len(self._lines) <= 1
        return bool(data)

    def await_end(self, timeout_s: float) -> bool:
        """Wait at most `timeout_s` for the next sentence. Returns whether the process has ended."""
        select.select([self._channel], [], [], timeout_s)
        self._receive()
        return self.process.poll() is not None

    def __exit__(self, *_: object) -> None:
        """Close the channel: the process ends, or takes over if the last beat says so."""
        self._channel.close()
        with suppress(subprocess.TimeoutExpired):  # until then it holds the link's port
            self.process.wait(END_S)
