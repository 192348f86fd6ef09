"""Instances with sockets and a clock: real time, faster or slower, or lockstep with a companion.

Lockstep uses MAVLink only: at each barrier the simulator sends a TIMESYNC request after the
telemetry and waits for the answer. The companion handles messages in the order in which it reads
them. When its answer arrives, it has handled that telemetry, and everything that it sent before the
answer takes effect at that vehicle time. The simulator reads input at barriers only, so that a
flight depends on nothing but its seed.
"""

from __future__ import annotations

import gc
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

from offboard.documents.errors import Repeated
from offboard.link.clock import monotonic_s, unix_us
from simulator.instance import Instance
from simulator.link.framing import Recorder
from simulator.link.sockets import Link, wait
from simulator.steps import STEP_S

RESEND_S = 0.05  # repeat an unanswered barrier this often until the companion has sent anything
RESEND_SILENT_S = 1.0  # and this often later
ANSWER_TIMEOUT_S = 180.0  # a companion may compile first, perhaps on a busy machine
WARM_UP_S = 0.2  # vehicle time in which every frequent message is sent at least once
SPIN_S = 50e-6  # poll so long without sleeping: most answers come before a core would wake up
POLL_S = 0.05  # longest wait in a system call, so that a request to stop is noticed
BEHIND = "the simulator was {most:.1f} s behind real time{times} and does not catch up"
BEHIND_S = 0.5  # a greater lag behind real time is not caught up


@dataclass(frozen=True, slots=True)
class Endpoint:
    """One instance with its sockets."""

    instance: Instance
    companion: Link
    ground: Link | None = None
    recorder: Recorder | None = None  # log of the companion link
    strangers: tuple[Link, ...] = ()  # ports of the senders in `Instance.strangers`, in this order

    @property
    def links(self) -> list[Link]:
        return [self.companion] if self.ground is None else [self.companion, self.ground]

    def send(self, datagrams: list[bytes] | None = None) -> None:
        """Send the datagrams of other senders, each from its own port, then `datagrams` to the
        companion (None: those that are queued), then those queued for the ground station."""
        datagrams = self.instance.drain() if datagrams is None else datagrams
        self._record(datagrams)
        for link, strange in zip(self.strangers, self.instance.strangers, strict=True):
            link.send(strange)
            strange.clear()
        self.companion.send(datagrams)
        self.send_ground()

    def send_ground(self) -> None:
        if self.ground is not None:
            self.ground.send(self.instance.drain_ground())

    def send_barrier(self) -> tuple[int, list[bytes]]:
        """Send everything queued and then the barrier; return the barrier's time stamp and all
        datagrams that were sent to the companion."""
        stamp_ns, datagrams = self.instance.barrier()
        self.send(datagrams)
        return stamp_ns, datagrams

    def read(self) -> bool:
        """Handle all datagrams that have arrived; return whether the companion sent any."""
        received = False
        while (datagram := self.companion.receive()) is not None:
            self.handle(datagram)
            received = True
        self.read_ground()
        return received

    def handle(self, datagram: bytes) -> None:
        """Handle one datagram of the companion."""
        self._record([datagram])
        self.instance.feed(datagram)

    def _record(self, datagrams: list[bytes]) -> None:
        if self.recorder is not None:
            self.recorder.write(unix_us(), datagrams)

    def read_ground(self) -> None:
        while self.ground is not None and (datagram := self.ground.receive()) is not None:
            self.instance.feed_ground(datagram)


@dataclass(slots=True)
class Punctuality:
    """Deadlines of a run in real time: a step missed its deadline if it ended after the next one
    was due."""

    steps: int = 0
    missed: int = 0
    worst_s: float = 0.0

    def note(self, late_s: float, allowed_s: float) -> None:
        self.steps += 1
        self.missed += late_s > allowed_s
        self.worst_s = max(self.worst_s, late_s)

    def __str__(self) -> str:
        return (
            f"{self.missed} of {self.steps} deadlines missed,"
            f" at worst {1e3 * self.worst_s:.1f} ms late"
        )


def warm_up(instance: Instance) -> None:
    """Run all compiled functions once, with an instance that is not used later."""
    while instance.time_s < WARM_UP_S:
        instance.advance()


