"""Instances in time and on sockets: real time, any speed, or lockstep with a companion.

Lockstep is MAVLink's own: at each barrier the simulator sends a TIMESYNC request after the
telemetry and waits for the answer. The companion answers in the order in which it reads, so by
then it has handled that telemetry, and all it sent before the answer is applied at that instant.
Input is read at barriers only, hence a flight is a function of its seed.
"""

from __future__ import annotations

import gc
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from offboard.flight.clock import monotonic_s, unix_us
from simulator.instance import Instance
from simulator.link.links import Link, wait
from simulator.link.recorder import Recorder
from simulator.steps import STEP_S

RESEND_S = 0.05  # until the companion is first heard
RESEND_SILENT_S = 1.0
PATIENCE_S = 5.0
FIRST_CONTACT_S = 180.0  # a companion may compile first, on a machine that does much else
FREE_RUN_S = 60.0  # vehicle time after the companion fell silent
REHEARSAL_S = 0.2  # every fast message is due in it
SPIN_S = 50e-6  # an answer comes sooner than a sleeping core wakes up
POLL_S = 0.05  # so that a stop is noticed in time
BEHIND_S = 0.5


@dataclass(frozen=True, slots=True)
class Outcome:
    """Exit code and, unless all is well, a sentence."""

    code: int
    sentence: str = ""


@dataclass(frozen=True, slots=True)
class Berth:
    """One instance and its sockets."""

    instance: Instance
    companion: Link
    ground: Link | None = None
    recorder: Recorder | None = None  # of the companion link

    @property
    def links(self) -> list[Link]:
        return [self.companion] if self.ground is None else [self.companion, self.ground]

    def send(self) -> None:
        """Send what both links have queued."""
        datagrams = self.instance.drain()
        self._record(datagrams)
        self.companion.send(datagrams)
        self.send_ground()

    def send_ground(self) -> None:
        datagrams = self.instance.ground.outbox.drain()
        if self.ground is not None:
            self.ground.send(datagrams)

    def send_barrier(self) -> tuple[int, list[bytes]]:
        """Send everything and the question for the time; return its stamp and the datagrams."""
        stamp_ns, datagrams = self.instance.barrier()
        self._record(datagrams)
        self.companion.send(datagrams)
        self.send_ground()
        return stamp_ns, datagrams

    def read(self) -> bool:
        """Handle what has arrived; whether the companion sent anything."""
        spoken = False
        while (datagram := self.companion.receive()) is not None:
            self.hear(datagram)
            spoken = True
        self.read_ground()
        return spoken

    def hear(self, datagram: bytes) -> None:
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
    """Of a run in real time: steps, and how late they ended. Missed: later than the next one."""

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


def rehearse(instance: Instance) -> None:
    """Have a throw-away instance call all compiled code, so that none compiles in flight."""
    instance.advance_to_barrier(REHEARSAL_S)
    while instance.time_s < 2.0 * REHEARSAL_S:
        instance.advance()