@dataclass(slots=True)
class Runner:
    """Runs instances with their sockets; `lockstep` needs exactly one.

    `stopping` is called often, and the run ends when it returns True. `report` receives sentences
    for the user. `end_s` is the vehicle time at which the run ends.
    """

    endpoints: list[Endpoint]
    stopping: Callable[[], bool]
    report: Callable[[str], None]
    end_s: float = math.inf
    punctuality: Punctuality = field(default_factory=Punctuality)

    def _over(self) -> bool:
        return self.endpoints[0].instance.time_s >= self.end_s or self.stopping()

    # -- real time ---------------------------------------------------------------------------

    def real_time(self, speed: float) -> None:
        """Run at `speed` times real time, with absolute deadlines; answers are sent at once."""
        instance = self.endpoints[0].instance
        owners = {link: endpoint for endpoint in self.endpoints for link in endpoint.links}
        self._stagger()
        gc.collect()
        gc.freeze()
        epoch_s = monotonic_s() - instance.time_s / speed
        behind = Repeated(BEHIND)
        while not self._over():
            deadline_s = epoch_s + (instance.time_s + STEP_S) / speed
            self._serve_until(deadline_s, owners)
            for endpoint in self.endpoints:
                endpoint.instance.advance()
                endpoint.send()
            behind_s = monotonic_s() - deadline_s
            self.punctuality.note(behind_s, STEP_S / speed)
            if behind_s > BEHIND_S:  # the computer was suspended or is overloaded: do not catch up
                behind.add(behind_s)
                epoch_s += behind_s
            if news := behind.news(monotonic_s()):
                self.report(news)

    def _stagger(self) -> None:
        """Advance each vehicle by one step more than the one before, so that they do not all send
        in the same step."""
        for ahead, endpoint in enumerate(self.endpoints):
            for _ in range(ahead):
                endpoint.instance.advance()
                endpoint.send()

    def _serve_until(self, deadline_s: float, owners: Mapping[Link, Endpoint]) -> None:
        """Handle the datagrams that arrive before the deadline; read the links at least once."""
        while True:
            remaining_s = deadline_s - monotonic_s()
            ready = wait(owners, min(remaining_s, POLL_S))
            for endpoint in dict.fromkeys(owners[link] for link in ready):
                if endpoint.read():
                    endpoint.send()
                else:
                    endpoint.send_ground()
            if remaining_s <= 0 or self.stopping():
                return

    # -- lockstep ----------------------------------------------------------------------------

    def lockstep(self) -> str:
        """Run in virtual time, which waits for the companion at every barrier, for at most
        ANSWER_TIMEOUT_S. Return a sentence about a missing answer, empty if the run was stopped or
        reached its end."""
        (endpoint,) = self.endpoints
        instance = endpoint.instance
        gc.collect()
        gc.freeze()
        while not self._over():
            if not instance.advance_to_barrier(self.end_s):
                continue
            stamp_ns, datagrams = endpoint.send_barrier()
            endpoint.read_ground()
            if self._answered(endpoint, stamp_ns, datagrams) or self.stopping():
                continue
            if instance.companion.answered_ns < 0:
                return (
                    f"no companion answered TIMESYNC within {ANSWER_TIMEOUT_S:g} s:"
                    " start one, or run without --lockstep"
                )
            return f"the companion stopped answering at {instance.time_s:.2f} s"
        return ""

    def _answered(self, endpoint: Endpoint, stamp_ns: int, datagrams: list[bytes]) -> bool:
        """Wait for the answer to this barrier, and handle all datagrams that come before it.
        Return whether it came in time, and before a request to stop."""
        server, link = endpoint.instance.companion, endpoint.companion
        begun_s = sent_s = monotonic_s()
        while server.answered_ns != stamp_ns:
            datagram = link.receive()
            if datagram is not None:
                endpoint.handle(datagram)
                continue
            if self.stopping():
                return False
            now_s = monotonic_s()
            if now_s - begun_s > ANSWER_TIMEOUT_S:
                return False
            if now_s - sent_s >= (RESEND_SILENT_S if server.outbox.connected else RESEND_S):
                link.send(datagrams)
                sent_s = now_s
            wait([link], POLL_S if now_s - begun_s > SPIN_S else 0.0)
        return True