class Runner:
    """Instances and their sockets in one time; lockstep is for one. `stopping` is asked often."""

    def __init__(
        self,
        berths: Sequence[Berth],
        *,
        stopping: Callable[[], bool],
        tell: Callable[[str], None],
        duration_s: float | None = None,
    ) -> None:
        self._berths = berths
        self._berth = berths[0]
        self._instance = self._berth.instance
        self._companion = self._berth.companion
        self._owner = {link: berth for berth in berths for link in berth.links}
        self._links = list(self._owner)
        self._stopping = stopping
        self._tell = tell
        self._end_s = math.inf if duration_s is None else duration_s
        self.punctuality = Punctuality()

    def _over(self) -> bool:
        return self._instance.time_s >= self._end_s or self._stopping()

    # -- real time ---------------------------------------------------------------------------

    def real_time(self, speed: float) -> Outcome:
        """`speed` x real time, by absolute deadlines; answers go out as soon as they are due."""
        instance = self._instance
        self._stagger()
        gc.collect()
        gc.freeze()
        epoch_s = monotonic_s() - instance.time_s / speed
        while not self._over():
            deadline_s = epoch_s + (instance.time_s + STEP_S) / speed
            self._serve_until(deadline_s)
            for berth in self._berths:
                berth.instance.advance()
                berth.send()
            behind_s = monotonic_s() - deadline_s
            self.punctuality.note(behind_s, STEP_S / speed)
            if behind_s > BEHIND_S:  # suspended or overloaded: go on from here, do not race
                self._tell(
                    f"{behind_s:.1f} s behind at {instance.time_s:.1f} s: going on from here"
                )
                epoch_s += behind_s
        return Outcome(0)

    def _stagger(self) -> None:
        """Start each vehicle a step after the next, so that their streams do not fall together."""
        for ahead, berth in enumerate(self._berths):
            for _ in range(ahead):
                berth.instance.advance()
                berth.send()

    def _serve_until(self, deadline_s: float) -> None:
        """Handle what arrives before the deadline; once in any case."""
        while True:
            remaining_s = deadline_s - monotonic_s()
            ready = wait(self._links, min(remaining_s, POLL_S))
            for berth in dict.fromkeys(self._owner[link] for link in ready):
                if berth.read():
                    berth.send()
                else:
                    berth.send_ground()
            if remaining_s <= 0 or self._stopping():
                return

    # -- lockstep ----------------------------------------------------------------------------

    def lockstep(self, patience_s: float | None = None) -> Outcome:
        """Virtual time that waits for the companion at every barrier, so long; not given, longer
        for its first word."""
        gc.collect()
        gc.freeze()
        while not self._over():
            if not self._instance.advance_to_barrier(self._end_s):
                continue
            stamp_ns, datagrams = self._berth.send_barrier()
            self._berth.read_ground()
            first = not self._instance.companion.texts.heard
            waits_s = patience_s or (FIRST_CONTACT_S if first else PATIENCE_S)
            if self._answered(stamp_ns, datagrams, waits_s) or self._stopping():
                continue
            if self._instance.companion.answered_ns < 0:
                return Outcome(
                    3,
                    f"no companion answered TIMESYNC within {waits_s:g} s:"
                    " start one, or leave --lockstep away",
                )
            self._tell(f"the companion fell silent at {self._instance.time_s:.2f} s")
            if not self._free_run():
                return Outcome(3, "the companion did not come back")
        return Outcome(0)

    def _answered(self, stamp_ns: int, datagrams: list[bytes], patience_s: float) -> bool:
        """Wait for the answer to this barrier, applying all that comes before it."""
        server = self._instance.companion
        begun_s = sent_s = monotonic_s()
        while server.answered_ns != stamp_ns:
            datagram = self._companion.receive()
            if datagram is not None:
                self._berth.hear(datagram)
                continue
            if self._stopping():
                return False
            now_s = monotonic_s()
            if now_s - begun_s > patience_s:
                return False
            if now_s - sent_s >= (RESEND_SILENT_S if server.texts.heard else RESEND_S):
                self._companion.send(datagrams)
                sent_s = now_s
            wait([self._companion], POLL_S if now_s - begun_s > SPIN_S else 0.0)
        return True

    def _free_run(self) -> bool:
        """Let the failsafe play out at full speed; True as soon as the companion answers again."""
        instance = self._instance
        end_s = instance.time_s + FREE_RUN_S
        known_ns = instance.companion.answered_ns
        while instance.time_s < end_s and not (instance.idle or self._over()):
            if not instance.advance_to_barrier(end_s):
                continue
            self._berth.send_barrier()
            while (datagram := self._companion.receive()) is not None:
                self._berth.hear(datagram)
            self._berth.read_ground()
            if instance.companion.answered_ns != known_ns:
                self._tell(f"the companion is back at {instance.time_s:.2f} s")
                return True
        state = "landed and disarmed" if instance.idle else "still flying"
        self._tell(f"without it the vehicle is {state} at {instance.time_s:.1f} s")
        return False
